"""Sentences of the documentation are short enough to be read once."""

from __future__ import annotations

import re

import pytest

from tests.docs.pages import PAGES

LONGEST = 35  # words
# What is no sentence: code, formulas, tables, headings, addresses; an item of a list begins one.
_LEFT_OUT = (
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
