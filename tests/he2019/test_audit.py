"""The whole audit: complete, ordered, honest about what it rests on; files, page and figures."""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from calib.he2019 import declared
from calib.he2019.audit import (
    Basis,
    Quantity,
    Seeds,
    Verdict,
    audit_csv,
    audit_json,
    run_audit,
)
from calib.he2019.figures import audit_plates
from calib.he2019.published import PUBLISHED
from calib.he2019.sections import audit_section, write_audit_page
from calib.report.figures.style import Plate
from tests.browser import faults
from tests.he2019.altered import flipped, printed_figures
from tests.pages import PNG, Reader


def test_every_printed_figure_is_judged(audit):
    judged = {figure for f in audit.findings for figure in f.figures}
    assert judged == set(printed_figures(PUBLISHED))


VERDICTS = {
    "contradicted": """table5_joint_cost table5_cost_as_printed table5_digits_of_BCD_and_E
        table6_consistency""",
    "corrected": """table3_initial_slope table3_curvature table5_sign_of_c9 table5_pressure_unit
        table5_digits_of_D table5_digits_of_pull table6_inverse_regression table6_likelihood
        table6_prediction_at_30""",
    "confirmed": """table1_exponent_of_C1 table3_18_sign_of_E table3_30_sign_of_E
        table3_42_sign_of_E table4_30_sign_of_E table4_42_sign_of_E table5_signs_of_D
        table5_signs_of_BCD table6_signs table5_signs_of_c7_c8 table4_digits genetic_by_pressure""",
    "consistent": """table1_quality table3_features table3_costs table4_18_sign_of_E table5_b0
        table6_fitted_errors table6_held_out_errors""",
    "cannot be tested": """table1_sign_of_C3 table1_unit_of_cone_index table1_values table3_reading
        ground_pressure test_description""",
}


def test_every_claim_has_its_verdict_the_gravest_first(audit):
    # Few seeds say nothing of the joint search.
    found = [f for f in audit.findings if f.key != "genetic_joint"]
    expected = [(key, verdict) for verdict, keys in VERDICTS.items() for key in keys.split()]
    assert [(f.key, f.verdict.value) for f in found] == expected
    # Those of two claims are made for each table and row apart, under names of their own.
    claims = set(declared("audit/claims.toml")) - {"sign_of_E", "table5_signs", "meanings"}
    assert claims == {
        f.key for f in audit.findings if not re.search("sign_of_E|signs_of_B?C?D$", f.key)
    }


def test_findings_are_whole(audit):
    for f in audit.findings:
        assert f.claim
        assert f.test
        assert f.where
        assert f.evidence.endswith(".")
        assert "nan" not in f.evidence
        assert f.figures
        assert f.verdict is Verdict.UNTESTABLE or f.found, f.key
        for q in f.found:
            if not np.isnan(q.lower):
                assert q.interval, (f.key, q.name)
                value = q.lower if np.isnan(q.value) else q.value
                assert q.lower <= value <= q.upper, (f.key, q.name)
        with pytest.raises(FrozenInstanceError):
            f.verdict = Verdict.CONFIRMED


def test_what_rests_on_reconstructed_data_says_so(audit):
    resting = {f.key for f in audit.findings if f.reconstructed}
    assert resting == {
        "table1_values", "table3_reading", "table6_likelihood", "genetic_by_pressure",
        "genetic_joint",
    }  # fmt: skip
    assert "proves nothing about the measured ones" in Basis.RECONSTRUCTED.meaning
    # Tables 1, 4 and 6 are the optimum of these data by construction: only methods are judged.
    for key in resting:
        if audit[key].verdict in (Verdict.CONFIRMED, Verdict.CONTRADICTED):
            assert key.startswith("genetic")


@pytest.mark.slow
def test_a_misprint_changes_what_rests_on_it_and_nothing_else(audit, rut_calibration):
    wrong = flipped("Table 5: c2")
    found = run_audit(
        audit.seed, published=wrong, seeds=Seeds(1, 1, 1), rut_calibration=rut_calibration
    )
    changed = {f.key for f in found.findings if f.verdict is not audit[f.key].verdict}
    assert "table5_signs_of_D" in changed
    # The same seed: every other finding is the same to the last digit.
    rest = [f for f in audit.findings if f.key.startswith(("table1", "table3", "table4", "table6"))]
    assert len(rest) > 15
    for f in rest:
        assert repr(found[f.key]) == repr(f)


