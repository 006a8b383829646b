"""The page: complete, self-contained, and honest about what failed."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure

from calib.data import read_table
from calib.he2019.published import HE2019
from calib.inference.noise import Noise, NoiseChoice
from calib.models import MODELS, example_csv
from calib.report.figures.collect import Drawn
from calib.report.figures.plate import Plate
from calib.report.labels import units_of
from calib.report.page.content import failed_section, render_page, repeats_words, validation_facts
from calib.report.page.tables import (
    estimates_grid,
    posterior_rows,
    pressure_grids,
    sensitivity_grid,
)
from calib.report.page.template import (
    equation,
    likelihood,
    parametrisation,
    png_size,
    prose,
    symbol_html,
    unit_html,
)
from calib.report.sections import EmulatorSection
from calib.report.study import Failure, Study

PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR\x00\x00\x00\x02\x00\x00\x00\x03\x08\x06\x00\x00\x00rest"
MANIFEST = {
    "command": ["calib", "report", "--out", "a folder"],
    "versions": {"numpy": "2.5"},
    "settings": {"ensembles": 4},
    "tasks": {"rut_depth": {"data": {"file": "data/rut_depth.csv", "sha256": "ab" * 32},
                            "priors": {"file": "priors/rut_depth.toml", "sha256": "cd" * 32}}},
}  # fmt: skip
VOID = {"meta", "link", "img", "br", "hr", "input"}


class Reader(HTMLParser):
    """Collect addresses, anchors and text, and check that tags are closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.tags: set[str] = set()
        self.text = ""

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.tags.add(tag)
        self.addresses += [found[k] for k in ("src", "href", "srcset", "action") if found.get(k)]
        self.ids += [found["id"]] if "id" in found else []
        self.images += [found] if tag == "img" else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"style", "script"} & set(self.open):
            self.text += data.replace("\N{NO-BREAK SPACE}", " ")


def test_scores_have_the_unit_of_the_file(drawbar):
    usual = dict(validation_facts(drawbar, 3.0, 0.5))
    with units_of(["Drawbar pull [N]"]):
        own = dict(validation_facts(drawbar, 3.0, 0.5))
    for name in ("Root mean square error of the median", "Mean CRPS"):
        (kn, _), (n, unit) = usual[name].split(), own[name].split()
        assert unit == "N"
        assert float(n) == pytest.approx(1000.0 * float(kn), rel=0.01)


def page(results, **kwargs) -> tuple[str, Reader]:
    plates = (
        Plate(Figure(), "bands", "Shows that C2 is 5 kN & more.", "Prediction and data"),
        Plate(None, "corner", "This figure could not be drawn (no luck)."),
    )
    drawn = {key: Drawn(plates, {f"{key}_bands.png": PNG}) for key in results}
    manifest = {**MANIFEST, "title": "A <title>"}
    html = render_page(Study(results, 42, 3.2), drawn, manifest=manifest, **kwargs)
    reader = Reader()
    reader.feed(html)
    return html, reader


@pytest.fixture(scope="module")
def whole(drawbar, rut, density):
    return page({"bulk_density": density, "drawbar_pull": drawbar, "rut_depth": rut})


def test_it_is_well_formed_and_makes_no_request(whole):
    html, reader = whole
    assert reader.open == []
    assert not re.search(r"https?://|@import|url\(", html)
    assert all(a.startswith(("#", "data:")) for a in reader.addresses)


def test_every_link_has_its_target_and_ids_are_unique(whole):
    _, reader = whole
    targets = {a[1:] for a in reader.addresses if a.startswith("#")}
    assert len(targets) >= 20
    assert targets <= set(reader.ids)
    assert len(reader.ids) == len(set(reader.ids))


def test_images_are_inside_with_size_and_description(whole):
    _, reader = whole
    assert len(reader.images) == 3
    for image in reader.images:
        assert image["src"].startswith("data:image/png;base64,iVBORw0")
        assert (image["width"], image["height"]) == ("2", "3")
        assert "Shows that C2 is 5 kN & more." in image["alt"]


