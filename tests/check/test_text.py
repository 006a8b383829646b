"""A page written again: the same bytes, or the same words where its numbers moved."""

from __future__ import annotations

import base64
from pathlib import Path

import pytest

from calib.batch.environment import Environment
from calib.checking import compare
from calib.checking.compare import Item, Job, Status


def shown(picture: bytes) -> str:
    return f'<img src="data:image/png;base64,{base64.b64encode(picture).decode()}">'


def compared(tmp_path: Path, old: str, new: str, **kwargs: bool) -> Item:
    for name, text in (("old", old), ("new", new)):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "index.html").write_text(text, encoding="utf-8")
    here = Environment({}, {}, "")
    job = Job(tmp_path / "old", tmp_path / "new", lambda *_: None, here)
    return compare.view("index.html", job, **kwargs)


@pytest.mark.parametrize(
    ("old", "new", "exact", "same"),
    [
        ("0.123 kN", "0.124 kN", False, True),
        ("-0.123 kN", "\u22120.124 kN", False, True),
        ("2.5\u00d710\u207b\u00b3", "2.5", False, True),
        ("version 4e5127, 7 kN", "version 4e5127, 8 kN", False, True),
        # Where no number moved, none on the page may.
        ("0.123 kN", "0.124 kN", True, False),
        ("rut depth 7", "rut width 7", False, False),
        ("7", "", False, False),
        ("7", "7\n7", False, False),
    ],
)
def test_numbers_may_differ_where_they_moved_and_words_may_not(
    old: str, new: str, exact: bool, same: bool, tmp_path: Path
) -> None:
    found = compared(tmp_path, old, new, exact=exact)
    assert found.status is (Status.WITHIN if same else Status.DIFFERENT)


@pytest.mark.parametrize(
    ("sure", "same_draws", "status", "why"),
    [
        (True, True, Status.DIFFERENT, ""),
        (True, False, Status.UNJUDGED, "its numbers moved within their tolerance: "),
        (False, True, Status.UNJUDGED, "another version wrote it: "),
    ],
)
def test_other_words_are_judged_where_program_and_draws_are_the_same(
    sure: bool, same_draws: bool, status: Status, why: str, tmp_path: Path
) -> None:
    judged = {"sure": sure, "same_draws": same_draws, "exact": False}
    found = compared(tmp_path, "it passes", "it fails", **judged)
    assert found.status is status
    assert found.note == f"{why}2 lines differ: - it passes; + it fails"


def test_other_line_ends_are_no_difference(tmp_path: Path) -> None:
    found = compared(tmp_path, "one\r\ntwo\r\n", "one\ntwo\n")
    assert found.status is Status.WITHIN


@pytest.mark.parametrize("exact", [True, False])
def test_a_picture_that_only_the_page_has_is_judged_as_a_figure(
    exact: bool, tmp_path: Path
) -> None:
    page = compared(tmp_path, shown(b"a") + shown(b"b"), shown(b"a") + shown(b"c"), exact=exact)
    assert page.status is (Status.DIFFERENT if exact else Status.WITHIN)
    assert "pictures" in page.note


def test_other_pictures_are_named(tmp_path: Path) -> None:
    item = compared(tmp_path, "same", "same" + shown(b"other"))
    assert (item.status, item.note) == (
        Status.DIFFERENT, "it shows other pictures, or in another order",
    )  # fmt: skip


def test_a_picture_that_is_no_base64_is_none_of_the_figures(tmp_path: Path) -> None:
    (tmp_path / "rut.png").write_bytes(b"a figure")
    page = shown(b"a figure") + '<img src="data:image/png;base64,A=B">'
    (tmp_path / "index.html").write_text(page)
    named = compare.named_pictures(tmp_path, "index.html")
    assert named.count("[picture rut.png]") == named.count("[picture of its own]") == 1
