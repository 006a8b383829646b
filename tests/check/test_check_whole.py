"""What is tampered with in the gaps, the audit, the tables and the methods is found and named."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from calib.checking.check import check
from calib.checking.compare import Status
from calib.he2019.audit import audit_csv
from tests.check.conftest import different, edit_json, findings, in_text, seal, swap_figures

pytestmark = pytest.mark.usefixtures("computed_once")

GAP = "summary.json: paper_gaps.plain_bekker"
DIAGNOSIS = "gaps/plain_bekker/diagnosis.json"
PAGE = "gaps/plain_bekker/index.html"
BOTH = f"summary.json and {DIAGNOSIS}"
PICTURE = re.compile(r"(data:image/png;base64,)([A-Za-z0-9+/=]*)")


@pytest.mark.slow  # so is the reference report, under three kernels
def test_an_untouched_report_is_the_same(whole: Path) -> None:
    outcome = check(whole)
    assert different(outcome) == {}
    assert not outcome.draws_differ  # though another processor made it
    names = {item.name for item in outcome.items}
    there = {p.relative_to(whole).as_posix() for p in whole.rglob("*") if p.is_file()}
    assert there <= {name.partition(": ")[0] for name in names}
    assert f"{GAP}.probability.slip_sinkage" in names
    assert f"{GAP}.checks.kept_out_rows.rmse_after_mm" in names
    # As files, and made again from what they show.
    for name in ("audit.csv", "tables/posterior.csv", "methods.tex", "references.bib"):
        assert sum(item.name == name for item in outcome.items) == 2
    assert BOTH in names


# Tampering


def change_gap(whole: Path) -> None:
    edit_json(whole / "summary.json", lambda s: move(gap_of(s)["probability"], "none", 0.06))


def gap_of(summary: dict[str, Any]) -> dict[str, Any]:
    return summary["paper_gaps"]["plain_bekker"]


def move(entry: dict[str, Any], key: str, by: float) -> None:
    entry[key] += by


def change_check(whole: Path) -> None:
    edit_json(
        whole / "summary.json",
        lambda s: move(gap_of(s)["checks"]["kept_out_rows"], "rmse_after_mm", -0.5),
    )


def change_shrink_everywhere(whole: Path) -> None:
    """In the summary and in the diagnosis alike."""
    edit_json(
        whole / "summary.json", lambda s: move(gap_of(s)["shrink"]["rut_depth"], "fraction", -0.2)
    )
    edit_json(whole / DIAGNOSIS, lambda d: move(d["shrink"]["rut_depth"], "fraction", -0.2))


def change_where(whole: Path) -> None:
    edit_json(whole / DIAGNOSIS, lambda d: move(d["where"][3], "probability", -0.3))


def change_corrected(whole: Path) -> None:
    path = whole / "gaps/plain_bekker/corrected.json"
    content = json.loads(path.read_text())
    content["fits"][0]["sample"] = [[1.1 * v for v in row] for row in content["fits"][0]["sample"]]
    path.write_text(json.dumps(content) + "\n")


def change_lab_mode(whole: Path) -> None:
    path = whole / "gaps/plain_bekker/corrected.json"
    content = json.loads(path.read_text())
    content["lab_mode"]["rut_depth"][0] += 0.02  # two per cent of the rut depth
    path.write_text(json.dumps(content) + "\n")


def change_case(whole: Path) -> None:
    path = whole / "gaps/plain_bekker/case/field.csv"
    *rows, last = path.read_text().splitlines()
    *cells, value = last.split(",")
    path.write_text("\n".join([*rows, ",".join([*cells, repr(float(value) + 0.1)])]) + "\n")


def change_prediction(whole: Path) -> None:
    path = whole / "gaps/plain_bekker/fresh_prediction.csv"
    *rows, last = path.read_text().splitlines()
    *cells, value = last.split(",")
    path.write_text("\n".join([*rows, ",".join([*cells, repr(float(value) * 1.05)])]) + "\n")


def swap_pictures_of_a_gap(whole: Path) -> None:
    path = whole / PAGE
    pictures = PICTURE.findall(path.read_text())
    assert len(pictures) > 2
    order = iter([pictures[1], pictures[0], *pictures[2:]])
    path.write_text(PICTURE.sub(lambda _: "".join(next(order)), path.read_text()))


def change_verdict(whole: Path) -> None:
    """In the audit as JSON and as CSV alike."""

    def change(audit: dict[str, Any]) -> None:
        assert audit["findings"][0]["verdict"] == "contradicted"
        audit["findings"][0]["verdict"] = "confirmed"

    edit_json(whole / "audit.json", change)
    rewrite_audit_csv(whole)


def rewrite_audit_csv(whole: Path) -> None:
    found = json.loads((whole / "audit.json").read_text())
    (whole / "audit.csv").write_text(audit_csv(found), encoding="utf-8")


def change_audit_number(whole: Path) -> None:
    def change(audit: dict[str, Any]) -> None:
        found = next(f for f in audit["findings"] if f["key"] == "table5_joint_cost")["found"]
        move(found[-1], "value", 0.01)

    edit_json(whole / "audit.json", change)
    rewrite_audit_csv(whole)


def change_sensitivity(whole: Path) -> None:
    edit_json(whole / "summary.json", lambda s: move(sensitivity_of(s), "likelihood", 0.5))


def sensitivity_of(summary: dict[str, Any]) -> dict[str, Any]:
    return summary["models"]["rut_depth"]["prior_sensitivity"]["parameters"]["n1"]


def change_reading(whole: Path) -> None:
    edit_json(whole / "summary.json", lambda s: sensitivity_of(s).update(identified=False))


def remove_file(name: str) -> Callable[[Path], None]:
    return lambda whole: (whole / name).unlink()


SENSITIVITY = "summary.json: models.rut_depth.prior_sensitivity.parameters.n1"
AUDIT = "audit.json: findings.table5_joint_cost"
AUDIT_FIGURES = ("figures/audit_costs.png", "figures/audit_rut.png")
PRINTS = ("figures/rut_depth_bands.pdf", "figures/rut_depth_learned.pdf")
TAMPERING: dict[str, tuple[Callable[[Path], None], str, list[str]]] = {
    # How; the file whose hash does not fit; what is named when all hashes are forged.
    "a gap's probability": (change_gap, "summary.json", [f"{GAP}.probability.none", BOTH]),
    "a gap's check": (
        change_check, "summary.json", [f"{GAP}.checks.kept_out_rows.rmse_after_mm"]),
    "a gap's shrink, everywhere": (
        change_shrink_everywhere, DIAGNOSIS,
        [f"{GAP}.shrink.rut_depth.fraction", f"{DIAGNOSIS}: shrink.rut_depth.fraction"]),
    "where a gap lies": (change_where, DIAGNOSIS, [f"{DIAGNOSIS}: where.3.probability"]),
    "a corrected model": (
        change_corrected, "gaps/plain_bekker/corrected.json",
        ["gaps/plain_bekker/corrected.json"]),
    "what a corrected model has of the laboratory": (
        change_lab_mode, "gaps/plain_bekker/corrected.json",
        ["gaps/plain_bekker/corrected.json: lab_mode.rut_depth.0"]),
    "a row of a gap": (
        change_case, "gaps/plain_bekker/case/field.csv",
        ["gaps/plain_bekker/case/field.csv: 13.rut_depth_mm"]),
    "a prediction": (
        change_prediction, "gaps/plain_bekker/fresh_prediction.csv",
        ["gaps/plain_bekker/fresh_prediction.csv: 6.rut_depth_mm_after_upper"]),
    "two pictures of a gap": (
        swap_pictures_of_a_gap, PAGE, [PAGE]),
    "a verdict of the audit": (
        change_verdict, "audit.json", [f"{AUDIT}.verdict"]),
    "a number of the audit": (
        change_audit_number, "audit.json",
        [f"{AUDIT}.found.minimum on the reconstructed data.value"]),
    "the audit as CSV": (
        in_text("audit.csv", "contradicted", "confirmed"), "audit.csv", ["audit.csv"]),
    "two figures of the audit": (
        swap_figures(*AUDIT_FIGURES, page=True), AUDIT_FIGURES[0], [*AUDIT_FIGURES, "index.html"]),
    "two figures for print": (
        swap_figures(*PRINTS), PRINTS[0], [*PRINTS]),
    "a table": (
        in_text("tables/posterior.csv", ",yes\n", ",no\n"), "tables/posterior.csv",
        ["tables/posterior.csv"]),
    "a table in LaTeX": (
        in_text("tables/validation.tex", "9", "8"), "tables/validation.tex",
        ["tables/validation.tex"]),
    "a missing table": (
        remove_file("tables/convergence.csv"), "tables/convergence.csv",
        ["tables/convergence.csv"]),
    "the methods": (
        in_text("methods.txt", "reconstructed", "measured"), "methods.txt", ["methods.txt"]),
    "a sensitivity": (change_sensitivity, "summary.json", [f"{SENSITIVITY}.likelihood"]),
    "what is read off it": (change_reading, "summary.json", [f"{SENSITIVITY}.identified"]),
    "a missing diagnosis": (remove_file(DIAGNOSIS), DIAGNOSIS, [DIAGNOSIS]),
}  # fmt: skip
WRITTEN = (
    "a gap's probability", "the audit as CSV", "a table", "a table in LaTeX", "a missing table",
    "the methods",
)  # fmt: skip


# Pages and figures are drawn again for these, which takes longest; others are named the same way.
DRAWN = ("two pictures of a gap", "two figures of the audit")


@pytest.mark.parametrize(
    "what",
    [pytest.param(what, marks=pytest.mark.slow) if what in DRAWN else what for what in TAMPERING],
)
def test_what_fits_a_forged_hash_is_found_by_computing_again(
    request: pytest.FixtureRequest, what: str
) -> None:
    tamper, name, names = TAMPERING[what]
    # Figures are judged where numbers are the same to the last bit.
    drawn = "figure" in what or "picture" in what
    whole = request.getfixturevalue("whole_here" if drawn else "whole")
    tamper(whole)
    if what in WRITTEN:
        # What is written from other files is checked against them, without computing again.
        assert {name, names[-1]} <= set(findings(whole, quick=True))
    # A forger of numbers writes their tables again; one of tables does not.
    seal(whole, rewrite=names[0].startswith("summary.json"))
    outcome = check(whole)
    assert outcome.exit_code == 1
    assert set(different(outcome)) == set(names)


def test_a_section_that_was_taken_out_is_missed(whole: Path) -> None:
    """The gaps, from every file that can be written again without computing anything."""
    shutil.rmtree(whole / "gaps")
    for path in whole.glob("figures/gap_*"):
        path.unlink()
    edit_json(whole / "summary.json", lambda s: s.pop("paper_gaps"))
    edit_json(whole / "manifest.json", lambda m: m.pop("paper_gaps"))
    seal(whole)
    assert "index.html" in findings(whole)


def test_a_table_of_nothing_is_a_stranger(whole: Path) -> None:
    (whole / "tables/better.csv").write_text("n0,n1\n2.0,1.3\n")
    seal(whole)
    assert findings(whole, quick=True) == {"tables/better.csv": "it follows from nothing here"}


@pytest.mark.parametrize(
    ("name", "content"),
    [("audit.json", "{"), ("audit.json", "[]"), (DIAGNOSIS, "{"), (DIAGNOSIS, "[" * 100_000)],
)
def test_a_document_that_cannot_be_read_is_named(whole: Path, name: str, content: str) -> None:
    (whole / name).write_text(content)
    seal(whole)
    assert any(name in found for found in findings(whole))


def test_repeats_without_end_cannot_be_asked_for(whole: Path) -> None:
    from calib.errors import CalibError

    for change, words in (
        (lambda m: m["audit"]["seeds"].update(joint=10**9), "joint"),
        (lambda m: m["paper_gaps"].update({"../x": {"seed": 1}}), "not one of plain_bekker"),
    ):
        edit_json(whole / "manifest.json", change)
        with pytest.raises(CalibError, match=words):
            check(whole)
        edit_json(whole / "manifest.json", lambda m: m["audit"]["seeds"].update(joint=1))


# Where another processor rounds differently


def shaken(value: Any, by: float) -> Any:
    if isinstance(value, dict):
        return {key: shaken(entry, by) for key, entry in value.items()}
    if isinstance(value, list):
        return [shaken(entry, by) for entry in value]
    return value * (1.0 + by) if isinstance(value, float) else value


@pytest.fixture
def rounded(whole: Path) -> Path:
    """Every number of the gap and of the audit moved by a hundred-billionth."""

    def shake(document: dict[str, Any]) -> None:
        document.update(shaken(document, 1e-11))

    edit_json(whole / "summary.json", lambda s: s.update(paper_gaps=shaken(s["paper_gaps"], 1e-11)))
    for name in ("audit.json", DIAGNOSIS):
        edit_json(whole / name, shake)
    rewrite_audit_csv(whole)
    seal(whole)
    return whole


def test_rounding_is_no_difference(rounded: Path) -> None:
    outcome = check(rounded)
    assert different(outcome) == {}
    # Another processor made it: parameters of hypotheses that hardly count, regions, figures, and
    # the words of a page whose numbers moved within their tolerance, cannot be judged.
    unjudged = (".parameters.", ": regions.", "index.html", "figures/")
    assert all(any(u in i.name for u in unjudged) for i in outcome.of(Status.UNJUDGED))
    assert outcome.verdict.startswith("SAME up to rounding")


def test_among_rounded_numbers_wrong_ones_and_words_are_found(rounded: Path) -> None:
    wrong: dict[tuple[str, str], tuple[tuple[Any, ...], float]] = {
        ("summary.json", "probability.slip_sinkage"):
            (("paper_gaps", "plain_bekker", "probability", "slip_sinkage"), -0.1),
        ("summary.json", "parameters.growth.mean"):
            (("paper_gaps", "plain_bekker", "parameters", "growth", "mean"), 0.2),
        ("summary.json", "rows.field"): (("paper_gaps", "plain_bekker", "rows", "field"), 1),
        (DIAGNOSIS, "where.0.gap"): (("where", 0, "gap"), 5.0),
        ("audit.json", ".upper"): (("findings", 0, "found", 0, "upper"), 0.01),
    }  # fmt: skip
    for (name, _), (place, by) in wrong.items():

        def change(document: Any, place: tuple[Any, ...] = place, by: float = by) -> None:
            for key in place[:-1]:
                document = document[key]
            document[place[-1]] += by

        edit_json(rounded / name, change)
    words = {"verdict": "effect", "best": "slip_sinkage", "withheld": "slip_sinkage"}
    for key, word in words.items():
        in_text("summary.json", f'"{key}": "{word}"', f'"{key}": "none"')(rounded)
    rewrite_audit_csv(rounded)
    seal(rounded)
    found = findings(rounded)
    for name, end in wrong:
        assert any(item.startswith(f"{name}: ") and item.endswith(end) for item in found), end
    assert {f"{GAP}.{key}" for key in words} <= set(found)
