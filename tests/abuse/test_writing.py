"""Whatever writes says at once what it cannot: a read-only place, a full disk, another process."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from calib.batch.folders import claimed, fresh_folder
from calib.cli.app import app
from calib.errors import CalibError
from calib.models import example_csv
from challenge.seal import write_case as hide
from tests.gap.cases import PULL_ONLY, make_case, write_case

PLAN = """
[[fit]]
name = "ruts"
data = ["ruts.csv"]
models = ["bekker"]
"""
# Words of each verb that works long before it writes, the output as OUT. The inputs of these are
# not there: that is not even looked at.
AT_ONCE = {
    "fit": "fit none.csv --model bekker --out OUT",
    "report": "report none.csv --out OUT",
    "compare": "compare bekker_plate reece none.csv --out OUT",
    "diagnose": "diagnose none --out OUT",
    "audit": "audit --out OUT",
    "predict": "predict none --at none.csv --out OUT",
    "score": "challenge score none --results none --key none --out OUT",
}
# These read what they are to do first, and land one result after the other.
LANDING = {
    "sbc": "sbc --model bekker --simulations 10 --workers 1 --out OUT",
    "campaign": "campaign plan.toml --workers 1 --out OUT",
    "run": "challenge run cases --workers 1 --out OUT",
    "make": "challenge make --seed 1 --cases 1 --workers 1 --key answers --out OUT",
    "well-specified": "challenge well-specified cases --key sealed --out-key answers "
    "--workers 1 --out OUT",
}
# These write at once.
SMALL = {
    "template": "template bekker --out OUT",
    "priors": "priors bekker --out OUT",
    "data": "data he2019 --out OUT",
    "cases": "data he2019-gaps --out OUT",
}


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("ruts.csv").write_text(example_csv("bekker"), encoding="utf-8")
    Path("plan.toml").write_text(PLAN, encoding="utf-8")
    cases = Path("cases")
    write_case(
        make_case("force_offset", models=PULL_ONLY, n_lab=15, n_field=12), cases / "case-000"
    )
    truth = {"tier": "easy", "truth": "force_offset", "gap_over_noise": 3.0}
    files = {"case.toml": (cases / "case-000" / "case.toml").read_text(encoding="utf-8")}
    hide(cases / "case-000", files, Path("sealed"), truth)
    return tmp_path


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have anything that takes long end the test."""

    def begun(*_: object, **__: object) -> None:
        raise AssertionError("the work has begun")

    for name in (
        "calib.batch.tasks.completed", "challenge.make.completed",
        "challenge.redraw.completed", "calib.he2019.audit.run_audit",
        "calib.inference.calibration.calibrate",
    ):  # fmt: skip
        monkeypatch.setattr(name, begun)


