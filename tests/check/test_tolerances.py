"""The table of tolerances: every row is used, and what each lets pass, and what not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from calib.checking.compare import SUMMARY, Status, compare_entries, flatten
from calib.checking.tolerances import TABLE, compiled, tolerance_of
from tests.gap_files import gap_files

REPORT = Path(__file__).resolve().parents[2] / "reports" / "he2019"


def entries(name: str) -> dict[tuple[str, ...], Any]:
    """Those of the committed report, or of a diagnosis that belongs into one."""
    folder, _, file = name.rpartition("/")
    path = gap_files(folder.partition("/")[2]) / file if folder else REPORT / name
    text = path.read_text()
    if not name.endswith(".json"):
        header, first = (line.split(",") for line in text.splitlines()[:2])
        row = zip(header, first, strict=True)
        return {(name, "0", c): v if c == "data_label" else float(v) for c, v in row}
    return dict(flatten(json.loads(text), (name,)))


def test_every_row_of_the_table_is_used() -> None:
    """By the embedded data's report, or by what a run or a comparison has."""
    # Of entries that differ by their position alone one stands for all.
    alike = {
        tuple("0" if key.isdecimal() else key for key in path)
        for name in (
            SUMMARY,
            "manifest.json",
            "audit.json",
            "gaps/held_out_pull/diagnosis.json",
            DIAGNOSIS,
            "gaps/plain_bekker/fresh_prediction.csv",
        )
        for path in entries(name)
    }
    paths = ["/".join(path) for path in alike]
    paths += [
        "diagnosis.json/warnings/0", "gaps/plain_bekker/corrected.json/lab_mode/rut_depth/0",
        "run.json/estimates/0/cost", "run.json/estimates/0/reported/n0",
        "run.json/estimates/0/theta/1", "run.json/shape/0",
        "summary.json/models/rut_depth/sampling/reasons/0",
        "summary.json/models/bulk_density/validation/refitted/0", "comparison.json/verdict",
        *(f"comparison.json/models/reece/{x}" for x in ("elpd", "pareto_k_max", "weight")),
        "comparison.json/models/reece/told_apart", "summary.json/models/rut_depth/warnings/0",
        *(
            f"summary.json/models/rut_depth/noise/against_normal/{x}"
            for x in ("elpd_difference", "preferred", "sentence")
        ),
    ]  # fmt: skip
    first = {
        next((i for i, (p, _) in enumerate(TABLE) if compiled(p).fullmatch(x)), None) for x in paths
    }
    unused = [TABLE[i][0] for i in range(len(TABLE)) if i not in first]
    assert unused == []


def judged(name: str, place: tuple[str, ...], by: Any) -> Status:
    """What becomes of an entry of the committed report that is moved."""
    found = entries(name)
    recorded = dict(found)
    old = recorded[name, *place]
    recorded[name, *place] = by if isinstance(by, str) else old + by
    (item,) = (i for i in compare_entries(recorded, found) if i.status is not Status.IDENTICAL)
    return item.status


BEKKER, DIAGNOSIS = ("paper_gaps", "plain_bekker"), "gaps/plain_bekker/diagnosis.json"
N1 = ("models", "rut_depth", "prior_sensitivity", "parameters", "n1")


@pytest.mark.parametrize(
    ("name", "place", "little", "much"),
    [
        (SUMMARY, (*BEKKER, "probability", "slip_sinkage"), -0.03, -0.06),
        (SUMMARY, (*BEKKER, "parameters", "growth", "mean"), 0.05, 0.2),
        (SUMMARY, (*BEKKER, "shrink", "rut_depth", "fraction"), 0.05, -0.15),
        (SUMMARY, (*BEKKER, "shrink", "rut_depth", "interval", "0"), -0.15, -0.3),
        (SUMMARY, (*BEKKER, "open_sd_rms"), 1e-2, 0.1),
        (SUMMARY, (*BEKKER, "rows", "field"), None, 1),
        (SUMMARY, (*BEKKER, "verdict"), None, "none"),
        (SUMMARY, (*N1, "likelihood"), 0.1, 0.4),
        (SUMMARY, (*N1, "contraction"), 0.05, -0.3),
        (SUMMARY, (*N1, "reading"), None, "data"),
        (SUMMARY, ("models", "rut_depth", "estimates", "least_squares", "n0"), 1e-3, 1e-2),
        (SUMMARY, ("models", "rut_depth", "fit", "least_squares", "cost"), 1e-9, 1e-5),
        (SUMMARY, ("models", "rut_depth", "sampling", "mode", "n1"), 1e-3, 1e-2),
        (DIAGNOSIS, ("where", "0", "gap"), 1e-3, 5.0),
        (DIAGNOSIS, ("where", "0", "row"), None, 1),
        ("audit.json", ("findings", "table5_joint_cost", "found", "minimum at any slips", "upper"),
         1e-5, 1e-3),
        ("audit.json", ("findings", "table5_joint_cost", "verdict"), None, "confirmed"),
        ("gaps/plain_bekker/fresh_prediction.csv", ("0", "rut_depth_mm_after"), 1e-3, 2.0),
    ],
)  # fmt: skip
def test_what_a_row_lets_pass(name: str, place: tuple[str, ...], little: Any, much: Any) -> None:
    if little is not None:
        assert judged(name, place, little) is Status.WITHIN
    assert judged(name, place, much) is Status.DIFFERENT


def test_ends_of_shares_are_not_judged_where_a_twentieth_of_the_draws_hangs_on_them() -> None:
    """The upper one of a cause that hardly counts, the lower one of one that nearly surely acts."""
    for p, upper, lower in ((0.02, False, True), (0.5, True, True), (0.95, True, False)):
        above = ("gaps/plain_bekker/diagnosis.json", "inclusion", "slip_sinkage")
        found = {(*above, "probability"): p}
        ends = [tolerance_of((*above, "share_interval", end), found).judged for end in "10"]
        assert ends == [upper, lower]


def test_parameters_of_a_hypothesis_that_hardly_counts_are_not_judged() -> None:
    found = entries(DIAGNOSIS)
    mean = ("effects", "rut_rebound", "parameters", "strength", "mean")
    place = next(p[1:] for p in found if p[1:3] == mean[:2] and p[-1] == "mean")
    assert judged(DIAGNOSIS, place, 100.0) is Status.UNJUDGED
    assert not tolerance_of((DIAGNOSIS, *place), found).judged
