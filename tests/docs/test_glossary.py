"""The glossary can be looked up: in order, each term once, in a sentence or two."""

from __future__ import annotations

import re

from tests.docs.pages import DOCS
from tests.docs.test_english import sentences

TEXT = (DOCS / "glossary.md").read_text(encoding="utf-8")
TERMS = re.findall(r"^(\S.*)\n: ((?:.+\n)+)", TEXT, re.M)


def test_terms_are_in_order() -> None:
    names = [term for term, _ in TERMS]
    assert len(names) == TEXT.count("\n: ")
    assert names == sorted(set(names), key=str.lower)


def test_a_meaning_is_a_sentence_or_two() -> None:
    for term, meaning in TERMS:
        said = [words for words in sentences(meaning.replace(":", ",")) if words]
        assert len(said) <= 2, (term, said)