@contextmanager
def mounted(folder: Path, options: str) -> Iterator[Path]:
    """Mount a file system of its own in memory."""
    folder.mkdir(exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    if (
        not sys.platform.startswith("linux")
        or subprocess.run(mount, capture_output=True).returncode
    ):
        pytest.skip("no file system may be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def read_only(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "archive"
    folder.mkdir()
    folder.chmod(0o555)
    if not os.access(folder, os.W_OK):
        yield folder
        folder.chmod(0o755)
        return
    # The superuser may write wherever the file system can.
    with mounted(folder, "ro,size=64k"):
        yield folder


@pytest.fixture
def full(tmp_path: Path) -> Iterator[Path]:
    with mounted(tmp_path / "stick", "size=64k") as folder:
        with (folder / "photos").open("wb", buffering=0) as file:
            try:
                while file.write(bytes(4096)):
                    pass
            except OSError:
                pass
        yield folder


def refused(words: str, out: Path) -> str:
    """Run a command that must be refused; return the one line that says why."""
    done: Result = CliRunner().invoke(
        app, [word.replace("OUT", str(out)) for word in words.split()]
    )
    assert done.exit_code == 2, (done.output, done.exception)
    lines = done.stderr.splitlines()
    assert lines[0].startswith("calib: "), lines
    # What is allowed and how to fix it stand below, moved in.
    assert all(line.startswith("  ") for line in lines[1:]), lines
    assert done.stdout == ""
    return done.stderr


def test_a_read_only_place_is_found_before_the_work(read_only: Path, no_work: None) -> None:
    for verb, words in (AT_ONCE | LANDING | SMALL).items():
        said = refused(words, read_only / "out")
        assert str(read_only / "out") in said, verb
        assert "cannot be written" in said, verb
        assert list(read_only.iterdir()) == [], verb


def test_a_full_disk_is_found_before_the_work_and_leaves_nothing(full: Path, no_work: None) -> None:
    for verb, words in (AT_ONCE | LANDING).items():
        said = refused(words, full / "out")
        assert str(full / "out") in said, verb
        assert "only 0.0 MB are left on its disk" in said, verb
        assert [path.name for path in full.iterdir()] == ["photos"], verb
    for verb, words in SMALL.items():
        assert "cannot be written (No space left on device)" in refused(words, full / "out"), verb
        assert {path.name for path in full.rglob("*") if path.is_file()} == {"photos"}, verb


def test_answers_that_cannot_be_written_are_found_before_cases_are_made(
    read_only: Path, no_work: None
) -> None:
    words = f"challenge make --seed 1 --cases 1 --out OUT --key {read_only / 'answers'}"
    assert "answers: the output cannot be written" in refused(words, Path("new"))


def test_results_that_land_in_an_earlier_folder_are_refused_as_early(
    full: Path, read_only: Path, no_work: None
) -> None:
    """A campaign, or simulations, resumed where nothing can be written any more."""
    for words in (LANDING["sbc"], LANDING["campaign"]):
        assert "cannot be written" in refused(words, read_only)
        assert "cannot be written" in refused(words, full / "out")


def test_a_disk_that_fills_up_meanwhile_costs_one_line(tmp_path: Path) -> None:
    with mounted(tmp_path / "stick", "size=17m") as folder:
        with (
            pytest.raises(CalibError, match=r"cannot be written \(No space left on device\)"),
            fresh_folder(folder / "out") as scratch,
        ):
            (scratch / "posterior.nc").write_bytes(bytes(32_000_000))
        with (
            pytest.raises(CalibError, match=r"cannot be written \(Not enough free space"),
            fresh_folder(folder / "out") as scratch,
        ):
            np.save(scratch / "posterior.npy", np.zeros(4_000_000))
        assert list(folder.iterdir()) == []


# Another process

HOLD = """
import sys
from pathlib import Path
from calib.batch.folders import claimed
from calib.batch.folders import alone
out = Path(sys.argv[2])
if sys.argv[1] == "alone":
    out.mkdir(parents=True)
with {"claimed": claimed, "alone": alone}[sys.argv[1]](out):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def another(way: str, out: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Hold a folder in another process, as a command does while it works."""
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, way, str(out)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
    )  # fmt: skip
    assert holder.stdout is not None
    assert holder.stdin is not None
    with closing(holder.stdout), closing(holder.stdin):
        assert holder.stdout.readline() == b"held\n"
        try:
            yield holder
        finally:
            holder.kill()
            holder.wait()


def contents(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*")}


def test_a_second_process_on_a_folder_is_refused_before_the_work(
    tmp_path: Path, no_work: None
) -> None:
    out = tmp_path / "out"
    with another("claimed", out):
        before = contents(tmp_path)
        for verb in set(AT_ONCE) - {"predict"}:
            said = refused(AT_ONCE[verb], out)
            assert "another process is working on this output folder" in said, verb
            assert contents(tmp_path) == before
    # It was killed, and what it held is free at once.
    assert "another process" not in refused(AT_ONCE["fit"], out)


def test_a_second_process_that_lands_results_is_refused(
    no_work: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    # That the folder is not empty is another reason, told first.
    monkeypatch.setattr("calib.validation.sbc._claim", lambda *_: None)
    monkeypatch.setattr("calib.batch.campaign.run.check_folder", lambda *_: None)
    inside = {"sbc": "replicates", "campaign": "results", "run": "", "make": "",
              "well-specified": ""}  # fmt: skip
    for folder in dict.fromkeys(inside.values()):
        with another("alone", Path(f"out of {folder}", folder)):
            for verb in (verb for verb, its in inside.items() if its == folder):
                said = refused(LANDING[verb], Path(f"out of {folder}"))
                assert "another process is writing results to this folder" in said, verb


def test_what_was_claimed_is_written(tmp_path: Path) -> None:
    with claimed(tmp_path / "out"), fresh_folder(tmp_path / "out") as folder:
        (folder / "run.json").write_text("{}", encoding="utf-8")
        with pytest.raises(CalibError, match="another process"), claimed(tmp_path / "out"):
            pass
    assert contents(tmp_path / "out") == {"run.json"}
    with claimed(tmp_path / "nothing"):
        pass
    assert [path.name for path in tmp_path.glob("*nothing*")] == []
