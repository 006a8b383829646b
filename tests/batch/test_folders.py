"""Output folders appear whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from calib.batch.folders import check_folder, claimed, fresh_folder
from calib.errors import CalibError


def contents(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*")}


def refusal(out: Path, *, overwrite: bool = False) -> str:
    """Both the check and the folder itself must refuse, with the same message."""
    with pytest.raises(CalibError) as early:
        check_folder(out, overwrite=overwrite)
    with pytest.raises(CalibError) as late:
        fresh_folder(out, overwrite=overwrite).__enter__()
    assert str(early.value) == str(late.value)
    assert str(out) in str(early.value)
    assert "hint:" in str(early.value)
    return str(early.value)


def thesis(place: Path) -> Path:
    (place / "thesis").mkdir()
    (place / "thesis" / "chapter1.tex").write_text("years of work")
    return place / "thesis"


def beside_ours(place: Path) -> Path:
    (thesis(place) / "run.json").write_text("{}")
    return place / "thesis"


def among_ours(place: Path) -> Path:
    figures = place / "report" / "figures"
    figures.mkdir(parents=True)
    for name in ("drawn.png", "mine.png"):
        (figures / name).write_text("x")
    record = {"files": {"figures/drawn.png": "hash"}}
    (place / "report" / "manifest.json").write_text(json.dumps(record))
    return place / "report"


def below_a_file(place: Path) -> Path:
    (place / "file").write_text("x")
    return place / "file" / "deeper" / "run"


@pytest.mark.parametrize(
    ("arrange", "said"),
    [
        (thesis, "was not written by calib"),
        (beside_ours, "holds files that calib did not write: chapter1.tex"),
        (among_ours, "holds files that calib did not write: figures/mine.png"),
        (lambda place: below_a_file(place).parents[1], "is an existing file"),
        (below_a_file, "file is a file"),
        (lambda place: place / ("x" * 300), "cannot be written"),
        (lambda place: place, "is the current folder"),
    ],
)
def test_what_may_not_be_replaced_is_refused_and_stays(
    arrange: Callable[[Path], Path], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    out = arrange(tmp_path)
    before = contents(tmp_path)
    assert said in refusal(out, overwrite=True)
    assert contents(tmp_path) == before


def test_without_permission_or_room_it_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=2_000_000)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: usage)
        assert "only 2.0 MB are left on its disk" in refusal(tmp_path / "run")
    # The superuser may write anywhere, so the answer is put in the system's mouth.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert "no permission to write" in refusal(tmp_path / "run")


def test_an_earlier_result_is_replaced_only_on_request_and_an_empty_folder_is_used(
    tmp_path: Path,
) -> None:
    out = tmp_path / "run"
    out.mkdir()
    with fresh_folder(out) as folder:
        (folder / "manifest.json").write_text("old")
    assert "--overwrite, in Python overwrite=True" in refusal(out)
    with fresh_folder(out, overwrite=True) as folder:
        (folder / "new").write_text("x")
    assert contents(tmp_path) == {"run", "run/new"}


def test_a_folder_appears_once_the_block_succeeds(tmp_path: Path) -> None:
    out = tmp_path / "new" / "run"
    with fresh_folder(out) as folder:
        (folder / "run.json").write_text("{}")
        assert not out.exists()
    assert contents(tmp_path) == {"new", "new/run", "new/run/run.json"}
    mask = os.umask(0)
    os.umask(mask)
    assert out.stat().st_mode & 0o777 == 0o777 & ~mask


@pytest.mark.parametrize("existing", [False, True])
def test_a_block_that_fails_leaves_things_as_they_were(tmp_path: Path, existing: bool) -> None:
    out = tmp_path / "run"
    if existing:
        out.mkdir()
        (out / "run.json").write_text("old")
    before = contents(tmp_path)

    def fail() -> None:
        with fresh_folder(out, overwrite=True) as folder:
            (folder / "half").write_text("x")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert contents(tmp_path) == before


def test_of_two_that_write_at_a_time_neither_is_lost(tmp_path: Path) -> None:
    out = tmp_path / "run"

    def slower(what: str) -> None:
        with fresh_folder(out) as folder:
            (folder / "run.json").write_text(what)
            if not out.exists():
                with fresh_folder(out) as other:
                    (other / "run.json").write_text("quicker")

    with pytest.raises(CalibError, match=r"look for the result of this one in .*run-2"):
        slower("slower")
    shutil.move(out, tmp_path / "away")
    with pytest.raises(CalibError, match=r"result of this one in .*run-3"):
        slower("slowest")
    assert contents(tmp_path) == {
        f"{name}{file}" for name in ("run", "run-2", "run-3", "away") for file in ("", "/run.json")
    }
    texts = {p.name: (p / "run.json").read_text() for p in tmp_path.iterdir()}
    assert texts == {"away": "quicker", "run": "quicker", "run-2": "slower", "run-3": "slowest"}


@pytest.mark.parametrize("earlier", [False, True])
def test_of_a_link_the_folder_that_it_names_is_written(tmp_path: Path, earlier: bool) -> None:
    """It was taken for a folder that another process had written meanwhile, or was replaced."""
    there = tmp_path / "disk" / "elsewhere"
    there.mkdir(parents=True)
    if earlier:
        (there / "run.json").write_text("old")
    out = tmp_path / "out"
    out.symlink_to(there)
    with fresh_folder(out, overwrite=earlier) as folder:
        assert folder.is_relative_to(there.parent)
        (folder / "run.json").write_text("new")
    assert out.is_symlink()
    assert (there / "run.json").read_text() == "new"
    assert contents(tmp_path) == {"out", "disk", "disk/elsewhere", "disk/elsewhere/run.json"}


def test_a_mount_point_is_refused_before_the_work(tmp_path: Path, monkeypatch) -> None:
    """What was made could not take its place."""
    out = tmp_path / "out"
    out.mkdir()
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == out)
    for kept in (fresh_folder(out), fresh_folder(out, overwrite=True), claimed(out)):
        with pytest.raises(CalibError, match="is a mount point"), kept:
            pytest.fail("the work began")


KILLED = """
import os, signal, sys
from pathlib import Path
from calib.batch.folders import fresh_folder
with fresh_folder(Path(sys.argv[1]), overwrite=True) as folder:
    (folder / "half").write_text("x")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def aged(folder: Path) -> Path:
    earlier = time.time() - 3600.0
    os.utime(folder, (earlier, earlier))
    return folder


