"""A page written again: the same words, and the same digits but for the last."""

from __future__ import annotations

import base64
from pathlib import Path

import pytest

from calib.check.outcome import Status
from calib.check.text import Judgement, compare_page, own_pictures, verify_images


def page(*lines: str) -> str:
    return "\n".join(("<h1>Report</h1>", '<section aria-labelledby="rut">', *lines, "</section>"))


def shown(picture: bytes) -> str:
    return f'<img src="data:image/png;base64,{base64.b64encode(picture).decode()}">'


def compared(tmp_path: Path, old: str, new: str, *judgement):
    for name, text in (("old", old), ("new", new)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "index.html").write_text(text, encoding="utf-8")
    return compare_page(
        "index.html", tmp_path / "old", tmp_path / "new", lambda section: Judgement(*judgement)
    )


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("0.123 kN", "0.124 kN", True),
        ("0.123 kN", "0.125 kN", False),
        ("-0.123 kN", "\u22120.124 kN", True),
        ("-0.123 kN", "0.123 kN", False),
        ("12,345 rows", "12,346 rows", True),
        ("12,345 rows", "12,347 rows", False),
        ("2.5\u00d710\u207b\u00b3", "2.6\u00d710\u207b\u00b3", True),
        ("2.5\u00d710\u207b\u00b3", "2.7\u00d710\u207b\u00b3", False),
        ("2.5\u00d710\u207b\u00b3", "2.5\u00d710\u207b\u00b2", False),
        ("9.99e5", "1.00e6", True),  # a unit of the last digit of the coarser one
        ("version 1.2.3", "version 1.2.4", False),  # no number
        ("version 4e5127, 7 kN", "version 4e5127, 8 kN", True),  # a hash
        ("version 4e5127", "version 4e5128", False),
        ('<td class="n1">7</td>', '<td class="n9">7</td>', True),  # what a browser does not show
        ("rut depth 7", "rut width 7", False),
        ("7", "", False),
    ],
)
def test_numbers_may_differ_by_one_unit_of_their_last_digit(
    old: str, new: str, same: bool, tmp_path: Path
) -> None:
    found = compared(tmp_path, page(old), page(new))
    assert found.status is (Status.WITHIN if same else Status.DIFFERENT)


WHY = "its numbers moved within their tolerance"


@pytest.mark.parametrize(
    ("old", "new", "moved", "sure", "status"),
    [
        # Ten times as far as what it follows from, and a unit of the last digit.
        ("0.1100 kN", "0.1111 kN", 1e-3, True, Status.WITHIN),
        ("0.1100 kN", "0.1115 kN", 1e-3, True, Status.DIFFERENT),
        ("0.11 kN", "0.01 kN", 1e-3, True, Status.DIFFERENT),
        # Where numbers moved far, what follows from them is not judged beyond a seventh of it.
        ("-6.7 nats", "-6.0 nats", 0.5, False, Status.WITHIN),
        ("79 %", "99 %", 0.5, False, Status.UNJUDGED),
        ("0.11 kN", "0.01 kN", 0.9, False, Status.UNJUDGED),
        # Though nothing is read off them, as where the work merely took other steps.
        ("1246 evaluations", "1500 evaluations", 0.2, None, Status.UNJUDGED),
        # Words are another matter.
        ("it passes", "it fails", 1e-3, True, Status.UNJUDGED),
    ],
)
def test_numbers_move_little_more_than_what_they_follow_from(
    old: str, new: str, moved: float, sure: bool | None, status: Status, tmp_path: Path
) -> None:
    why = None if sure is None else WHY
    found = compared(tmp_path, page(old), page(new), why, moved, bool(sure))
    assert found.status is status
    if status is not Status.WITHIN:
        assert f"- {old}; + {new}" in found.note


def test_words_that_cannot_be_judged_say_why(tmp_path: Path) -> None:
    found = compared(tmp_path, page("it passes"), page("it fails"), "near a threshold")
    assert found.status is Status.UNJUDGED
    assert found.note == "near a threshold: 2 lines differ: - it passes; + it fails"


@pytest.mark.parametrize("why", [None, "another version wrote it"])
def test_no_section_hides_what_differs_in_another(why: str | None, tmp_path: Path) -> None:
    last = '<section aria-labelledby="end"><p>end</p></section>'
    old, new = page("it passes") + last, page("it fails") + last + "<!-- a decoy -->"
    found = compared(tmp_path, old, new, why)
    assert found.status is (Status.DIFFERENT if why is None else Status.UNJUDGED)
    for words in ("- it passes", "+ it fails", "a decoy", "4 lines differ"):
        assert words in found.note


@pytest.mark.parametrize(
    ("new", "note"),
    [
        (page("same").replace("rut", "pull"), "it has other sections"),
        (
            page(
                "same", f'<img src="data:image/png;base64,{base64.b64encode(b"other").decode()}">'
            ),
            "it shows other pictures, or in another order",
        ),
    ],
)
def test_other_sections_and_pictures_are_named(new: str, note: str, tmp_path: Path) -> None:
    found = compared(tmp_path, page("same"), new)
    assert (found.status, found.note) == (Status.DIFFERENT, note)


def test_a_picture_that_is_no_base64_is_none_of_the_figures(tmp_path: Path) -> None:
    (tmp_path / "rut.png").write_bytes(b"a figure")
    good = shown(b"a figure")
    broken = '<img src="data:image/png;base64,A=B">'
    assert [item.status for item in verify_images(good, tmp_path)] == [Status.IDENTICAL]
    (wrong,) = verify_images(good + broken, tmp_path)
    assert (wrong.status, wrong.note) == (
        Status.DIFFERENT, "1 of its pictures are none of the figures",
    )  # fmt: skip
    assert own_pictures(good + broken, tmp_path) == [b""]
