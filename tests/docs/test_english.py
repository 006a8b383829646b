"""Sentences of the documentation are short enough to be read once."""

from __future__ import annotations

import re

import pytest

from tests.docs.pages import NOTEBOOKS, PAGES

LONGEST = 35  # words
# Of the gallery, which is read beside its code.
LONGEST_OF_NOTEBOOKS, MEAN_OF_NOTEBOOKS = 30, 15
# What is no sentence: metadata, code, formulas, tables, headings, addresses; an item of a list
# begins one.
_LEFT_OUT = (
    (re.compile(r"\A---\n.*?\n---\n", re.S), ""),
    (re.compile(r"```.*?```|\$\$.*?\$\$", re.S), ""),
    (re.compile(r"^\|.*$", re.M), ""),
    (re.compile(r"^#.*$", re.M), "."),
    (re.compile(r"\]\([^)]*\)"), "]"),
    (re.compile(r"^\s*(-|\d+\.)\s", re.M), " . "),
    (re.compile(r"\n\n"), " . "),
)


def sentences(text: str) -> list[list[str]]:
    """Split a page into the words of its sentences; a colon ends one."""
    for pattern, instead in _LEFT_OUT:
        text = pattern.sub(instead, text)
    return [part.split() for part in re.split(r"(?<=[.!?:])\s+", text)]


@pytest.mark.parametrize("page", PAGES)
def test_no_sentence_is_longer_than_a_reader_holds(page: str) -> None:
    text = PAGES[page].read_text(encoding="utf-8")
    long = [" ".join(words) for words in sentences(text) if len(words) > LONGEST]
    assert not long, long


@pytest.mark.parametrize("notebook", NOTEBOOKS)
def test_sentences_of_a_notebook_are_short(notebook: str) -> None:
    found = [words for words in sentences(NOTEBOOKS[notebook].read_text("utf-8")) if len(words) > 1]
    long = [" ".join(words) for words in found if len(words) > LONGEST_OF_NOTEBOOKS]
    assert not long, long
    assert sum(map(len, found)) <= MEAN_OF_NOTEBOOKS * len(found)


@pytest.mark.parametrize("notebook", NOTEBOOKS)
def test_a_notebook_begins_with_a_question_and_ends_with_what_to_do(notebook: str) -> None:
    text = NOTEBOOKS[notebook].read_text("utf-8")
    title, first, *_ = text.split("\n---\n", 1)[1].strip().split("\n\n")
    assert title.startswith("# ")
    assert re.match(r"[A-Z][^.]*\?", first), first
    last = text.rstrip().rpartition("\n\n")[2]
    for said in ("**Found.**", "**How sure.**", "**What to do.**"):
        assert said in last, said
    assert text.count("\n") <= 90