def test_what_is_passed_in_is_escaped(whole):
    html, _ = whole
    assert "A &lt;title&gt;" in html
    assert "A <title>" not in html


def test_the_verdict_comes_first(whole):
    _, reader = whole
    assert reader.ids[0] == "verdict"
    start = reader.text.index("Verdict")
    opening = reader.text[start : reader.text.index("How to reproduce", start)]
    for words in ("Scatter is uneven", "too narrow", "covered", "Do not trust:", "Converged"):
        assert words in opening


def test_reconstructed_data_are_called_so_everywhere(whole):
    html, reader = whole
    assert html.count('class="badge"') == 1 + 3
    assert "They are not\nmeasurements" in reader.text


def test_measured_data_are_not_called_reconstructed(plate):
    html, reader = page({"rut_depth": plate})
    assert "econstructed" not in html
    assert "Table 6" not in reader.text


def test_parameters_that_are_not_identified_are_named(whole, drawbar, rut):
    html, reader = whole
    assert html.count("<h4>What the prior decides</h4>") == 3
    start = reader.text.index("Not identified by these data: c1, c2,")
    named = reader.text[start : reader.text.index(".", start)]
    assert "bend" in named
    assert "sigma" not in named
    rows = {str(row[0]): row for row in sensitivity_grid(drawbar).rows}
    assert "not identified" in rows[str(symbol_html("K_bend"))][-1]
    assert rows[str(symbol_html("D_lo"))][-1] == "data"
    assert sensitivity_grid(rut).caption == "Every parameter is identified by these data."


def test_a_failed_output_is_shown_and_the_rest_still_comes(rut):
    failure = Failure(replace(rut.task, output="drawbar_pull"), "CalibError: no <column>")
    html, reader = page({"drawbar_pull": failure, "rut_depth": rut})
    assert "This output failed: no <column>" in reader.text
    assert "What to do" in reader.text
    assert "no &lt;column&gt;" in html
    assert "CalibError" not in html
    assert 'id="rut_depth-posterior"' in html


@pytest.mark.parametrize("name", ["CalibError", "numpy.linalg.LinAlgError", "DataError"])
def test_a_failure_does_not_show_the_name_of_a_class(rut, name):
    failure = Failure(rut.task, f"{name}: row 3: no slip (Error: none)")
    assert failed_section("rut_depth", failure)["error"] == "row 3: no slip (Error: none)"


def test_notes_of_a_problem_are_shown(rut):
    note = "no load <column>: 5 kN is assumed"
    problem = replace(rut.calibration.problem, notes=(note,))
    told = replace(rut, calibration=replace(rut.calibration, problem=problem))
    assert note in page({"rut_depth": told})[1].text.replace("\N{NO-BREAK SPACE}", " ")
    assert "Assumed" not in page({"rut_depth": rut})[1].text


def test_the_likelihood_is_that_of_the_prior_file(rut):
    problem = rut.calibration.problem
    assert likelihood(problem, "rut depth") == (
        "Rows are independent; the logarithm of rut depth is normal about the prediction, with one "
        "unknown standard deviation sigma for all rows."
    )
    noise = Noise(NoiseChoice("student_t", "slip"), "slip_ratio", 0.25, 0.125)
    text = likelihood(replace(problem, noise=noise), "rut depth")
    assert "is Student-t, of unknown degrees of freedom nu, about the prediction" in text
    assert "sigma at the mean slip of the rows, 25 %" in text
    assert "by sigma_slope for each sd of it, 12.5 %" in text


