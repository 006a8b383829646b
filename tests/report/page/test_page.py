"""The page: complete, self-contained, and honest about what failed."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from calib.report.document import Output
from calib.report.figures.collect import Drawn
from calib.report.figures.style import Plate
from calib.report.publish.tables import TOPICS, Table, parameters_table
from calib.report.sections import EmulatorSection
from calib.report.study import Failure, Study
from calib.report.writer import render_page
from tests.pages import PNG, Reader
from tests.report.conftest import records


def page(results, manifest=(), **kwargs) -> tuple[str, Reader]:
    plates = (
        Plate(Figure(), "bands", "Shows that C2 is 5 kN & more.", "Prediction and data"),
        Plate(None, "corner", "This figure could not be drawn (no luck)."),
    )
    drawn = {key: Drawn(plates, {f"{key}_bands.png": PNG}) for key in results}
    stated, summary = records(results)
    html = render_page(
        Study(results, 42, 3.2), drawn, manifest=stated | dict(manifest), summary=summary, **kwargs
    )
    return html, Reader(html)


@pytest.fixture(scope="module")
def whole(drawbar, rut, density):
    return page({"bulk_density": density, "drawbar_pull": drawbar, "rut_depth": rut})


def test_it_stands_alone(whole):
    """Well formed, without requests; every link has its target, every image size and words."""
    html, reader = whole
    assert reader.open == []
    assert not re.search(r"https?://|@import|url\(", html)
    assert all(a.startswith(("#", "data:")) for a in reader.addresses)
    targets = {a[1:] for a in reader.addresses if a.startswith("#")}
    assert targets >= {"verdict", "bulk_density", "drawbar_pull", "rut_depth", "reproduce"}
    assert targets <= set(reader.ids)
    assert len(reader.ids) == len(set(reader.ids))
    assert len(reader.images) == 3
    for image in reader.images:
        assert image["src"].startswith("data:image/png;base64,iVBORw0")
        assert (image["width"], image["height"]) == ("2", "3")
        assert "Shows that C2 is 5 kN & more." in image["alt"]
    assert reader.text.count("This figure could not be drawn (no luck).") == 3
    assert "A &lt;title&gt;" in html
    assert "A <title>" not in html
    for words in ("calib report --out 'a folder'", "42", "ab" * 32, "numpy 2"):
        assert words in reader.text


def test_the_verdict_comes_first(whole):
    _, reader = whole
    assert reader.ids[0] == "verdict"
    start = reader.text.index("Verdict")
    opening = reader.text[start : reader.text.index("How to reproduce", start)]
    for words in ("Scatter is uneven", "too small at 18 psi", "in the 90 % band", "Do not trust:"):
        assert words in opening


def test_only_reconstructed_data_are_called_so(whole, plate):
    html, reader = whole
    # The note, and each output's card and heading.
    assert html.count('class="badge"') == 1 + 3 + 3
    assert "They are not measurements" in " ".join(reader.text.split())
    html, reader = page({"rut_depth": plate})
    assert "econstructed" not in html
    assert "Table 6" not in reader.text


def test_a_failed_output_is_shown_and_the_rest_still_comes(rut):
    failure = Failure(replace(rut.task, output="drawbar_pull"), "a.CalibError: row 3: no <column>")
    html, reader = page({"drawbar_pull": failure, "rut_depth": rut})
    assert "This output failed: row 3: no <column>" in reader.text
    assert "What to do" in reader.text
    assert "no &lt;column&gt;" in html
    assert "CalibError" not in html
    assert 'id="rut_depth-posterior"' in html


def test_notes_and_rows_far_off_are_named(rut):
    problem = rut.calibration.problem
    columns = dict(problem.table.columns)
    columns["rut_depth_mm"] = columns["rut_depth_mm"].copy()
    columns["rut_depth_mm"][4] *= 30.0
    problem = problem.with_table(replace(problem.table, columns=columns))
    problem = replace(problem, notes=("no load <column>: 5 kN is assumed",))
    told = replace(rut, calibration=replace(rut.calibration, problem=problem))
    said, usual = (page({"rut_depth": r})[1].text for r in (told, rut))
    assert "Assumed: no load <column>: 5 kN is assumed" in said
    line = f"line {problem.table.lines[4]}: "
    # First of all on its card.
    assert said.index("Rows far off") < said.index(line) < said.index("Trust:")
    assert "Assumed" not in usual
    assert "Rows far off" not in usual


def test_repeats_that_stay_in_are_named(plate, rut):
    """Where each row is left out in turn; held-out rows have none."""
    table = plate.calibration.problem.table
    columns = dict(table.columns) | {"average_ground_pressure_kpa": np.repeat([50.0, 90.0], 7)}
    problem = plate.calibration.problem.with_table(replace(table, columns=columns))
    repeated = replace(plate, calibration=replace(plate.calibration, problem=problem))
    words = "14 rows at 2 distinct conditions; leaving one row out leaves its repeats in"
    assert words in page({"rut_depth": repeated})[1].text
    for result in (plate, rut):
        assert "distinct condition" not in page({"rut_depth": result})[1].text


def test_not_converged_cannot_be_overlooked(unconverged):
    _, reader = page({"rut_depth": unconverged})
    assert reader.text.count("NOT CONVERGED") >= 2
    assert "Nothing below may be used" in reader.text
    assert "R-hat of n0 is 1.3" in reader.text


def test_a_section_is_placed_as_given(rut):
    more = [(EmulatorSection({}), "<p>All <b>agree</b>.</p>")]
    html, reader = page({"rut_depth": rut}, more=more)
    assert "<p>All <b>agree</b>.</p>" in html
    assert "emulators" in reader.ids


def test_a_card_says_that_an_emulator_stood_in_and_how_well(rut):
    held = {"runs": 20, "rmse_in_noise_sds": 0.0456, "covered_90": 0.77, "pit": [0.5] * 200}
    found = {"runs": 60, "reasons": [], "held_out": held}
    for reasons in ([], ["the emulator is off by 0.30 noise sds"]):
        emulators = {rut.task.model: {**found, "reasons": reasons}}
        card = page({"rut_depth": rut}, {"emulators": emulators})[0].partition("</article>")[0]
        assert "made from 60 runs, stood in for it" in card
        assert "too narrow" in card
        assert ("Emulator not good enough" in card) == bool(reasons)
        assert all(reason in card.replace("\N{NO-BREAK SPACE}", " ") for reason in reasons)


def test_validation_facts_have_the_numbers_in_the_unit_of_the_file(rut):
    s = rut.validation.scores
    text = page({"rut_depth": rut})[1].text
    assert f"Covered by the 90 % band{s.coverage[0.9].hits} of 9" in text
    assert f"Rms error of the predicted median{s.rmse:.2f} mm" in text
    assert f"Largest relative error{100 * s.max_relative_error:.1f} %" in text
    header = ("Rut depth [m]",)
    in_metres = replace(rut, task=replace(rut.task, table=replace(rut.task.table, header=header)))
    _, summary = records({"rut_depth": in_metres})
    manifest, _ = records({"rut_depth": rut})
    manifest["tasks"]["rut_depth"]["data"]["header"] = list(header)
    html = render_page(
        Study({"rut_depth": in_metres}, 1, 1.0), {}, manifest=manifest, summary=summary
    )
    assert f"{1e-3 * s.rmse:.5f}\N{NO-BREAK SPACE}m" in html or f"{1e-3 * s.rmse:.5f} m" in html


def output(key: str, results):
    """The document of an output, with a role for every parameter."""
    from calib.report.document import outputs, page_facts

    (o,) = (o for o in outputs(*records(results)) if o.key == key)
    return replace(o, facts=page_facts(results[key]))


def tables_of(o: Output) -> dict[str, Table]:
    made = {name: topic.of_output(o) for name, topic in TOPICS.items()}
    by_pressure = [("by_pressure", table) for table in made["estimates"][1:]]
    return {name: tables[0] for name, tables in made.items() if tables} | dict(by_pressure)


def by_name(table) -> dict[str, dict[str, str]]:
    return {row["Parameter"].partition("]")[0][2:]: row for group in table.groups for row in group}


def test_tables_say_what_set_each_parameter(drawbar, rut):
    tables = tables_of(output("drawbar_pull", {"drawbar_pull": drawbar}))
    first = by_name(parameters_table(output("drawbar_pull", {"drawbar_pull": drawbar})))
    assert first["K_bend"]["Identified by"] == "[!not identified]"
    assert first["D_lo"]["Identified by"] == "data"
    assert first["D_lo"]["Meaning"] == "largest pull at the lowest pressure"
    # Published parameters follow from those that were sampled; b0 is C under another name.
    assert next(iter(first)) == "K_lo"
    assert list(first)[-1] == "c9"
    assert "b0" not in first
    named = tables["sensitivity"].caption.partition(".")[0]
    assert named.startswith("Not identified by these data: [$c1], [$c2],")
    assert "[$K_bend]" in named
    assert "sigma" not in named
    found = by_name(tables["sensitivity"])
    assert "not identified" in found["K_bend"]["Identified by"]
    assert found["D_lo"]["Identified by"] == "data"
    said = tables_of(output("rut_depth", {"rut_depth": rut}))["sensitivity"].caption
    assert said.startswith("Every parameter is identified by these data.")


def test_a_skewed_parameter_has_a_median_and_no_sd(rut):
    s = rut.calibration.summary
    wide = replace(
        s["k"], mean=10.0, sd=40.0, median=2.0, hdi_lower=0.01, hdi_upper=90.0, mcse_median=0.03,
        mcse_hdi_lower=0.02, mcse_hdi_upper=3.0,
    )  # fmt: skip
    calibration = replace(rut.calibration)
    object.__setattr__(calibration, "summary", {**s, "k": wide})
    tables = tables_of(output("rut_depth", {"rut_depth": replace(rut, calibration=calibration)}))
    assert by_name(tables["posterior"])["k"]["Posterior"] == "median 2.0"
    assert by_name(tables["estimates"])["k"]["Posterior"] == "median 2.0 (0 to 90)"
