"""Plans: which tasks they stand for, and what is said of those that will not do."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import calib
from calib.batch.campaign import read_plan
from calib.batch.campaign.kinds import KINDS
from calib.errors import CalibError
from calib.inference.prior_files import default_priors
from calib.models import MODELS
from calib.models.simulators.declaration import SIMULATED
from tests.batch.campaign.sites import EFFECT, NAMES, WIND, make_site
from tests.models.simulators.examples import PRIORS, pull

PAGE = Path(__file__).resolve().parents[3] / "docs" / "formats" / "inputs.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    plan = make_site(tmp_path_factory.mktemp("plans"))
    plan.unlink()
    return plan.parent


def planned(folder: Path, text: str) -> list[str]:
    (folder / "plan.toml").write_text(text)
    return list(read_plan(folder / "plan.toml").tasks)


def test_a_plan_is_its_tasks_by_name(site):
    plan = read_plan(site)
    assert tuple(plan.tasks) == NAMES
    task = plan.tasks["sites.cases-case-1"]
    assert (task.name, task.kind) == ("sites.cases-case-1", "diagnose")
    assert sorted(task.inputs) == ["calibration", "case.toml", "field", "predict"]
    assert len({t.seed for t in plan.tasks.values()}) == len(NAMES)


def test_a_tasks_seed_is_its_own(folder):
    one = '[[sbc]]\nname = "{}"\nsimulations = 2\ndraw_seed = 5\nmodels = ["bekker"]\n'
    seeds = {}
    for text in ("", "seed = 8\n"):
        planned(folder, text + one.format("a") + one.format("b"))
        for name, task in read_plan(folder / "plan.toml").tasks.items():
            seeds[text, name] = task.seed
    assert len(set(seeds.values())) == 8
    planned(folder, one.format("b") + "seed = 8\n" + one.format("a"))
    again = read_plan(folder / "plan.toml").tasks
    assert again["b.bekker-0000"].seed == seeds["seed = 8\n", "b.bekker-0000"]
    assert again["a.bekker-0001"].seed == seeds["", "a.bekker-0001"]


def test_fits_are_files_by_models_by_priors_by_hold_outs(folder):
    shipped = default_priors("bekker").read_text()
    (folder / "wide.toml").write_text(shipped)
    found = planned(
        folder,
        """
        [[fit]]
        name = "all"
        data = ["data/*.csv", "data/rut.csv"]
        models = ["bekker", "modified_bekker"]
        priors = ["shipped", "wide.toml"]
        hold_out = ["nothing", "inflation_pressure_psi = 30"]
        """,
    )
    assert found == [
        "all.data-rut.bekker.shipped.nothing",
        "all.data-rut.bekker.shipped.inflation_pressure_psi_=_30",
        "all.data-rut.bekker.wide.toml.nothing",
        "all.data-rut.bekker.wide.toml.inflation_pressure_psi_=_30",
        "all.data-rut.modified_bekker.shipped.nothing",
        "all.data-rut.modified_bekker.shipped.inflation_pressure_psi_=_30",
    ]


def test_the_documentations_plan_is_one(tmp_path):
    blocks = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.S)
    text = next(block for block in blocks if "[[fit]]" in block)
    plan = make_site(tmp_path / "site", text)
    (plan.parent / "my_priors.toml").write_text(default_priors("bekker").read_text())
    (plan.parent / "my_effects.py").write_text(EFFECT)
    (plan.parent / "wind.toml").write_text(WIND)
    tasks = read_plan(plan).tasks.values()
    assert {t.kind for t in tasks} == {"fit", "diagnose", "sbc"} == set(KINDS)


@pytest.mark.parametrize("inside", [True, False])
def test_an_effects_priors_are_in_its_class_or_beside_its_file(tmp_path, inside):
    text = '[[diagnose]]\nname = "a"\ncases = ["cases/*"]\neffects = "my_effects.py"\n'
    plan = make_site(tmp_path / "site", text)
    own = EFFECT.replace("    parameters", f'    priors = """{WIND}"""\n    parameters', 1)
    (plan.parent / "my_effects.py").write_text(own if inside else EFFECT)
    if not inside:
        (plan.parent / "wind.toml").write_text(WIND)
    for task in read_plan(plan).tasks.values():
        assert ("effects, wind.toml" in task.inputs) != inside


FIT = '[[fit]]\nname = "a"\ndata = ["data/*.csv"]\nmodels = ["bekker"]\n'
SBC = '[[sbc]]\nname = "a"\nsimulations = 1\ndraw_seed = 1\nmodels = ["bekkar"]\n'
RANKS = '[[sbc]]\nname = "a"\ndraw_seed = 1\nmodels = ["bekker"]\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", ["the plan has no tasks", "[[fit]]", "add a table"]),
        ("seed = 1", ["the plan has no tasks"]),
        ("[[fits]]", ["unknown table fits", "[[fit]]"]),
        ("fit = 3", ["fit is not a list of tables"]),
        ("[fit]\nname = 'a'", ["fit is not a list of tables", "two brackets"]),
        ("seed = -1\n" + FIT, ["the seed is -1", "0 or a positive whole number"]),
        ("seed = true\n" + FIT, ["the seed is True"]),
        ("[[fit\n", ["not valid TOML", "line 1"]),
        (FIT + "colour = 1", ["[[fit]]", "unknown key colour", "max_steps"]),
        (FIT + "max_steps = '9'", ["[[fit]], max_steps", "'9' will not do", "100 or more"]),
        (FIT + "seed = 1.5", ["[[fit]], seed", "1.5 will not do"]),
        ('[[fit]]\nname = "a"\ndata = ["data/*.csv"]', ["models is missing", "calib models"]),
        ('[[fit]]\nname = "a"\ndata = []\nmodels = ["bekker"]', ["[] will not do", "CSV files"]),
        (FIT.replace("data/*.csv", "other/*.csv"), ["no file", "'other/*.csv'", "[[fit]], data"]),
        (FIT.replace("bekker", "becker"), ["[[fit]], models", "becker", "bekker"]),
        (FIT.replace('"a"', '"a b"'), ["[[fit]], name", "'a b' will not do", "a word of"]),
        (FIT + FIT, ["[[fit]] number 2", "the name 'a' is that of"]),
        (FIT + RANKS + "simulations = 1", ["[[sbc]]", "the name 'a' is that of"]),
        (FIT + 'priors = ["none.toml"]', ["[[fit]], priors", "no file 'none.toml'"]),
        (FIT + 'priors = ["soft.toml"]', ["soft.toml holds priors of magic_formula", "bekker"]),
        (FIT.replace("[\"bekker", "[\"magic_formula\", \"bekker") + 'priors = ["soft.toml"]',
         ["no prior file is for bekker", "'shipped'"]),
        (FIT + 'hold_out = ["30 psi"]', ["[[fit]], hold_out", "'30 psi'", "COLUMN=VALUE"]),
        (SBC, ["[[sbc]], models", "bekkar"]),
        ('[[diagnose]]\nname = "a"\ncases = ["data"]', ["no folder with a case.toml", "'data'"]),
        ('[[diagnose]]\nname = "a"\ncases = ["cases/*"]\neffects = "e.py"', ["no file 'e.py'"]),
        (RANKS, ["simulations is missing"]),
        (RANKS + "simulations = 0", ["[[sbc]], simulations", "0 will not do", "1 or more"]),
    ],
)  # fmt: skip
def test_a_plan_that_will_not_do_says_where_and_what_would(folder, text, said):
    (folder / "soft.toml").write_text(default_priors("magic_formula").read_text())
    with pytest.raises(CalibError) as caught:
        planned(folder, text)
    for part in ("plan.toml", *said):
        assert part in str(caught.value)


@pytest.fixture
def emulated() -> Iterator[str]:
    declared = calib.from_callable(
        pull, parameters=PRIORS, conditions=("slip_ratio", "normal_load_kn"),
        output="drawbar_pull_kn", name="slow_wheel", emulate=True,
    )  # fmt: skip
    calib.register(declared)
    yield declared.name
    MODELS.discard(declared.name)
    SIMULATED.discard(declared.name)


def test_replicates_of_a_slow_simulator_are_sent_to_their_verb(folder, emulated):
    sbc = f'[[sbc]]\nname = "a"\nsimulations = 2\ndraw_seed = 1\nmodels = ["{emulated}"]\n'
    with pytest.raises(
        CalibError, match=r"\[\[sbc\]\], models(.|\n)*use calib sbc --model"
    ) as told:
        planned(folder, sbc)
    assert "slow_wheel is emulated for every replicate" in str(told.value)


def test_tasks_depend_on_the_simulator(folder, emulated):
    planned(folder, FIT.replace("bekker", emulated).replace("data/*.csv", "data/rut.csv"))
    (fit,) = read_plan(folder / "plan.toml").tasks.values()
    case = folder / "cases" / "slow"
    shutil.copytree(next((folder / "cases").iterdir()), case)
    text = (case / "case.toml").read_text()
    (case / "case.toml").write_text(re.sub('(drawbar_pull = )"[^"]*"', f'\\1"{emulated}"', text))
    planned(folder, '[[diagnose]]\nname = "a"\ncases = ["cases/slow"]')
    (diagnosis,) = read_plan(folder / "plan.toml").tasks.values()
    digest = SIMULATED[emulated].simulator.digest
    for task in (fit, diagnosis):
        assert task.settings["simulators"] == {emulated: digest}


def test_two_tasks_of_one_name_are_refused(folder):
    (folder / "twins").mkdir(exist_ok=True)
    for name in ("a b.csv", "a_b.csv"):
        (folder / "twins" / name).write_text("")
    with pytest.raises(CalibError, match=r"two tasks would be called a\.twins-a_b"):
        planned(folder, FIT.replace("data/*", "twins/*"))


def test_a_plan_that_is_not_there(tmp_path):
    with pytest.raises(CalibError, match="the plan cannot be read"):
        read_plan(tmp_path / "plan.toml")
    (tmp_path / "plan.toml").write_bytes(b"\xff")
    with pytest.raises(CalibError, match="not valid TOML"):
        read_plan(tmp_path / "plan.toml")
