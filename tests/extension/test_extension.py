"""Models, quantities and effects of a user's own go through every verb, from one file each."""

from __future__ import annotations

import json
import pickle
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.batch.pool import pool
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.gap.effects import EFFECTS
from calib.models import MODELS
from calib.models.base import BoundModel
from calib.models.simulators.declaration import SIMULATED
from calib.report.page.template import equation
from tests.commands import Calib
from tests.docs.pages import ROOT, blocks
from tests.registered import forgotten

FEW = ["--max-steps", 400]


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    """Forget what a test registers."""
    with forgotten(QUANTITIES, MODELS, EFFECTS, SIMULATED):
        yield
    for name in [m for m in sys.modules if m.startswith("calib_user_")]:
        del sys.modules[name]


def own(name: str) -> Path:
    """Write a file of one's own, as the documentation prints it."""
    page = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")
    text = next(block.text for block in blocks(page) if block.caption == name)
    Path(name).write_text(text, encoding="utf-8")
    return Path(name).resolve()


def field_of(example: str, rng: np.random.Generator) -> str:
    """Return field rows of the torque's example at larger loads, a loss in them."""
    lines = example.splitlines()
    rows = [tuple(map(float, line.split(","))) for line in lines[1:]]
    written = [lines[0].removesuffix(",run_order")]
    for slip, load, *_ in rows:
        for heavier in (1.25, 1.5):
            mobilised = 1.0 - np.exp(-slip / 8.0)
            loss = 0.25 * (heavier * load / 4.0 - 1.0)
            torque = 0.4 * heavier * load * 0.6 * mobilised - loss + 0.02 * rng.standard_normal()
            written.append(f"{slip:g},{heavier * load:g},{1000.0 * torque:.1f}")
    return "\n".join(written) + "\n"


def test_a_new_output_its_model_and_its_effect_go_through_every_verb(run: Calib) -> None:
    mine = ["--models", own("wheel_torque.py")]
    assert "janosi_torque: Wheel torque" in run("models", *mine).out
    assert 'model = "janosi_torque"' in run("priors", "janosi_torque", *mine).out
    example = run("template", "janosi_torque", *mine).out
    Path("torque.csv").write_text(example)
    fitted = run("fit", "torque.csv", "--model", "janosi_torque", *mine, "--out", "run", *FEW,
                 "--hold-out", "normal_load_kn=4")  # fmt: skip
    assert fitted.code == 0, fitted.err
    predicted = run("predict", "run", "--at", "torque.csv", *mine, "--out", "bands.csv")
    assert "18 rows written" in predicted.out
    assert "wheel_torque_knm_predictive_90_lower" in Path("bands.csv").read_text()
    # A report chooses the model by the columns, as for any output.
    made = run("report", "torque.csv", *mine, "--out", "report", "--workers", 1, *FEW)
    assert made.code == 0, made.err
    assert "wheel_torque: converged" in made.out
    summary = json.loads(Path("report/summary.json").read_text())
    assert summary["models"]["wheel_torque"]["model"] == "janosi_torque"
    methods = " ".join(Path("report/methods.txt").read_text().split())
    assert "Janosi & Hanamoto (1961)" in methods
    assert "He et al." not in methods
    page = Path("report/index.html").read_text()
    assert "could not be drawn" not in page
    assert "Wheel torque" in page
    checked = run("check", "report", *mine, "--workers", 1)
    assert checked.code == 0, checked.out
    assert checked.out.startswith("SAME")
    # Without the file nobody knows the model; the message says how to name it.
    assert "--models FILE" in (said := run("template", "my_pull").err)
    assert "in Python, calib.register" in said
    Path("field.csv").write_text(field_of(example, np.random.default_rng(1)))
    found = run("diagnose", "--run", "run", "--field", "field.csv", *mine, "--out", "gap",
                "--workers", 1)  # fmt: skip
    assert found.code == 0, found.err
    assert found.out.startswith("verdict: effect (The gearbox takes more torque")
    assert "could not be drawn" not in Path("gap/index.html").read_text()


def test_a_condition_that_the_simulator_ignores_is_named_as_the_cause(run: Calib) -> None:
    rng = np.random.default_rng(4)
    slip = np.linspace(0.02, 0.6, 20)

    def rows(load: np.ndarray) -> str:
        pull = 1.5 * (1.0 - np.exp(-slip / 0.1)) * (load / 5.0) ** 0.7
        pull = pull + 0.02 * rng.standard_normal(slip.size)
        lines = [f"{s:.3f},{w:g},{p:.4f}" for s, w, p in zip(slip, load, pull, strict=True)]
        return "slip_ratio,normal_load_kn,drawbar_pull_kn\n" + "\n".join(lines) + "\n"

    Path("case").mkdir()
    Path("case/lab.csv").write_text(rows(np.full(20, 5.0)))
    Path("case/field.csv").write_text(rows(np.resize([3.0, 5.0, 8.0], 20)))
    Path("case/fresh.csv").write_text("slip_ratio,normal_load_kn\n0.2,5\n0.3,8\n")
    Path("case/case.toml").write_text(
        'calibration = "lab.csv"\nfield = "field.csv"\npredict = "fresh.csv"\n'
        '[models]\ndrawbar_pull = "magic_formula"\n'
    )
    mine = ["--models", own("load_sensitivity.py")]
    found = run("diagnose", "case", *mine, "--out", "gap", "--workers", 1)
    assert found.code == 0, found.err
    assert "load_sensitivity" in found.out.splitlines()[1]


