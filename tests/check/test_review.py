"""`calib report --reviewer`: a page of a run, a comparison and a diagnosis, and of one altered."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from calib.checking.check import Outcome, check
from calib.checking.review import review
from calib.models import example_csv
from tests.check import made
from tests.commands import Calib, assert_refused, calib  # noqa: F401
from tests.docs.pages import told
from tests.gap_files import gap_files

ROOT = Path(__file__).parents[2]


def reviewed(calib: Calib, folder: str, *, code: int) -> tuple[dict[str, Any], str]:  # noqa: F811
    ran = calib("report", folder, "--reviewer", "--overwrite", "--workers", 1)
    assert ran.code == code, ran
    assert ran.out.splitlines()[-1] == "calib-review/index.html"
    page = Path("calib-review/index.html").read_text(encoding="utf-8")
    return json.loads(Path("calib-review/review.json").read_bytes()), page


def test_a_run_and_the_same_with_a_reading_changed(calib: Calib) -> None:  # noqa: F811
    Path("ruts.csv").write_text(example_csv("bekker"), encoding="utf-8")
    assert calib("fit", "ruts.csv", "--model", "bekker", "--out", "run").code == 0
    found, page = reviewed(calib, "run", code=0)
    assert found.keys() - {"schema"} <= told()
    assert found["verdict"].startswith("SAME")
    assert found["differs"]["note"].startswith("Nothing differs.")
    claims = dict(found["claimed"]["rows"])
    assert {"verdict", "to be trusted", "not to be trusted", "z_ref", "sigma"} <= set(claims)
    assert re.fullmatch(r"[\d.]+ mm \(95 %: [\d.]+ to [\d.]+\)", claims["z_ref"])
    assert found["not_judged"]["rows"][0][0] == "whether the measurements are true"
    for heading in ("claimed", "computed again", "differs", "cannot be judged"):
        assert re.search(f"<h2>What (was )?{heading}</h2>", page)
    assert "calib report run --reviewer" in page

    data = Path("run/data.csv")
    data.write_text(data.read_text(encoding="utf-8").replace("1", "2"), encoding="utf-8")
    found, page = reviewed(calib, "run", code=1)
    assert (found["tone"], found["verdict"][:9]) == ("no", "DIFFERENT")
    first = found["differs"]["rows"][0]
    assert (first[0], first[3]) == ("data.csv", "changed")
    assert "not shown here" in found["differs"]["note"]
    assert found["verdict"] in page


def test_without_a_folder_it_is_the_report_that_was_written_last(calib: Calib) -> None:  # noqa: F811
    assert_refused(calib("report", "--reviewer"), ["calib-report", "there is no such folder"])
    assert_refused(calib("report", "a", "b", "--reviewer"), ["several folders"])
    assert not Path("calib-review").exists()


@pytest.mark.slow
def test_what_other_folders_claim(tmp_path: Path) -> None:
    gap = gap_files("nominal_slip")
    found = review(gap, Outcome(str(gap), "diagnosis", True, (), {}))
    claims = dict(found["claimed"]["rows"])
    assert claims["verdict"] == "effect"
    assert re.match(r"probability (above )?\d+ %, radius_error 0\.02", claims["slip_zero_shift"])
    assert found["data_label"] == "reconstructed"
    assert ["the posterior", "sampling was left out (--quick)"] in found["not_judged"]["rows"]

    made.comparison(tmp_path / "compared")
    found = review(tmp_path / "compared", check(tmp_path / "compared", quick=True))
    rows = found["claimed"]["rows"]
    assert {name for name, _ in rows} >= {"verdict", "bekker", "bekker_plate"}
    assert all("elpd" in said and "weight" in said for _, said in rows[1:])

    report = ROOT / "reports" / "he2019"
    found = review(report, check(report, quick=True))
    claims = dict(found["claimed"]["rows"])
    assert claims["rut_depth"].startswith("modified_bekker: 90 % band covers 100 % of 9 rows")
    assert re.match(r"\d+ contradicted, ", claims["audit"])
    whose = {what for what, _ in found["not_judged"]["rows"]}
    assert {"assumptions of drawbar_pull", "prediction of bulk_density"} <= whose
