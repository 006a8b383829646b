"""What a study is of: which model for which columns, what is held out, what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.data import read_table, table_from_arrays
from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from calib.he2019.designs import he2019_tasks
from calib.he2019.embedded import load_he2019
from calib.inference.prior_files import default_priors
from calib.report.study import HoldOut, choose_model, plan_tasks
from tests.user_tables import pulls, table

HELD = HoldOut("inflation_pressure_psi", 30.0)


PSI, GROUND, CONE = "inflation_pressure_psi", "average_ground_pressure_kpa", "cone_index_kpa"
MASS, VOLUME = "gravimetric_water_content", "volumetric_water_content"


@pytest.mark.parametrize(
    ("output", "columns", "model"),
    [
        ("drawbar_pull", {"slip_ratio": [0.1, 0.2]}, "magic_formula"),
        ("drawbar_pull", {"slip_ratio": [0.1, 0.2], PSI: [30, 30]}, "magic_formula"),
        ("drawbar_pull", {"slip_ratio": [0.1, 0.2], PSI: [18, 30]}, "magic_formula_pressure"),
        ("rut_depth", {GROUND: [100, 120]}, "bekker"),
        ("rut_depth", {"slip_ratio": [0.1, 0.1], GROUND: [100, 120]}, "bekker"),
        ("rut_depth", {"slip_ratio": [0.1, 0.2], GROUND: [100, 120]}, "modified_bekker"),
        ("rut_depth", {"slip_ratio": [0.1, 0.2], GROUND: [100, 100]}, "modified_bekker"),
        ("bulk_density", {CONE: [300, 400], MASS: [0.1, 0.2]}, "ayers_perumpral"),
        ("bulk_density", {CONE: [300, 400], VOLUME: [0.1, 0.2]}, "ayers_perumpral_volumetric"),
        ("bulk_density", {CONE: [3, 4], MASS: [0.1, 0.2], VOLUME: [0.1, 0.2]}, "ayers_perumpral"),
    ],
)
def test_the_columns_choose_the_model(output: str, columns, model: str) -> None:
    assert (
        choose_model(output, table(**{k: np.array(v, float) for k, v in columns.items()})) == model
    )


def test_a_table_that_suits_no_model_is_refused_with_those_that_would() -> None:
    rut = table(slip_ratio=np.linspace(0, 0.3, 6), rut_depth_mm=np.linspace(20, 30, 6))
    with pytest.raises(CalibError) as caught:
        plan_tasks([rut])
    for word in ("no model of rut_depth", "bekker: average_ground_pressure_kpa", "--only"):
        assert word in str(caught.value)


def test_the_embedded_tasks_hold_30_psi_out() -> None:
    tasks = he2019_tasks()
    assert [t.output for t in tasks] == list(OUTPUTS)[:3]
    assert [t.held_out for t in tasks] == [None, HELD, HELD]
    assert all(t.table.label == "reconstructed" for t in tasks)


def test_one_file_may_give_several_outputs_with_gaps() -> None:
    nan = np.nan
    both = table(
        slip_ratio=np.linspace(0, 0.3, 6),
        average_ground_pressure_kpa=np.full(6, 100.0),
        drawbar_pull_kn=np.array([0.0, 0.2, nan, 0.4, 0.5, 0.5]),
        rut_depth_mm=np.array([nan, 20.0, 21.0, 22.0, 23.0, nan]),
    )
    tasks = plan_tasks([both])
    assert [(t.output, t.model, len(t.table)) for t in tasks] == [
        ("drawbar_pull", "magic_formula", 5), ("rut_depth", "modified_bekker", 4),
    ]  # fmt: skip
    assert all(t.held_out is None for t in tasks)


def test_the_hold_out_goes_to_the_outputs_that_have_the_column() -> None:
    density = table(
        "density.csv",
        cone_index_kpa=np.linspace(300, 900, 6),
        gravimetric_water_content=np.full(6, 0.1),
        bulk_density_g_cm3=np.linspace(1.4, 1.6, 6),
    )
    tasks = plan_tasks([pulls(), density], HELD)
    assert {t.output: t.held_out for t in tasks} == {"bulk_density": None, "drawbar_pull": HELD}


@pytest.mark.parametrize(
    ("tables", "held", "words"),
    [
        ([table("a.csv", slip_ratio=np.array([0.1]))], None, ["a.csv", "no output",
         "drawbar_pull_kn"]),
        ([table("a.csv", slip_ratio=np.array([0.1]), drawbr_pul_kn=np.array([1.0]))], None,
         ["no output", "did you mean drawbar_pull_kn?"]),
        ([table("a.csv", slp_ratio=np.array([0.1]), drawbar_pull_kn=np.array([1.0]))], None,
         ["no model", "did you mean slip_ratio?"]),
        ([pulls(source="a.csv"), pulls(source="b.csv")], None, ["a.csv, b.csv", "drawbar_pull"]),
        ([pulls()], HoldOut("speed_m_s", 1.0), ["my.csv", "speed_m_s", "inflation_pressure_psi"]),
        ([pulls()], HoldOut("spede", 1.0), ["my.csv", "spede"]),
        ([pulls()], HoldOut("inflation_pressure_psi", 31.0), ["my.csv", "31", "18, 30, 42"]),
        ([pulls()], HoldOut("inflation_pressure", 30.0), ["inflation_pressure", "unit"]),
        ([pulls(psi=(30.0,))], HELD, ["my.csv", "every row"]),
    ],
)  # fmt: skip
def test_what_cannot_be_planned_is_told_before_the_work(tables, held, words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        plan_tasks(tables, held)
    for word in [*words, "hint:"]:
        assert word in str(caught.value)


def test_read_files_are_planned_as_arrays_are(tmp_path: Path) -> None:
    path = tmp_path / "my.csv"
    path.write_text(
        "slip_percent,average_ground_pressure_kpa,drawbar_pull_n,rut_depth_mm\n"
        "0,100,1,\n10,110,300,\n20,120,,\n"
    )
    read = read_table(path, allow_missing=tuple(OUTPUTS.values()))
    tasks = plan_tasks([read])
    assert [(t.output, len(t.table)) for t in tasks] == [("drawbar_pull", 2), ("rut_depth", 0)]


def test_a_model_can_be_chosen_for_its_output() -> None:
    table = load_he2019("rut_depth")
    assert plan_tasks([table])[0].model == "modified_bekker"
    assert plan_tasks([table], models=["bekker"])[0].model == "bekker"
    with pytest.raises(CalibError, match="two models are given for the same output") as caught:
        plan_tasks([table], models=["bekker", "modified_bekker"])
    assert "`calib compare bekker modified_bekker FILE`" in str(caught.value)


def test_a_model_whose_output_no_file_has_is_refused() -> None:
    """It was left out without a word."""
    with pytest.raises(CalibError, match="magic_formula is for drawbar_pull_kn") as caught:
        plan_tasks([load_he2019("rut_depth")], models=["bekker", "magic_formula"])
    assert "give a file with drawbar_pull_kn" in str(caught.value)


def test_a_prior_file_goes_to_the_model_it_names(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(default_priors("bekker").read_text())
    table = load_he2019("rut_depth")
    assert plan_tasks([table], models=["bekker"], prior_paths=[path])[0].prior_path == path
    assert plan_tasks([table], prior_paths=[path])[0].prior_path is None
    path.write_text("x = 1\n")
    with pytest.raises(CalibError, match="which model"):
        plan_tasks([table], prior_paths=[path])


def test_outputs_can_be_left_out() -> None:
    tables = [load_he2019("rut_depth"), load_he2019("drawbar_pull")]
    assert [t.output for t in plan_tasks(tables)] == ["drawbar_pull", "rut_depth"]
    with pytest.raises(CalibError, match="no output 'ruts'"):
        plan_tasks(tables, only=["ruts"])
    assert [t.output for t in plan_tasks(tables[:1], only=["rut_depth"])] == ["rut_depth"]


def test_a_report_has_a_longest_table() -> None:
    n = 5001
    table = table_from_arrays(
        {"average_ground_pressure_kpa": np.linspace(100, 200, n),
         "slip_ratio": np.linspace(0, 0.2, n), "rut_depth_mm": np.linspace(20, 30, n)}
    )  # fmt: skip
    with pytest.raises(CalibError, match="too many for a report"):
        plan_tasks([table])


def test_a_hold_out_is_written_as_it_is_read() -> None:
    assert HoldOut.parse("inflation_pressure_psi=30") == HELD
    assert str(HELD) == "inflation_pressure_psi = 30"
    assert HELD.words == "inflation pressure 30 psi"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("inflation_pressure_kpa=160", "inflation pressure 160 kPa"),
        ("wheel_load_kn=5.5", "normal load 5.5 kN"),
        ("bulk_density_g_cm3=1.5", "bulk density 1.5 g/cm^3"),
        ("pass_number=2", "pass number 2"),
    ],
)
def test_a_heading_names_the_unit_as_it_is_written(text: str, words: str) -> None:
    assert HoldOut.parse(text).words == words


def test_among_models_that_use_the_same_the_one_of_fewest_parameters_is_chosen() -> None:
    from calib.models import example_csv

    lines = example_csv("wismer_luth").splitlines()
    rows = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    table = table_from_arrays(dict(zip(lines[0].split(","), rows.T, strict=True)))
    assert choose_model("drawbar_pull", table) == "wismer_luth"
    # A cone index that is the same in all rows does not speak for the slower rigid wheel, nor for
    # a model that needs it.
    soft = table.columns["cone_index_kpa"] == 600.0
    assert choose_model("drawbar_pull", table.take(soft)) == "upadhyaya"
    # One load beside does not speak for a model that needs a load.
    one = table.take(soft & (table.columns["normal_load_kn"] == 6.0))
    assert choose_model("drawbar_pull", one) == "magic_formula"
    with pytest.raises(CalibError, match="janosi_hanamoto: normal_stress_kpa, shear_displ"):
        choose_model("shear_stress", table)
