"""The command line: what works, what is refused, and what is left behind."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from calib.inference.prior_files import default_priors
from calib.models import MODELS, example_csv, template_csv
from calib.report.writer import file_hashes
from tests.commands import Calib, Ran, assert_refused, contents

RUT = example_csv("modified_bekker")
PRESSURES = example_csv("magic_formula_pressure")


# What works


@pytest.fixture(scope="module")
def he2019(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from calib.he2019 import embedded

    folder = tmp_path_factory.mktemp("he2019")
    embedded.write(folder)
    return folder


def test_fit_predict_and_read_the_numbers(calib: Calib, he2019: Path, tmp_path: Path) -> None:
    fitted = calib(
        "fit", he2019 / "rut_depth.csv", "--model", "modified_bekker", "--out", "run",
        "--hold-out", "inflation_pressure_psi=30", "--seed", 7,
    )  # fmt: skip
    assert fitted.code == 0, fitted.err
    for words in ("z_ref", "converged: 4 ensembles", "90 % band covers", "of 9", "run folder: run"):
        assert words in fitted.out
    assert "NOT CONVERGED" not in fitted.out
    assert contents(tmp_path) == {
        "run", "run/data.csv", "run/posterior.nc", "run/priors.toml", "run/run.json",
    }  # fmt: skip

    Path("at.csv").write_text(
        "slip_percent,average_ground_pressure_kpa\n5,140\n10,140\n20,140\n60,140\n"
    )
    printed = calib("predict", "run", "--at", "at.csv")
    assert printed.code == 0
    lines = [line.split(",") for line in printed.out.splitlines()]
    header, *rows = lines
    assert len(rows) == 4
    assert "calib: 1 row lies outside the calibrated range" in printed.err
    assert "calib: at.csv, line 5: slip_percent = 60, calibrated from " in printed.err
    assert [row[-1] for row in rows] == ["", "", "", "slip_ratio"]
    assert [row[header.index("data_label")] for row in rows] == ["reconstructed"] * 4
    number = {
        name: [float(row[i]) for row in rows]
        for i, name in enumerate(header[:-1])
        if name != "data_label"
    }
    # Within 10 % of Eq 21 at Table 6: the likelihood differs from the published regression.
    published = [1000 * (140 / 3.306e5) ** (1 / (1.996 + 1.266 * s)) for s in (0.05, 0.1, 0.2)]
    np.testing.assert_allclose(number["rut_depth_mm_median"][:3], published, rtol=0.1)
    for level in (50, 90, 95):
        for kind in ("parameter", "predictive"):
            low, high = (number[f"rut_depth_mm_{kind}_{level}_{e}"] for e in ("lower", "upper"))
            assert all(a < b for a, b in zip(low, high, strict=True))

    written = calib("predict", "run", "--at", "at.csv", "--out", "bands.csv")
    assert written.code == 0
    assert written.out == "4 rows written to bands.csv\n"
    assert "1 row lies outside the calibrated range" in written.err
    lines = Path("bands.csv").read_text().splitlines()
    assert lines[0].split(",") == header
    # No more digits than are printed.
    assert lines == printed.out.splitlines()


def test_fit_names_a_reading_that_is_far_off(calib: Calib, he2019: Path) -> None:
    """By the name and in the unit that the file has."""
    header, *rows = (he2019 / "rut_depth.csv").read_text().splitlines()
    at = header.split(",").index("rut_depth_mm")
    table = [row.split(",") for row in rows]
    for i, cells in enumerate(table):
        cells[at] = f"{(10.0 if i == 10 else 1.0) * float(cells[at]) / 10.0:.4f}"
    lines = [header.replace("rut_depth_mm", "Rut depth [cm]"), *map(",".join, table)]
    Path("my.csv").write_text("\n".join(lines) + "\n")
    ran = calib("fit", "my.csv", "--model", "modified_bekker", "--out", "run", "--max-steps", 200)
    reading = float(table[10][at])
    assert f"my.csv, line 12: Rut depth [cm] = {reading:.4g} is" in ran.err
    assert "check the reading" in ran.err


def test_a_run_that_does_not_converge_says_so_and_ends_with_3(calib: Calib, tmp_path: Path) -> None:
    Path("my.csv").write_text(PRESSURES)
    found = calib(
        "fit", "my.csv", "--model", "magic_formula_pressure", "--max-steps", 100, "--out", "run"
    )
    assert found.code == 3
    assert "NOT CONVERGED, do not use these numbers" in found.out
    assert "Raise --max-steps" in found.out
    assert json.loads(Path("run/run.json").read_text())["gate"]["steps"] == 100
    Path("at.csv").write_text("slip_ratio,inflation_pressure_psi\n0.1,30\n")
    predicted = calib("predict", "run", "--at", "at.csv")
    assert predicted.code == 3
    header, row = predicted.out.splitlines()
    assert (header.split(",")[-1], row.split(",")[-1]) == ("converged", "no")
    assert "did not converge; its bands are not to be used" in predicted.err


def test_an_earlier_run_is_replaced_on_request_only(calib: Calib, run: Path) -> None:
    command = ["fit", "my.csv", "--model", "modified_bekker", "--out", run, "--max-steps", 100]
    refused = calib(*command)
    assert refused.code == 2
    assert "--overwrite" in refused.err
    command.append("--overwrite")
    Path("run/notes.txt").write_text("mine")
    kept = calib(*command)
    assert kept.code == 2
    assert "notes.txt" in kept.err
    assert Path("run/notes.txt").read_text() == "mine"
    Path("run/notes.txt").unlink()
    assert calib(*command).code == 0


def test_a_changed_run_is_not_predicted_from(calib: Calib, run: Path) -> None:
    Path("run/data.csv").write_text(Path("run/data.csv").read_text().replace("0.1", "0.2"))
    refused = calib("predict", "run", "--at", "my.csv")
    assert refused.code == 2
    assert "data.csv" in refused.err
    assert "changed since the run was written" in refused.err


def test_own_priors_are_used(calib: Calib) -> None:
    assert calib("priors", "modified_bekker", "--out", "mine.toml").code == 0
    text = Path("mine.toml").read_text()
    tight = text.replace("mean = 0.5\nsd = 0.75", "mean = -1.0\nsd = 0.01")
    assert tight != text
    Path("mine.toml").write_text(tight)
    Path("my.csv").write_text(RUT)
    ran = calib("fit", "my.csv", "--model", "modified_bekker", "--priors", "mine.toml")
    assert ran.code == 0
    n1 = next(line for line in ran.out.splitlines() if " n1 " in line)
    assert "1.0" in n1
    assert "not identified" in n1
    assert Path("calib-run/priors.toml").read_text() == tight


@pytest.mark.parametrize("model", ["bekker", "wong_reece_pull"])
def test_templates_and_priors_are_printed(calib: Calib, model: str) -> None:
    template = calib("template", model)
    assert template.out == template_csv(model)
    assert "run_order may be left out" in template.err
    printed = calib("priors", model).out
    assert tomllib.loads(printed)["model"] == model
    assert printed == default_priors(model).read_text(encoding="utf-8")


@pytest.mark.parametrize("verb", ["template", "priors"])
def test_templates_and_priors_are_written_once(calib: Calib, verb: str) -> None:
    assert calib(verb, "bekker", "--out", f"{verb}.txt").code == 0
    assert Path(f"{verb}.txt").read_text(encoding="utf-8") == calib(verb, "bekker").out
    again = calib(verb, "bekker", "--out", f"{verb}.txt")
    assert again.code == 2
    assert f"{verb}.txt: the file exists already" in again.err


def test_the_embedded_data_are_written_and_called_reconstructed(calib: Calib, he2019: Path) -> None:
    written = calib("data", "he2019", "--out", "he/data")
    assert written.code == 0
    assert written.out.count("reconstructed from published results, not measured") == 3
    for path in he2019.iterdir():
        assert Path("he/data", path.name).read_bytes() == path.read_bytes()
    assert "exist there already" in calib("data", "he2019", "--out", "he/data").err
    assert calib("data", "he2019", "--out", "he/data", "--overwrite").code == 0


@pytest.mark.usefixtures("_one_figure")
def test_a_report_of_own_data_is_complete_and_its_hashes_hold(
    calib: Calib, he2019: Path, tmp_path: Path
) -> None:
    """One output works; the other has too few rows, which ends with 1 and leaves the first."""
    Path("few.csv").write_text("slip_ratio,drawbar_pull_kn\n0.1,1\n0.2,1.1\n")
    before = contents(tmp_path)
    ran = calib(
        "report", he2019 / "rut_depth.csv", "few.csv", "--out", "rep",
        "--hold-out", "inflation_pressure_psi=30", "--workers", 1,
    )  # fmt: skip
    assert ran.code == 1, ran.err
    assert "rut_depth: converged; 90 % band covers" in ran.out
    assert "drawbar_pull: FAILED" in ran.err
    assert "2 rows cannot calibrate magic_formula" in ran.err
    assert {p for p in contents(tmp_path) - before if "/" not in p} == {"rep"}
    rep = Path("rep")
    manifest = json.loads((rep / "manifest.json").read_text())
    assert manifest["files"] == file_hashes(rep)
    assert manifest["command"][:2] == ["calib", "report"]
    summary = json.loads((rep / "summary.json").read_text())
    assert summary["models"]["rut_depth"]["validation"]["n"] == 9
    assert "error" in summary["models"]["drawbar_pull"]
    assert {"index.html", "rut_depth.nc", "data/rut_depth.csv", "priors/rut_depth.toml"} <= set(
        manifest["files"]
    )
    # What the embedded report says of its source.
    assert "paper_gaps" not in summary
    assert "paper-gaps" not in (rep / "index.html").read_text()
    assert not (rep / "gaps").exists()


# What is refused


def edited(text: str, line: int, old: str, new: str) -> str:
    lines = text.splitlines()
    assert old in lines[line - 1]
    lines[line - 1] = lines[line - 1].replace(old, new)
    return "\n".join(lines) + "\n"


def at_one_pressure() -> str:
    return PRESSURES.replace(",42,", ",18,").replace(",30,", ",18,")


# What else can be wrong in a file is tried where files are read.
BAD_DATA: dict[str, tuple[str, str | bytes, list[str]]] = {
    "misspelt column": ("modified_bekker", RUT.replace("rut_depth_mm", "rut_deph_mm"),
        ["rut_deph_mm", "did you mean"]),
    "unknown unit": ("modified_bekker", RUT.replace("_kpa", "_furlong"),
        ["line 1", "'furlong'", "average_ground_pressure_kpa"]),
    "text in a number": ("modified_bekker", edited(RUT, 4, "30.3", "deep"),
        ["line 4", "'rut_depth_mm'", "'deep' is not a number"]),
    "one row": ("modified_bekker", "\n".join(RUT.splitlines()[:2]),
        ["1 row cannot calibrate", "at least 5 rows"]),
    "one pressure": ("magic_formula_pressure", at_one_pressure(),
        ["inflation_pressure", "one inflation pressure only (18 psi)", "model magic_formula"]),
    "not text": ("modified_bekker", b"PK\x03\x04" + bytes(40), ["binary"]),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_DATA)
def test_bad_data(calib: Calib, tmp_path: Path, name: str) -> None:
    model, content, words = BAD_DATA[name]
    Path("my.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    ran = calib("fit", "my.csv", "--model", model, "--out", "run")
    assert_refused(ran, ["my.csv", "expected:", *words])
    assert contents(tmp_path) == {"my.csv"}


@pytest.mark.parametrize("name", ["text in a number", "unknown unit"])
def test_bad_data_of_a_report_and_a_prediction(
    calib: Calib, tmp_path: Path, name: str, rut_calibration
) -> None:
    from calib.inference.io import save_calibration

    _, content, words = BAD_DATA[name]
    Path("my.csv").write_text(str(content))
    ran = calib("report", "my.csv", "--out", "rep")
    assert_refused(ran, ["my.csv", *words])
    assert contents(tmp_path) == {"my.csv"}
    Path("run").mkdir()
    save_calibration(rut_calibration, Path("run"))
    if name == "text in a number":
        # A rut depth is not needed, and so not read, where it is to be predicted.
        Path("my.csv").write_text(edited(RUT, 4, "0.20", "fast"))
        words = ["line 4", "'slip_ratio'", "'fast' is not a number"]
    ran = calib("predict", "run", "--at", "my.csv", "--out", "bands.csv")
    assert_refused(ran, ["my.csv", *words])
    assert not Path("bands.csv").exists()
    Path("my.csv").write_text(RUT.replace("slip_ratio", "slip_percent"))
    ran = calib("predict", "run", "--at", "my.csv")
    assert_refused(ran, ["my.csv", "'slip_percent'", "readings are in fractions"])


def prior_text(old: str, new: str) -> str:
    text = default_priors("modified_bekker").read_text(encoding="utf-8")
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            prior_text("parameters.n0", "parameters.n9"),
            ["unknown parameter n9", "did you mean n0?", "z_ref, n0, n1, sigma"],
        ),
        (prior_text("sd = 0.75", "sd = 0.0"), ["parameters.n1", "sd", "greater than 0"]),
        (prior_text("sd = 0.75", "sd = -2"), ["parameters.n1", "sd", "-2", "greater than 0"]),
        (prior_text("sd_log = 1.0", "sd_log = 0"), ["parameters.z_ref", "sd_log"]),
        (prior_text("median = 25.0", "median = = 3"), ["not valid TOML", "line"]),
        (prior_text('"modified_bekker"', '"bekker"'), ["model 'bekker'", "'modified_bekker'"]),
        (prior_text('dist = "lognormal"', 'dist = "log"'), ["'log'", "lognormal"]),
    ],
)
def test_bad_priors(calib: Calib, tmp_path: Path, text: str, words: list[str]) -> None:
    Path("my.csv").write_text(RUT)
    Path("mine.toml").write_text(text, encoding="utf-8")
    ran = calib("fit", "my.csv", "--model", "modified_bekker", "--priors", "mine.toml")
    assert_refused(ran, ["mine.toml", *words])
    assert contents(tmp_path) == {"my.csv", "mine.toml"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fit", "absent.csv", "--model", "bekker"], ["absent.csv", "no such file"]),
        (["fit", ".", "--model", "bekker"], ["folder, not a file"]),
        (["fit", "my.csv", "--model", "pacejka"], ["'pacejka'", *MODELS]),
        (["fit", "my.csv", "--model", "modified_bekker", "--priors", "no.toml"],
         ["no.toml", "cannot be read"]),
        (["fit", "my.csv", "--model", "modified_bekker", "--out", "my.csv/run"],
         ["my.csv/run", "cannot be written", "is a file"]),
        (["fit", "my.csv", "--model", "modified_bekker", "--out", "my.csv"],
         ["my.csv", "existing file"]),
        (["fit", "my.csv", "--model", "modified_bekker", "--out", "thesis"],
         ["thesis", "exists and is not empty", "--overwrite"]),
        (["fit", "my.csv", "--model", "modified_bekker", "--out", "thesis", "--overwrite"],
         ["thesis", "not written by calib"]),
        (["fit", "my.csv", "--model", "modified_bekker", "--hold-out", "slip_ratio"],
         ["--hold-out 'slip_ratio'", "COLUMN=VALUE"]),
        (["fit", "my.csv", "--model", "modified_bekker", "--hold-out", "slip_ratio=fast"],
         ["slip_ratio=fast", "COLUMN=VALUE"]),
        (["fit", "my.csv", "--model", "modified_bekker", "--hold-out", "slip_ratio=0.33"],
         ["my.csv", "no row is at 0.33", "0, 0.1, 0.2"]),
        (["fit", "my.csv", "--model", "modified_bekker", "--hold-out", "slip=0.1"],
         ["--hold-out slip=0.1", "'slip'", "unit", "write one of these before the equals sign"]),
        (["fit", "my.csv", "--model", "modified_bekker", "--hold-out", "speed_m_s=1"],
         ["my.csv", "speed_m_s"]),
        (["report", "my.csv", "--hold-out", "slip_ratio=0.33"], ["my.csv", "no row is at 0.33"]),
        (["report", "my.csv", "--hold-out", "colour=1"], ["my.csv", "colour"]),
        (["report", "my.csv", "my.csv"], ["my.csv, my.csv", "two files give"]),
        (["report", "at.csv"], ["at.csv", "no output to calibrate"]),
        (["report", "--only", "torque"], ["'torque'", "bulk_density, drawbar_pull, rut_depth"]),
        (["report", "--hold-out", "slip_ratio=0.1"], ["--hold-out is for files", "leave --hold"]),
        (["report", "--model", "bekker"], ["--model is for files of your own", "give your CSV"]),
        (["report", "--priors", "p.toml"], ["--priors is for files of your own", "leave --priors"]),
        (["report", "my.csv", "--out", "my.csv/deep/rep"], ["my.csv/deep/rep", "is a file"]),
        (["report", "--out", "thesis"], ["thesis", "exists and is not empty"]),
        (["predict", "thesis", "--at", "at.csv"], ["thesis", "not a run folder", "calib fit"]),
        (["predict", "absent", "--at", "at.csv"], ["absent", "there is no such folder"]),
        (["template", "pacejka"], ["'pacejka'", *MODELS]),
        (["template", "bekker", "--out", "my.csv/t.csv"], ["my.csv/t.csv", "cannot be written"]),
        (["template", "bekker", "--out", "x" * 300], ["cannot be written"]),
        (["priors", "pacejka"], ["'pacejka'"]),
        (["priors", "bekker", "--out", "no/such/p.toml"], ["no/such/p.toml", "cannot be written"]),
        (["data", "he2020"], ["'he2020'", "he2019"]),
        (["data", "he2019", "--out", "my.csv/he"], ["my.csv/he", "cannot be written"]),
        (["data", "he2019", "--out", "my.csv"], ["my.csv", "cannot be written"]),
        (["data", "he2019", "--out", "odd", "--overwrite"], ["odd", "cannot be written"]),
    ],
)  # fmt: skip
def test_bad_arguments(calib: Calib, tmp_path: Path, arguments, words: list[str]) -> None:
    Path("my.csv").write_text(RUT)
    Path("at.csv").write_text("slip_ratio,average_ground_pressure_kpa\n0.1,140\n")
    Path("thesis").mkdir()
    Path("thesis/chapter1.tex").write_text("years of work")
    Path("odd/bulk_density.csv").mkdir(parents=True)  # a folder where a file is to go
    before = contents(tmp_path)
    assert_refused(calib(*arguments), words)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    "arguments",
    [
        ["fit", "my.csv"], ["fit"], ["predict", "run"], ["frobnicate"],
        ["fit", "my.csv", "--model", "bekker", "--seed", "-1"],
        ["fit", "my.csv", "--model", "bekker", "--seed", "x"],
        ["fit", "my.csv", "--model", "bekker", "--max-steps", "1"],
    ],
)  # fmt: skip
def test_bad_usage(calib: Calib, arguments: list[str]) -> None:
    ran = calib(*arguments)
    assert ran.code == 2
    assert ran.out == ""
    assert "Traceback" not in ran.err
    assert "Usage: calib" in ran.err


# As a process


def process(*arguments: str, code: str = "from calib.cli import main; main()") -> Ran:
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )
    return Ran(done.returncode, done.stdout, done.stderr)


def test_help_is_quick_because_nothing_heavy_is_imported() -> None:
    code = (
        "import sys\nfrom calib.cli import main\n"
        "try:\n    main()\nfinally:\n    print(*sorted(sys.modules), file=sys.stderr)"
    )
    for arguments in (["--help"], ["fit", "--help"]):
        ran = process(*arguments, code=code)
        assert ran.code == 0
        assert "Usage: " in ran.out
        heavy = {"numpy", "scipy", "arviz", "arviz_stats", "emcee", "matplotlib", "xarray", "pint"}
        assert heavy.isdisjoint(ran.err.split())


def test_the_command_is_installed() -> None:
    done = subprocess.run(
        [str(Path(sys.executable).with_name("calib")), "models"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0
    assert "modified_bekker" in done.stdout


def test_a_prediction_replaces_a_file_on_request_only(calib: Calib, run: Path) -> None:
    command = ("predict", "run", "--at", "my.csv", "--out")
    assert calib(*command, "p.csv").code == 0
    whole = Path("p.csv").read_text()
    assert "rut_depth_mm_median" in whole
    Path("p.csv").write_text(whole.splitlines()[0])
    assert_refused(calib(*command, "p.csv"), ["p.csv", "--overwrite"])
    assert calib(*command, "p.csv", "--overwrite").code == 0
    assert Path("p.csv").read_text() == whole


def test_a_prediction_never_replaces_its_conditions_nor_what_others_wrote(
    calib: Calib, run: Path
) -> None:
    Path("notes.txt").write_text("Tyre 3 was changed.\n")
    for out, words in (("my.csv", "conditions"), ("run/../my.csv", "conditions"),
                       ("notes.txt", "no prediction")):  # fmt: skip
        before = Path(out).read_bytes()
        refused = calib("predict", "run", "--at", "my.csv", "--out", out, "--overwrite")
        assert_refused(refused, [out, words, "another --out"])
        assert Path(out).read_bytes() == before


def test_a_dry_run_checks_the_input_and_computes_nothing(calib: Calib) -> None:
    Path("my.csv").write_text(RUT)
    ran = calib("fit", "my.csv", "--model", "modified_bekker", "--dry-run")
    assert ran.code == 0
    assert "rows of my.csv" in ran.out
    assert "parameters: z_ref, n0, n1, sigma" in ran.out
    assert "would write calib-run; nothing was computed" in ran.out
    assert not Path("calib-run").exists()
    Path("bad.csv").write_text(RUT.replace("rut_depth", "rut_dept"))
    assert calib("fit", "bad.csv", "--model", "modified_bekker", "--dry-run").code == 2


def test_a_dry_run_says_that_pressures_are_as_in_another_unit(calib: Calib) -> None:
    head, *rows = template_csv("magic_formula_pressure").splitlines()
    cells = [row.split(",") for row in rows]
    at = head.split(",").index("inflation_pressure_psi")
    for row in cells:
        row[at] = f"{6.894757 * float(row[at]):.0f}"
    Path("kpa.csv").write_text("\n".join([head, *map(",".join, cells)]) + "\n")
    ran = calib("fit", "kpa.csv", "--model", "magic_formula_pressure", "--dry-run")
    assert ran.code == 0
    assert "all would be inside if the readings are in kPa" in ran.out


def test_quiet_leaves_warnings_and_errors(calib: Calib) -> None:
    Path("my.csv").write_text(RUT)
    ran = calib("-q", "fit", "my.csv", "--model", "modified_bekker")
    assert ran.code == 0
    assert ran.out == ""
    assert Path("calib-run/run.json").exists()
    shown = calib("-q", "quantities", "rut_depth", "--json")
    assert json.loads(shown.out)["quantities"]
    failed = calib("-q", "fit", "nowhere.csv", "--model", "modified_bekker", "--overwrite")
    assert failed.code == 2
    assert "nowhere.csv" in failed.err
