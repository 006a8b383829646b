"""The look of the pages: contrast for every eye, on paper and on a phone."""

from __future__ import annotations

import re
from importlib import resources

import pytest

from tests.report.figures.test_print import contrast

CSS = (resources.files("calib.report.page") / "style.css").read_text(encoding="utf-8")
# What is written on what.
PAIRS = [
    (word, ground)
    for word in ("ink", "soft", "link", "good", "care", "bad")
    for ground in ("paper", "panel")
] + [("ink", "badge")]


def schemes() -> dict[str, dict[str, str]]:
    """Colours by name, in each colour scheme."""
    blocks = re.findall(r":root \{(.*?)\}", CSS, re.DOTALL)
    found = [dict(re.findall(r"--(\w+): (#[0-9a-fA-F]{3,6})", block)) for block in blocks]
    light, dark, paper = found
    return {"light": light, "dark": light | dark, "print": light | paper}


@pytest.mark.parametrize("scheme", ["light", "dark", "print"])
def test_words_stand_out(scheme):
    colours = schemes()[scheme]
    for word, ground in PAIRS:
        assert contrast(colours[word], colours[ground]) >= 4.5, (word, ground)


def test_there_are_rules_for_phones_and_paper():
    assert "@media print" in CSS
    assert "@media (max-width: 40rem)" in CSS
    assert "overflow-x: auto" in CSS
    # No colours beside those checked above, but white behind figures.
    rules = re.sub(r":root \{.*?\}", "", CSS, flags=re.DOTALL)
    assert set(re.findall(r"#[0-9a-fA-F]{3,8}\b", rules)) <= {"#ffffff"}
