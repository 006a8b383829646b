"""`calib import`: nothing is applied that was not shown, and nothing is left of what fails."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.commands import Calib, assert_refused, contents
from tests.imports.files import TTC, write


def test_a_suggestion_is_shown_and_applied_when_it_was_seen(calib: Calib) -> None:
    write(Path("run7.dat"), TTC)
    ran = calib("import", "run7.dat", "--out", "my.csv")
    assert ran.code == 2
    assert 'normal_load_n = {from = "FZ", unit = "N", factor = -1}' in ran.out
    assert "calib import run7.dat --mapping my.mapping.toml --out my.csv" in ran.err
    assert contents(Path()) == {"run7.dat", "my.mapping.toml"}
    assert Path("my.mapping.toml").read_text(encoding="utf-8") in ran.out
    ran = calib("import", "run7.dat", "--out", "my.csv", "--mapping", "my.mapping.toml")
    assert (ran.code, ran.err) == (0, "")
    assert "slip_ratio from slip_of_kappa of SR" in ran.out
    assert "2 rows written" in ran.out
    assert Path("my.png").read_bytes().startswith(b"\x89PNG")
    assert (
        Path("my.csv").read_text(encoding="utf-8").splitlines()[1].startswith("40.2,410.5,3000.0")
    )


def test_what_was_shown_can_be_accepted_at_once(calib: Calib) -> None:
    write(Path("run7.dat"), TTC)
    document = json.loads(calib("import", "run7.dat", "--out", "my.csv", "--yes", "--json").out)
    assert (document["rows_written"], document["unused"]) == (2, ["ET"])
    assert document["columns"]["drawbar_pull_n"] == "FX"
    assert contents(Path()) == {"run7.dat", "my.mapping.toml", "my.csv", "my.png"}
    assert calib("fit", "my.csv", "--model", "magic_formula", "--dry-run").code == 2  # too few rows


def test_nothing_is_left_of_what_fails(calib: Calib) -> None:
    write(Path("run7.dat"), TTC.replace("930", "broken"))
    mapping = write(Path("m.toml"), '[columns]\ndrawbar_pull_n = {from = "FX"}\n')
    ran = calib("import", "run7.dat", "--out", "my.csv", "--mapping", mapping)
    assert_refused(ran, ["line 5, column 'FX'", "'broken' is not a number"])
    assert contents(Path()) == {"run7.dat", "m.toml"}
    assert_refused(calib("import", "run8.dat", "--out", "my.csv"), ["run8.dat"])
    assert contents(Path()) == {"run7.dat", "m.toml"}


@pytest.mark.parametrize("there", ["my.csv", "my.png", "my.mapping.toml"])
def test_no_file_of_yours_is_replaced(calib: Calib, there: str) -> None:
    write(Path("run7.dat"), TTC)
    write(Path(there), "mine")
    assert_refused(calib("import", "run7.dat", "--out", "my.csv", "--yes"), [there])
    assert Path(there).read_text(encoding="utf-8") == "mine"


def test_a_file_is_not_replaced_by_what_is_read_of_it(calib: Calib) -> None:
    write(Path("my.csv"), "Slip [%],Pull [N]\n5,1\n")
    ran = calib("import", "my.csv", "--out", "my.csv", "--yes", "--overwrite")
    assert_refused(ran, ["my.csv"])
    assert contents(Path()) == {"my.csv"}


@pytest.mark.parametrize(
    "text",
    [
        "Rig: 7\n\nSlip [%],Drawbar pull [N]\n5,1\n",
        "Slip,Drawbar pull\n[%],[N]\n5,1\n",
        "Slip [%],Drawbar pull 1 [N],Drawbar pull 2 [N]\n5,1,2\n",
        "PK\x03\x04\x00",
    ],
)
def test_commands_that_refuse_a_rig_s_file_say_what_reads_it(calib: Calib, text: str) -> None:
    write(Path("rig.csv"), text)
    ran = calib("fit", "rig.csv", "--model", "magic_formula", "--out", "run")
    assert_refused(ran, ["calib import", "--out imported.csv"])


def test_files_of_one_rig_are_put_together(calib: Calib) -> None:
    for name in ("run7.dat", "run8.dat"):
        write(Path(name), TTC)
    calib("import", "run7.dat", "--out", "one.csv", "--yes")
    both = ["import", "run7.dat", "run8.dat", "--mapping", "one.mapping.toml", "--out", "my.csv"]
    ran = calib(*both)
    assert (ran.code, ran.err) == (0, "")
    assert "run 2: run8.dat" in ran.out
    header, *rows = Path("my.csv").read_text(encoding="utf-8").splitlines()
    assert header.endswith(",run")
    assert [row.rpartition(",")[2] for row in rows] == ["1", "1", "2", "2"]
    assert {"my_1.png", "my_2.png"} <= contents(Path())
    assert_refused(calib(*both), ["the file exists already"])