def test_readings_far_off_are_named(rut):
    table = rut.calibration.problem.table
    columns = dict(table.columns) | {"rut_depth_mm": table["rut_depth_mm"].copy()}
    columns["rut_depth_mm"][4] *= 30.0
    problem = rut.calibration.problem.with_table(replace(table, columns=columns))
    told = replace(rut, calibration=replace(rut.calibration, problem=problem))
    said = page({"rut_depth": told})[1].text
    assert f"line {table.lines[4]}: " in said
    # First of all on its card.
    assert said.index(f"line {table.lines[4]}: ") < said.index("Trust:")
    assert "Rows far off" in said
    assert "Rows far off" not in page({"rut_depth": rut})[1].text


def test_repeats_that_stay_in_are_named(plate):
    assert repeats_words(plate) == ""
    table = plate.calibration.problem.table
    columns = dict(table.columns) | {"average_ground_pressure_kpa": np.repeat([50.0, 90.0], 7)}
    problem = plate.calibration.problem.with_table(replace(table, columns=columns))
    repeated = replace(plate, calibration=replace(plate.calibration, problem=problem))
    words = "14 rows at 2 distinct conditions; leaving one row out leaves its repeats in"
    assert repeats_words(repeated) == words
    assert words in page({"rut_depth": repeated})[1].text.replace("\N{NO-BREAK SPACE}", " ")


def test_repeats_do_not_matter_for_held_out_rows(rut):
    assert repeats_words(rut) == ""


def test_a_missing_figure_says_why(whole):
    _, reader = whole
    assert reader.text.count("This figure could not be drawn (no luck).") == 3


def test_not_converged_cannot_be_overlooked(unconverged):
    _, reader = page({"rut_depth": unconverged})
    assert reader.text.count("NOT CONVERGED") >= 2
    assert "Nothing below may be used" in reader.text
    assert "R-hat of n0 is 1.3" in reader.text.replace("\N{NO-BREAK SPACE}", " ")


def test_the_footer_says_how_to_get_the_same_numbers(whole):
    _, reader = whole
    for words in ("calib report --out 'a folder'", "42", "ab" * 32, "numpy 2.5"):
        assert words in reader.text


def test_a_section_is_placed_as_given(rut):
    html, reader = page(
        {"rut_depth": rut}, more=[(EmulatorSection({}), "<p>All <b>agree</b>.</p>")]
    )
    assert "<p>All <b>agree</b>.</p>" in html
    assert "emulators" in reader.ids


def test_posterior_table_marks_what_the_prior_sets(drawbar):
    rows = {str(r["symbol"]): r for r in posterior_rows(drawbar)}
    bend = rows["<i>K</i><sub>bend</sub>"]
    assert bend["role"] == "set by the prior"
    assert float(bend["ratio"]) > 0.9
    assert rows["<i>c</i><sub>1</sub>"]["derived"]


def test_estimates_tick_what_equals_the_source(rut):
    grid = estimates_grid(rut, reference=HE2019)
    regression = grid.head.index("regression as published (Eq 22)")
    for row in grid.rows:
        assert "\N{CHECK MARK}" in row[regression]
    assert [row[grid.head.index("Table 6")] for row in grid.rows][:2] == ["1.996", "1.266"]


def test_estimates_of_a_users_data_have_no_published_column(plate):
    grid = estimates_grid(plate)
    assert not any("Table" in str(cell) for cell in grid.head)
    assert all(len(row) == len(grid.head) for row in (*grid.rows, *grid.foot))


def test_a_skewed_parameter_has_a_median_and_no_sd(rut):
    s = rut.calibration.summary
    wide = replace(
        s["k"], mean=10.0, sd=40.0, median=2.0, hdi_lower=0.01, hdi_upper=90.0, mcse_median=0.03,
        mcse_hdi_lower=0.02, mcse_hdi_upper=3.0,
    )  # fmt: skip
    calibration = replace(rut.calibration)
    object.__setattr__(calibration, "summary", {**s, "k": wide})
    told = replace(rut, calibration=calibration)
    row = next(r for r in posterior_rows(told) if str(r["symbol"]) == "<i>k</i>")
    assert row["value"] == "median 2.0"
    cells = [r for r in estimates_grid(told, reference=HE2019).rows if str(r[0]) == "<i>k</i>"]
    assert str(cells[0][-1]) == "median 2.0<br>HDI 0 to 90"