def test_what_a_killed_run_left_is_removed_by_the_next(tmp_path: Path) -> None:
    out = tmp_path / "run"
    subprocess.run([sys.executable, "-c", KILLED, str(out)], check=False)
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".run-")
    with fresh_folder(out) as folder:
        (folder / "a").write_text("x")
    # It might have been a run that had only just begun.
    assert contents(tmp_path) == {
        "run",
        "run/a",
        left.name,
        f"{left.name}/whole",
        f"{left.name}/whole/half",
    }
    aged(left)
    with fresh_folder(tmp_path / "other") as folder:
        (folder / "a").write_text("x")
    assert left.exists()
    (out / "a").unlink()
    with fresh_folder(out) as folder:
        (folder / "a").write_text("x")
    assert contents(tmp_path) == {"run", "run/a", "other", "other/a"}


def test_what_a_living_run_writes_is_left_alone(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with fresh_folder(out) as first:
        aged(first)
        with fresh_folder(out) as second:
            (second / "b").write_text("x")
        assert first.exists()
        (out / "b").unlink()
        (first / "a").write_text("x")


def test_the_only_copy_of_an_earlier_result_is_not_removed(tmp_path: Path) -> None:
    earlier = tmp_path / ".run-old-abcdef12"
    (earlier / "old").mkdir(parents=True)
    mine = tmp_path / ".run-notes"
    mine.mkdir()
    aged(earlier), aged(mine)
    with fresh_folder(tmp_path / "run") as folder:
        (folder / "run.json").write_text("{}")
    assert earlier.exists()
    with fresh_folder(tmp_path / "run", overwrite=True):
        pass
    assert not earlier.exists()
    assert mine.exists()


def test_a_disk_that_fills_up_is_one_line(tmp_path, monkeypatch):
    def full(path, content):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    with (
        pytest.raises(CalibError, match=r"cannot be written \(No space left on device\)"),
        fresh_folder(tmp_path / "out") as scratch,
    ):
        (scratch / "summary.json").write_bytes(b"{}")
    assert list(tmp_path.iterdir()) == []
    # Other errors of the system are not taken for a full disk.
    with pytest.raises(FileNotFoundError), fresh_folder(tmp_path / "out"):
        (tmp_path / "nowhere" / "file").read_bytes()