def test_files_have_every_finding_and_no_number_that_is_none(audit):
    content = json.loads(audit_json(audit), parse_constant=lambda name: pytest.fail(name))
    assert (content["schema"], content["seed"]) == ("calib/audit/1", audit.seed)
    assert [f["key"] for f in content["findings"]] == [f.key for f in audit.findings]
    assert set(content["findings"][0]) >= {
        "verdict", "where", "claim", "test", "found", "evidence", "basis", "stays_open",
        "depends_on_reconstruction", "caveat",
    }  # fmt: skip
    assert content["counts"] == {v.value: n for v, n in audit.counts.items()}
    rows = list(csv.DictReader(io.StringIO(audit_csv(content))))
    assert [r["key"] for r in rows] == [f.key for f in audit.findings]
    assert {r["depends_on_reconstruction"] for r in rows} == {"yes", "no"}
    found = next(r["found"] for r in rows if r["key"] == "table6_inverse_regression")
    assert "n0, by the means of the ruts 3.168 (3.165 to 3.172, rounding)" in found
    assert str(Quantity("rut", float("nan"), "mm", 17.0, 23.0, "rounding")) == (
        "rut 17 to 23 mm (rounding)"
    )
    assert str(Quantity("cost", 0.07, "kN^2")) == "cost 0.07 kN^2"


@pytest.fixture(scope="module")
def section(audit):
    plates = [Plate(None, "audit_rut", "Not drawn (no luck).", "Ruts"),
              Plate(None, "audit_costs", "Cost of 0.1 kN^2 at -3 %.", "Costs")]  # fmt: skip
    return audit_section(audit, plates, {"audit_costs": PNG})


@pytest.fixture(scope="module")
def written(audit, tmp_path_factory):
    folder = tmp_path_factory.mktemp("audit")
    write_audit_page(audit, folder, ["calib", "audit", "--out", "a folder"])
    return folder


def test_every_finding_is_shown_the_gravest_first(audit, section):
    reader = Reader(section)
    text = reader.text
    assert reader.open == []
    assert {f"audit-{f.key}" for f in audit.findings} <= set(reader.ids)
    assert re.findall(r'<span id="audit-(\w+)">', section) == [
        "contradicted", "corrected", "confirmed", "consistent", "untestable", "figures",
    ]  # fmt: skip
    for verdict in audit.counts:
        assert verdict.value.capitalize() in text
        assert verdict.meaning in text
    n = sum(f.reconstructed for f in audit.findings)
    assert section.count('<br><span class="badge">reconstructed</span>') == n
    assert section.count("proves nothing about the measured ones.") == n
    # Minus signs and powers; a figure that is missing says why.
    assert "kN²" in text
    assert not re.search(r"kN\^2|(?<![\w.])-\d", text)
    assert "Ruts: no figure." in text
    assert len(reader.images) == 1


def test_it_holds_in_a_browser(written, browser):
    assert faults(browser, written / "index.html") == []


def test_the_page_stands_alone(written):
    html = (written / "index.html").read_text(encoding="utf-8")
    reader = Reader(html)
    assert reader.open == []
    assert not re.search(r"https?://|@import|url\(", html)
    assert len(reader.ids) == len(set(reader.ids))
    assert len(reader.images) == 5
    assert "calib audit --out 'a folder'" in reader.text
    assert {p.name for p in written.iterdir()} == {
        "audit.json", "audit.csv", "figures", "index.html",
    }  # fmt: skip
    assert len(list((written / "figures").glob("audit_*.png"))) == 5


@pytest.fixture(scope="module")
def drawn(audit):
    return {p.name: p for p in audit_plates(audit)}


def test_axes_have_units_and_figures_a_legend_and_a_caption(drawn):
    assert [p.caption for p in drawn.values() if p.figure is None] == []
    assert list(drawn) == ["audit_costs", "audit_digits", "audit_rut", "audit_chord", "audit_signs"]
    for p in drawn.values():
        assert p.heading
        assert p.caption.endswith(".")
        assert p.figure.legends
        for ax in p.figure.axes:
            for label in (ax.get_xlabel(), ax.get_ylabel()):
                assert not label or re.search(r"\(.+\)$", label), (p.name, label)


def test_the_range_drawn_is_the_range_found(audit, drawn):
    for ax, psi in zip(drawn["audit_digits"].figure.axes, audit.rounding.allowed, strict=True):
        (band,) = ax.collections
        y = band.get_paths()[0].vertices[:, 1]
        assert y.max() == pytest.approx(float(audit.rounding.allowed[psi].upper.max()))
        assert y.min() == pytest.approx(float(audit.rounding.allowed[psi].lower.min()), abs=1e-9)


def test_one_dot_for_each_seed(audit, drawn):
    runs = drawn["audit_costs"].figure.axes[1]
    dots = [line.get_xdata() for line in runs.lines if line.get_marker() == "o"]
    assert [d.size for d in dots] == [s.costs.size for s in audit.genetic.searches]


def test_one_that_fails_does_not_stop_the_rest(audit):
    broken = replace(audit, quality=replace(audit.quality, n=np.array([])))
    found = {p.name: p for p in audit_plates(broken)}
    assert found["audit_rut"].figure is None
    assert "could not be drawn" in found["audit_rut"].caption
    assert found["audit_digits"].figure is not None
