"""The look of the pages: contrast for every eye, on paper and on a phone."""

from __future__ import annotations

import re
from importlib import resources

import numpy as np
import pytest

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


def luminance(colour: str) -> float:
    """Relative luminance (WCAG 2.2)."""
    digits = colour[1:] if len(colour) == 7 else "".join(2 * c for c in colour[1:])
    c = np.array([int(digits[i : i + 2], 16) for i in (0, 2, 4)]) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_the_measure_itself():
    assert contrast("#ffffff", "#000") == pytest.approx(21.0)
    assert contrast("#767676", "#ffffff") == pytest.approx(4.54, abs=0.01)


@pytest.mark.parametrize("scheme", ["light", "dark", "print"])
@pytest.mark.parametrize(("word", "ground"), PAIRS)
def test_words_stand_out(scheme, word, ground):
    colours = schemes()[scheme]
    assert contrast(colours[word], colours[ground]) >= 4.5


def test_there_are_rules_for_phones_and_paper():
    assert "@media print" in CSS
    assert "@media (max-width: 40rem)" in CSS
    assert "overflow-x: auto" in CSS
    # No colours beside those checked above, but white behind figures.
    rules = re.sub(r":root \{.*?\}", "", CSS, flags=re.DOTALL)
    assert set(re.findall(r"#[0-9a-fA-F]{3,8}\b", rules)) <= {"#ffffff"}