def test_the_table_says_that_its_estimates_are_of_more_rows(drawbar, rut):
    caption = estimates_grid(drawbar, reference=HE2019).caption
    assert "all 42 rows" in caption
    assert "the 28 that were not held out" in caption
    assert caption in page({"drawbar_pull": drawbar})[1].text
    assert estimates_grid(rut, reference=HE2019).caption == ""


def test_each_pressure_stands_beside_tables_3_and_4(drawbar):
    grids = pressure_grids(drawbar, reference=HE2019)
    assert [g.caption for g in grids] == ["18 psi alone", "30 psi alone", "42 psi alone"]
    least = next(row for row in grids[0].rows if row[0] == "least squares")
    assert all("\N{CHECK MARK}" in cell for cell in least[1:])


def test_a_card_says_that_an_emulator_stood_in_and_how_well(rut, monkeypatch):
    held = {"runs": 20, "rmse_in_noise_sds": 0.0456, "covered_90": 0.77, "pit": [0.5] * 200}
    found = {"runs": 60, "reasons": [], "held_out": held}
    monkeypatch.setitem(MANIFEST, "emulators", {rut.task.model: found})
    html, _ = page({"rut_depth": rut})
    cards = html[: html.index("<nav")]
    assert "made from 60 runs, stood in for it" in cards
    assert "too narrow" in cards
    assert "Emulator not good enough" not in cards
    found["reasons"] = ["the emulator is off by 0.30 noise sds"]
    cards = page({"rut_depth": rut})[0].partition("<nav")[0]
    assert "Emulator not good enough" in cards
    assert "off by 0.30 noise sds" in cards


def test_validation_facts_have_the_numbers(rut):
    s = rut.validation.scores
    facts = dict(validation_facts(rut, 6.5, 0.9))
    assert facts["Covered by the 90 % band"].startswith(f"{s.coverage[0.9].hits} of 9")
    assert facts["Root mean square error of the median"] == f"{s.rmse:.2f} mm"
    assert f"{100 * s.max_relative_error:.1f} %" in facts["Largest relative error"]


@pytest.mark.parametrize("name", MODELS)
def test_every_model_has_an_equation_and_a_parametrisation(name, tmp_path):
    example = tmp_path / "example.csv"
    example.write_text(example_csv(name))
    bound = MODELS[name].bind(read_table(example))
    assert "<i>" in equation(bound)
    text = parametrisation(bound)
    assert "{" not in text
    assert ("must stay positive" in text) == (name == "magic_formula_pressure")
    reader = Reader()
    reader.feed(str(equation(bound)))
    assert reader.open == []


def test_symbols_in_sentences():
    text = str(
        prose(
            "K_lo and C2 < 5 kN; \N{GREEK SMALL LETTER SIGMA} is C, not C23",
            ["K_lo", "C2", "sigma", "C"],
        )
    )
    assert "<i>K</i><sub>lo</sub> and <i>C</i><sub>2</sub> &lt; 5\N{NO-BREAK SPACE}kN" in text
    assert "<i>\N{GREEK SMALL LETTER SIGMA}</i> is C, not C23" in text


def test_symbols_and_units_are_escaped():
    assert str(symbol_html("<b>")) == "<i>&lt;b&gt;</i>"
    assert str(unit_html("kPa (g/cm^3)^-C4")) == "kPa (g/cm<sup>3</sup>)<sup>&minus;C4</sup>"
    assert str(unit_html("1")) == "&ndash;"
    assert str(unit_html("(g/cm^3)^2")) == "(g/cm<sup>3</sup>)<sup>2</sup>"


def test_the_cost_has_its_unit(density):
    cost = estimates_grid(density, reference=HE2019).foot[0]
    assert str(cost[1]) == "(g/cm<sup>3</sup>)<sup>2</sup>"


def test_png_size():
    assert png_size(PNG) == (2, 3)