def test_a_plain_function_is_a_model() -> None:
    def straight(theta: np.ndarray, conditions) -> np.ndarray:
        return theta[:, :1] + theta[:, 1:2] * conditions["slip_ratio"]

    prior = """
[parameters.{name}]
dist = "normal"
mean = 0.0
sd = 10.0
unit = "kN"
reason = "Wide"
source = "Assumed"
"""
    priors = 'model = "straight"\n' + "".join(prior.format(name=n) for n in ("a", "b"))
    priors += (
        prior.format(name="sigma").replace("normal", "half_normal").replace("mean = 0.0\n", "")
    )
    model = calib.Model(
        name="straight", title="A straight line", output="drawbar_pull_kn",
        conditions=("slip_ratio",), parameters=("a", "b"), predict=straight, priors=priors,
    )  # fmt: skip
    calib.register(model)
    rng = np.random.default_rng(1)
    slip = np.linspace(0.0, 0.5, 30)
    pull = 0.2 + 3.0 * slip + 0.05 * rng.standard_normal(30)
    table = calib.table_from_arrays({"slip_ratio": slip, "drawbar_pull_kn": pull})
    problem = calib.build_problem("straight", table)
    found = calib.calibrate(problem, seed=1)
    assert found.converged
    design = np.column_stack([np.ones(30), slip])
    exact = np.linalg.lstsq(design, pull, rcond=None)[0]
    for name, value in zip(("a", "b"), exact, strict=True):
        draws = found.parameters[name]
        assert abs(draws.mean() - value) < 0.1 * draws.std()
    # In every layout in which a likelihood or an effect asks for it.
    bound = BoundModel(model, {})
    theta = np.array([[0.2, 3.0], [0.1, 2.0], [0.0, 1.0], [1.0, 0.0], [2.0, 0.5]])
    each = np.stack([straight(t[None], {"slip_ratio": slip})[0] for t in theta])
    np.testing.assert_allclose(bound.mean_response(theta, {"slip_ratio": slip}), each)
    own = np.tile(slip, (5, 1)) * np.arange(1.0, 6.0)[:, None]
    apart = np.stack(
        [straight(t[None], {"slip_ratio": s})[0] for t, s in zip(theta, own, strict=True)]
    )
    np.testing.assert_allclose(bound.mean_response(theta, {"slip_ratio": own}), apart)
    sse = np.square(pull - each).sum(axis=1)
    np.testing.assert_allclose(problem.squares(theta), sse)


def test_a_function_that_does_not_broadcast_is_evaluated_vector_by_vector() -> None:
    def looped(theta, conditions):
        slip = conditions["slip_ratio"]
        return np.array([[t[0] * s for s in slip] for t in theta])

    model = calib.Model(
        name="looped", title="", output="drawbar_pull_kn", conditions=("slip_ratio",),
        parameters=("a",), predict=looped,
    )  # fmt: skip
    theta, slip = np.arange(1.0, 6.0)[:, None], np.arange(20.0).reshape(5, 4)
    found = BoundModel(model, {}).mean_response(theta, {"slip_ratio": slip})
    np.testing.assert_allclose(found, theta * slip)


