"""The page of a diagnosis: complete in itself, in the units of its files."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.text import Text

from calib.gap.case import Case, read_case
from calib.gap.describe import gap_document
from calib.gap.diagnose import diagnose
from calib.gap.document import load_document
from calib.gap.effects import EFFECTS
from calib.gap.files import answer, contract, mispredicted, misquoted, write_diagnosis
from calib.report.figures.gap import gap_plates
from calib.report.labels import short
from calib.report.page.diagnosis import hypothesis_groups, render_diagnosis, render_page, write_page
from tests.browser import faults
from tests.gap.cases import make_case, write_case
from tests.pages import Reader
from tests.report.gap_documents import DOCUMENTS, gap

NAMED = DOCUMENTS["named"]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    write_page(NAMED, folder)
    html = (folder / "index.html").read_text(encoding="utf-8")
    return folder, html, Reader(html)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_every_verdict_has_its_page(name):
    reader = Reader(render_page(DOCUMENTS[name], [], {}))
    assert reader.open == []
    assert reader.ids[0] == "verdict"
    assert not re.search(r"[{}]\s*[{}%]| ,| ;|None|Undefined", reader.text)


def test_what_a_page_says(snapshot):
    text = Reader(render_page(DOCUMENTS["recalibrate"], [], {})).text
    assert re.sub(r"\s*\n\s*", "\n", text) == snapshot


def test_it_is_well_formed_and_makes_no_request(page):
    _, html, reader = page
    assert reader.open == []
    assert not re.search(r"https?://|@import|url\(", html)
    targets = {a[1:] for a in reader.addresses if a.startswith("#")}
    assert targets == {"before", "where", "which", "how-far", "next", "reproduce"}
    own = {a for a in reader.addresses if not a.startswith(("#", "data:"))}
    assert own <= {"fresh_prediction.csv"}
    assert targets <= set(reader.ids)
    assert len(reader.ids) == len(set(reader.ids))


def test_it_holds_in_a_browser(page, browser):
    assert faults(browser, page[0] / "index.html") == []


def test_figures_are_in_the_page_and_beside_it(page):
    folder, _, reader = page
    files = sorted(p.name for p in (folder / "figures").iterdir())
    assert len(files) == len(reader.images) == 7
    assert all((folder / "figures" / f).read_bytes().startswith(b"\x89PNG") for f in files)
    assert all(int(image["width"]) > 800 and image["alt"] for image in reader.images)


def test_texts_of_the_user_are_shown_and_escaped(page):
    _, html, reader = page
    assert "mind the &lt;gap&gt;" in html
    assert "soft &lt;field&gt;" in html
    for words in ("calib diagnose 'a b'", "a" * 64, "numpy 2", "Seed", "Reconstructed data"):
        assert words in reader.text


def test_hypotheses_are_grouped_each_once():
    p = {"lug_thrust": 0.5, "drift": 0.2, "a+b": 0.05, "none": 0.005, "a+b+c": 0.001}
    groups = hypothesis_groups(gap("effect", p))
    assert {group: [e.name for e in rows] for group, rows in groups.items()} == {
        "best": ["lug_thrust", "drift"], "less": ["a+b"], "out": ["none"], "sets": ["a+b+c"],
    }  # fmt: skip


# Columns as a file has them, and how much of the canonical unit one of theirs is.
OWN = {
    "drawbar_pull_kn": ("Drawbar pull [N]", 1e-3),
    "rut_depth_mm": ("Sinkage [inch]", 25.4),
    "inflation_pressure_psi": ("Inflation pressure [kPa]", 1.0 / 6.894757293168361),
    "average_ground_pressure_kpa": ("Average ground pressure [psi]", 6.894757293168361),
    "speed_m_s": ("Speed [ft/s]", 0.3048),
}


def in_own_units(case: Case, folder: Path) -> Case:
    """Return a case as it is read from files of other words and units."""
    write_case(case, folder)
    for file in folder.glob("*.csv"):
        with file.open() as lines:
            head, *rows = csv.reader(lines)
        scale = [OWN.get(column, ("", 1.0))[1] for column in head]
        lines = [",".join(OWN.get(column, (column,))[0] for column in head)]
        lines += [",".join(repr(float(c) / f) for c, f in zip(r, scale, strict=True)) for r in rows]
        file.write_text("\n".join(lines) + "\n")
    return read_case(folder)


@pytest.mark.slow
def test_a_folder_is_in_the_units_of_the_files_checks_and_is_rendered_again(tmp_path):
    few = {n: EFFECTS[n] for n in ("force_offset", "sensor_drift")}
    found = diagnose(in_own_units(make_case("sensor_drift", n_fresh=3), tmp_path / "own"), 1,
                     effects=few)  # fmt: skip
    out = tmp_path / "gaps" / "drift"
    out.mkdir(parents=True)
    write_diagnosis(found, out)
    again = render_diagnosis(load_document(out))
    assert again["diagnosis.json"] == (out / "diagnosis.json").read_bytes()
    told = json.loads(again["diagnosis.json"])
    reader = Reader(again["index.html"].decode())
    shrink = told["shrink"]["drawbar_pull"]
    before, after, noise = (
        short(1e3 * shrink[key]) for key in ("rmse_before", "rmse_after", "noise_floor")
    )
    assert f"from {before} to {after} N rms" in reader.text
    assert f"noise sd of a reading {noise} N" in reader.text
    # Parameters are in their own units, here kN and mm; their definitions name a pressure.
    units = set(re.findall(r"[\d.]+ (mm|psi|kPa|m/s|kN)\b", reader.text))
    assert units == {"kN", "mm", "kPa", "psi"}
    # The ground pressure is in the file's psi.
    assert {"18 and 42 psi", "8.5 to 28.2 psi"} < {*re.findall(r".{7}[\d.]+ psi\b", reader.text)}
    figures = [p.figure for p in gap_plates(load_document(out))]
    labels = {text.get_text() for f in figures for text in f.findobj(Text)}
    assert {"Gap in drawbar pull (N)", "Gap in rut depth (inch)", "Speed\n(ft/s)"} <= labels
    assert not [t for t in labels if re.search(r"\((kN|mm|psi|m/s)\)", t)]

    # What it keeps is canonical: it is diagnosed as before, and its model predicts what it states.
    other = contract(gap_document(diagnose(read_case(out / "case"), 1, effects=few)))
    assert other["verdict"] == told["verdict"] == "effect"
    for new, old in zip(other["effects"], told["effects"], strict=True):
        assert new["name"] == old["name"]
        assert new["probability"] == pytest.approx(old["probability"], abs=1e-4)
    folder = tmp_path / "gaps" / "drift"
    assert misquoted(answer(told), folder) == mispredicted(folder) == ""


def test_pages_of_other_conditions_and_outputs_are_rendered():
    wide = replace(NAMED, conditions=NAMED.conditions | {"operator": (0.0, 1.0, 0.0, 1.0)},
                   covariates={"operator": ("Berg", "Lind")})  # fmt: skip
    (plate,) = gap_plates(wide, ["where_conditions"])
    assert "Lind" in {t.get_text() for t in plate.figure.axes[3].get_xticklabels()}
