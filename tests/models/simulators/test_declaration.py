"""Declarations of simulators: what is wrong is named with file and key, before any work."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.errors import CalibError
from calib.inference.prior_files import parse_priors
from calib.models import MODELS
from calib.models.simulators.declaration import (
    SIMULATED,
    from_callable,
    models_of,
    simulated_by,
)
from calib.models.simulators.files import load_files, read_simulator, register_file
from calib.models.simulators.runner import UmbridgeRunner
from tests.models.simulators.examples import PRIORS, lab, pull, write_program
from tests.registered import forgotten

NOISE = PRIORS[PRIORS.index("[parameters.sigma]") :]
TAKEN = ["slip_ratio", "normal_load_kn"]


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    """Forget what a test registers."""
    with forgotten(MODELS, SIMULATED):
        yield


def of_two(first: str, second: str, unit: str = "kN") -> str:
    """Priors of a simulator with two outputs, the noise of the second in a unit."""
    noise = [NOISE.replace(".sigma]", f".sigma_{name}]") for name in (first, second)]
    return PRIORS.replace(NOISE, "") + noise[0] + noise[1].replace('"kN"', f'"{unit}"')


def test_a_file_becomes_a_model(tmp_path: Path) -> None:
    found = read_simulator(write_program(tmp_path))
    (model,) = models_of(found.simulator)
    assert (model.name, model.output) == ("wheel", "drawbar_pull_kn")
    assert model.conditions == ("slip_ratio", "normal_load_kn")
    assert model.parameters == ("mu", "s0")
    assert found.folder == tmp_path / "wheel.runs"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("name =", "nmae = 1\nname =", ["unknown key nmae", "did you mean name?"]),
        ("[conditions]", "[condition]", ["unknown key condition", "did you mean conditions?"]),
        ('name = "wheel"\n', "", ["name is missing"]),
        ("name =", "limit = -1\nname =", ["limit"]),
        ("[conditions]", "[emulator]\nrun = 3\n[conditions]", ["emulator.run", "mean runs?"]),
        ("[parameters.sigma]", "[parameters.simga]", ["no prior of the noise", "sigma"]),
        ('"drawbar_pull_n"', '"drawbar_push"', ["outputs.pull: ", "no known quantity"]),
        ('"drawbar_pull_n"', '"drawbar_pull_kpa"', ["outputs.pull: 'kpa' is a unit of pressure"]),
        ('"normal_load_kn"', '"normal_laod_kn"', ["conditions.w: ", "no known quantity"]),
        ("name =", 'url = "http://x"\nname =', ["run, url", "exactly one of"]),
        ("name =", 'template = "none.inp"\nname =', ["the template cannot be read"]),
        ("name =", 'files = ["soil.csv"]\nname =', ["files: the file 'soil.csv' cannot be read"]),
        ("[conditions]", "[ranges]\nz = [0.0, 1.0]\n[conditions]", ["ranges.z", "s, w"]),
        ("[conditions]", "[conditions", ["not valid TOML"]),
        ("wheel.py {input}", "", ["there is no program"]),
        # A name is that of one thing.
        ("s = ", "mu = ", ["conditions.mu", "condition mu has the name of the parameter mu"]),
        ("pull = ", "mu = ", ["outputs.mu", "the output mu has the name of the parameter mu"]),
        ("s = ", "pull = ", ["outputs.pull", "output pull has the name of the condition pull"]),
        ("s = ", "sigma = ", ["conditions.sigma", "has the name of the noise"]),
        (".mu]", ".sigma_pull]", ["parameters.sigma_pull", "the name of the noise of pull"]),
        (".mu]", ".chain]", ["parameters.chain", "a dimension of the files of draws"]),
        (".mu]", ".kind]", ["parameters.kind", "a column of the list of failed runs"]),
        (".mu]", ".slip_ratio]", ["conditions.s", "the name of the parameter slip_ratio"]),
        (".mu]", ".drawbar_pull_kn]", ["outputs.pull", "of the parameter drawbar_pull_kn"]),
        ('"normal_load_kn"', '"drawbar_pull_lbf"', ["outputs.pull", "of conditions.w"]),
        # A letter that can be written in two ways.
        (".mu]", '."\u015f"]', ["conditions.s\u0327", "the name of the parameter \u015f"]),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    run = '"./no-wheel {input}"' if "no program" in words[0] else ""
    file = write_program(tmp_path, **{"run": run} if run else {})
    text = file.read_text(encoding="utf-8")
    if "\u015f" in new:
        text = text.replace("\ns = ", '\n"s\u0327" = ')
    assert run or old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(CalibError) as caught:
        read_simulator(file)
    for word in ("wheel.toml", *words):
        assert word in str(caught.value)


@pytest.mark.parametrize("key", ["run", "python", "table", "template"])
@pytest.mark.parametrize("text", ["'", "\\", " ", "a\0b", "./a\0b {input}", "A" * 5000 + ".py:f"])
def test_what_no_command_and_no_path_can_be(tmp_path: Path, key: str, text: str) -> None:
    given = {} if key == "run" else {"run": '""'}
    if key == "template":
        given = {"input": '"template"'}
    file = write_program(tmp_path, **given | {key: json.dumps(text)})
    with pytest.raises(CalibError, match=rf"wheel.toml.*{key}|simulator cannot be read"):
        read_simulator(file)


def test_a_python_function_in_a_file(tmp_path: Path) -> None:
    (tmp_path / "own_wheel.py").write_text("def f(theta, x):\n    return theta[:, :1] * x['s']\n")
    file = write_program(tmp_path, run="", python='"own_wheel.py:f"', emulate="false")
    assert read_simulator(file).simulator.runner.runs
    file.write_text(file.read_text().replace("own_wheel.py:f", "own_wheel.py:g"))
    with pytest.raises(CalibError, match="there is no function 'g'"):
        read_simulator(file)


def test_a_table_of_runs_is_known_by_its_content(tmp_path: Path) -> None:
    file = write_program(tmp_path, run="", table='"runs.csv"')
    with pytest.raises(CalibError, match="the table of runs cannot be read"):
        read_simulator(file)
    digests = set()
    for value in (1.0, 2.0):
        (tmp_path / "runs.csv").write_text(f"mu,s0,s,w,pull\n0.5,0.1,10,4,{value}\n")
        found = read_simulator(file).simulator
        assert not found.runner.runs
        digests.add(found.digest)
    assert len(digests) == 2
    quick = write_program(tmp_path, run="", table='"runs.csv"', emulate="false")
    with pytest.raises(CalibError, match=r"wheel.toml, emulate: .* no values between its rows"):
        read_simulator(quick)


def test_a_server_needs_the_name_of_its_model(tmp_path: Path) -> None:
    keys = {"run": "", "url": '"http://localhost:1"', "limit": "7.0"}
    with pytest.raises(CalibError, match="the model of the server is not named"):
        read_simulator(write_program(tmp_path, **keys))
    for rows, called in (("all", "config"), ("each", "each")):
        file = write_program(tmp_path, model='"m"', rows=f'"{rows}"', **keys)
        runner = read_simulator(file).simulator.runner
        assert isinstance(runner, UmbridgeRunner)
        assert (runner.rows, runner.limit, runner.columns) == (called, 7.0, ("pull",))


def test_the_same_file_is_registered_once_and_a_changed_one_refused(tmp_path: Path) -> None:
    file = write_program(tmp_path, name='"registered_wheel"')
    found = register_file(file)
    assert register_file(file) is found
    assert simulated_by("registered_wheel") is found
    changed = write_program(tmp_path, name='"registered_wheel"', rows='"each"')
    with pytest.raises(CalibError, match="there is a model 'registered_wheel' already"):
        register_file(changed)


def test_a_slow_one_is_not_run_for_each_draw_and_a_quick_one_is(tmp_path: Path) -> None:
    conditions = {"slip_ratio": np.array([0.1, 0.3]), "normal_load_kn": np.array([4.0, 5.0])}
    theta = np.array([[0.5, 0.1], [0.7, 0.2], [-1.0, 0.1]])
    (slow,) = models_of(read_simulator(write_program(tmp_path)).simulator)
    with pytest.raises(CalibError, match="is not run for each parameter vector"):
        slow.bind(conditions).predict(theta, conditions)
    fails = "assert p['mu'] > 0"
    quick = write_program(tmp_path, extra=fails, emulate="false", retries="0")
    (model,) = models_of(read_simulator(quick).simulator)
    found = model.bind(conditions).predict(theta, conditions)
    # Where it fails there is no value.
    np.testing.assert_allclose(found[:2], pull(theta[:2], conditions))
    assert np.isnan(found[2]).all()
    # No program is asked for conditions of two vectors at once.
    own = {name: np.tile(v, (3, 1)) for name, v in conditions.items()}
    np.testing.assert_allclose(model.bind(conditions).predict(theta, own), found)


def test_a_prior_that_is_no_number_is_named(tmp_path: Path) -> None:
    file = write_program(tmp_path)
    file.write_text(file.read_text().replace("median = 0.5", "median = nan", 1))
    (model,) = models_of(read_simulator(file).simulator)
    with pytest.raises(CalibError, match=r"parameters\.mu.*median = nan is not a finite number"):
        parse_priors(model.priors, "wheel", "wheel", (*model.parameters, "sigma"), {})


def test_several_outputs_are_several_models_registered_all_or_none() -> None:
    both = from_callable(
        pull, parameters=of_two("pull", "rut", "1"), conditions=TAKEN, name="both",
        output={"pull": "drawbar_pull_kn", "rut": "rut_depth_mm"},
    )  # fmt: skip
    assert both.models == ("both_drawbar_pull", "both_rut_depth")
    assert [m.response for m in models_of(both.simulator)] == ["identity", "log"]
    calib.register(from_callable(
        pull, parameters=PRIORS, conditions=TAKEN, output="drawbar_pull_kn", name="both_rut_depth",
    ))  # fmt: skip
    with pytest.raises(CalibError, match="'both_rut_depth' already"):
        calib.register(both)
    assert "both_drawbar_pull" not in MODELS
    assert "both" not in SIMULATED
    with pytest.raises(CalibError, match=r"the column drawbar_pull_kn of outputs\.front"):
        from_callable(
            pull, parameters=of_two("front", "rear"), conditions=TAKEN,
            output={"front": "drawbar_pull_n", "rear": "drawbar_pull_kn"},
        )  # fmt: skip


@pytest.mark.parametrize("name", ["chain", "sigma", "slip_ratio", "drawbar_pull_kn"])
@pytest.mark.parametrize("reported", [True, False])
def test_a_parameter_of_a_model_has_a_name_of_its_own(name: str, reported: bool) -> None:
    own = "mu" if reported else name
    model = calib.Model(
        name="wheel", title="", output="drawbar_pull_kn", conditions=("slip_ratio",),
        parameters=(own, "s0"), predict=pull, priors=PRIORS.replace(".mu]", f".{own}]"),
        reported={name: "1"} if reported else {},
    )  # fmt: skip
    with pytest.raises(CalibError, match=rf"{name} has the name of|{name} is there twice"):
        calib.register(model)
    assert "wheel" not in MODELS


def test_a_model_of_a_file_is_refused_with_its_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(
        "import calib\nfrom tests.models.simulators.examples import PRIORS, pull\n"
        "calib.register(calib.Model(name='wheel', title='', output='drawbar_pull_kn',\n"
        "    conditions=('slip_ratio',), parameters=('chain', 's0'), predict=pull,\n"
        "    priors=PRIORS.replace('.mu]', '.chain]')))\n"
    )
    with pytest.raises(CalibError, match=r"mine.py(.|\n)*chain has the name of a dimension"):
        load_files([path])


@pytest.mark.parametrize(
    ("name", "likelihood"),
    [
        ("rho", 'correlated_along = "run_order"'),
        ("nu", 'family = "student_t"'),
        ("sigma_slope", 'noise_depends_on = "slip"'),
    ],
)
def test_a_noise_that_has_a_parameters_name_is_refused(
    tmp_path: Path, name: str, likelihood: str
) -> None:
    """Under the usual noise the name is free."""
    priors = PRIORS.replace(".mu]", f".{name}]")
    calib.register(from_callable(
        pull, parameters=priors, output="drawbar_pull_kn", name="wheel", conditions=TAKEN,
    ))  # fmt: skip
    table = calib.table_from_arrays(lab(np.random.default_rng(1)) | {"run_order": np.arange(18.0)})
    assert calib.build_problem("wheel", table).bound.model.parameters[0] == name
    file = tmp_path / "own.toml"
    file.write_text(f'model = "wheel"\n[likelihood]\n{likelihood}\n{priors}')
    with pytest.raises(CalibError, match=rf"own.toml, .likelihood.*parameter {name}"):
        calib.build_problem("wheel", table, file)