def declared(**changes: object) -> calib.Model:
    fields = {
        "name": "mine", "title": "", "output": "drawbar_pull_kn", "conditions": ("slip_ratio",),
        "parameters": ("a",), "predict": lambda theta, conditions: theta,
        "priors": '[parameters.a]\n[parameters.sigma]\n',
    } | changes  # fmt: skip
    return calib.Model(**fields)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "my model"}, ["'my model' is no name for a model"]),
        ({"name": "bekker"}, ["there is a model 'bekker' already"]),
        ({"conditions": ("slip",)}, ["no quantity 'slip'", "slip_ratio"]),
        (
            {"conditions": "slip_ratio"},
            ["conditions is the text", '("slip_ratio",), with the comma'],
        ),
        ({"latex": r"$a \mu$"}, [r'write latex = (r"$a \mu$",), with the comma']),
        ({"output": "slip_ratio"}, ["slip_ratio is no output", "drawbar_pull_kn"]),
        ({"parameters": ("a", "a")}, ["the parameter a is there twice"]),
        ({"priors": ""}, ["has no priors", "calib priors"]),
        ({"priors": "x ="}, ["not valid TOML"]),
        ({"priors": "[parameters.a]\n[parameters.b]\n"}, ["differ by b, sigma"]),
    ],
)
def test_what_is_declared_wrongly_is_named(changes: dict[str, object], words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        calib.register(declared(**changes))
    for word in [*words, "hint:"]:
        assert word in str(caught.value)


def test_a_quantity_must_read_as_itself() -> None:
    torque = {
        "stem": "hub_torque", "canonical": "hub_torque_knm", "kind": "torque", "unit": "kN*m",
        "role": "output", "description": "torque", "suffixes": {"knm": "kN*m"},
    }  # fmt: skip
    calib.register(calib.Quantity(**torque))
    assert calib.table_from_arrays({"hub_torque_knm": np.ones(3)})["hub_torque_knm"].size == 3
    with pytest.raises(CalibError, match="does not name hub_torque"):
        calib.register(calib.Quantity(**torque | {"canonical": "torque"}))
    with pytest.raises(CalibError, match="no suffix for its own unit"):
        calib.register(calib.Quantity(**torque | {"suffixes": {}}))
    with pytest.raises(CalibError, match="columns called sinkage are those of rut_depth already"):
        calib.register(
            calib.Quantity("sinkage", "sinkage_m", "length", "m", "condition", "of a plate")
        )
    with pytest.raises(CalibError, match="cannot be registered"):
        calib.register("hub_torque")  # type: ignore[arg-type]


def test_a_file_that_does_not_run_is_named_with_its_line(run: Calib) -> None:
    Path("mine.py").write_text("import calib\n\nx = 1 / 0\n")
    refused = run("models", "--models", "mine.py")
    assert refused.code == 2
    assert "mine.py, line 3" in refused.err
    assert "ZeroDivisionError" in refused.err
    assert "cannot be read" in run("models", "--models", "nothing.py").err


def test_equations_are_read_from_their_latex() -> None:
    model = declared(latex=(r"$\frac{a}{b} \sqrt{x_1} - \mathrm{CI}^{2n}$",), numbers="Eq 3")
    assert model.equation == "(a)/(b) \u221a(x_1) - CI^(2 n)  (Eq 3)"
    assert "<msub><mi>x</mi><mn>1</mn></msub>" in equation(model.latex, model.numbers)


@pytest.mark.slow
def test_a_model_of_lambdas_is_reported_on_two_processes(run: Calib) -> None:
    """Its functions cannot be pickled, and its server was started before the model was known."""
    with pool(2) as before:
        before.submit(len, "").result()
    text = own("my_model.py").read_text(encoding="utf-8")
    named = text.replace("predict=predict", "predict=lambda theta, x: predict(theta, x)")
    assert named != text
    Path("my_model.py").write_text(named, encoding="utf-8")
    mine = ["--models", "my_model.py"]
    Path("d.csv").write_text(run("template", "janosi_pull", *mine).out)
    made = run("report", "d.csv", "--model", "janosi_pull", *mine, "--out", "report",
               "--workers", 2, *FEW)  # fmt: skip
    assert made.code == 0, made.err
    assert "could not be drawn" not in Path("report/index.html").read_text()
    summary = json.loads(Path("report/summary.json").read_text())
    assert summary["models"]["drawbar_pull"]["model"] == "janosi_pull"


def test_models_travel_by_name_or_whole() -> None:
    model = MODELS["bekker"]
    assert pickle.loads(pickle.dumps(model)) is model
    other = replace(model, name="another", title="Not registered")
    again = pickle.loads(pickle.dumps(other))
    assert (again.name, again.title) == ("another", "Not registered")


@pytest.mark.parametrize(
    ("right", "wrong", "words"),
    [
        ('unit = "kN*m"\nreason = "Torque meters', 'unit = "N*m"\nreason = "Torque meters',
         ["parameters.sigma.unit: the unit is 'N*m'", 'unit = "kN*m"']),
        ('parameters=("mu", "s0"),', 'parameters=("mu", "s0"), reported={"mu": "1", "s0": "%"},',
         ["parameters.s0.unit: the unit is '1'", 'unit = "%"']),
    ],
)  # fmt: skip
def test_a_prior_in_another_unit_than_its_parameter_is_refused(
    run: Calib, right: str, wrong: str, words: list[str]
) -> None:
    text = own("wheel_torque.py").read_text(encoding="utf-8")
    assert text.count(right) == 1
    path = Path("own.py")
    path.write_text(text.replace(right, wrong), encoding="utf-8")
    refused = run("models", "--models", path)
    assert refused.code == 2
    for word in (*words, f"{path.resolve()}, model 'janosi_torque'", "hint: convert"):
        assert word in refused.err


def test_ones_own_are_told_as_well(run: Calib) -> None:
    mine = ["--models", own("wheel_torque.py")]
    assert "wheel_torque_nm: N*m" in run("quantities", "wheel_torque", *mine).out
    assert "predicts" not in run("models", "janosi_torque", *mine).err
    assert "priors" in run("models", "janosi_torque", *mine).out
    told = run("effects", "load_sensitivity", "--effects", own("load_sensitivity.py"))
    assert told.code == 0, told.err
