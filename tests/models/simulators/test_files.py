"""Simulator files: what is wrong is named with file and key."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from calib.errors import CalibError
from calib.inference.prior_files import parse_priors
from calib.models import MODELS
from calib.models.simulators.files import read_simulator, register_file
from calib.models.simulators.registered import SIMULATED, from_callable, models_of, simulated_by
from calib.models.simulators.ways import UmbridgeWay
from tests.models.simulators.examples import PRIORS, pull, write_program


def test_a_file_becomes_a_model(tmp_path: Path) -> None:
    found = read_simulator(write_program(tmp_path))
    (model,) = models_of(found.simulator)
    assert (model.name, model.output) == ("wheel", "drawbar_pull_kn")
    assert model.conditions == ("slip_ratio", "normal_load_kn")
    assert model.parameters == ("mu", "s0")
    assert found.folder == tmp_path / "wheel.runs"


def test_several_outputs_are_several_models() -> None:
    priors = PRIORS.replace("parameters.sigma", "parameters.sigma_F") + PRIORS.split("\n\n")[
        -1
    ].replace("parameters.sigma", "parameters.sigma_z")
    found = from_callable(
        pull, parameters=priors, conditions=["slip_ratio", "normal_load_kn"],
        output={"F": "drawbar_pull_kn", "z": "rut_depth_mm"}, name="both",
    )  # fmt: skip
    assert found.models == ("both_drawbar_pull", "both_rut_depth")
    assert [m.response for m in models_of(found.simulator)] == ["identity", "log"]


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
        ("[conditions]", "[ranges]\nz = [0.0, 1.0]\n[conditions]", ["ranges.z", "s, w"]),
        ("[conditions]", "[conditions", ["not valid TOML"]),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    file = write_program(tmp_path)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(CalibError) as caught:
        read_simulator(file)
    for word in ("wheel.toml", *words):
        assert word in str(caught.value)


def test_a_command_that_does_not_exist(tmp_path: Path) -> None:
    file = write_program(tmp_path, run='"./no-wheel {input} {output}"')
    with pytest.raises(CalibError, match=r"there is no program './no-wheel'"):
        read_simulator(file)


@pytest.mark.parametrize("key", ["run", "python", "table", "template"])
@pytest.mark.parametrize(
    "text", ["'", '"', "\\", " ", "\0", "a\0b", "./a\0b {input}", "A" * 5000, "A" * 300 + ".py:f"]
)
def test_what_no_command_and_no_path_can_be(tmp_path: Path, key: str, text: str) -> None:
    given = {} if key == "run" else {"run": '""'}
    if key == "template":
        given = {"input": '"template"'}
    file = write_program(tmp_path, **given | {key: json.dumps(text)})
    with pytest.raises(CalibError, match=rf"wheel.toml.*{key}|simulator cannot be read"):
        read_simulator(file)


@pytest.mark.parametrize("key", ["run", "python"])
def test_a_link_to_itself_is_no_program(tmp_path: Path, key: str) -> None:
    (tmp_path / "loop.py").symlink_to("loop.py")
    given = {"run": '"./loop.py {input}"'} if key == "run" else {"run": '""', key: '"loop.py:f"'}
    with pytest.raises(CalibError, match=r"loop\.py"):
        read_simulator(write_program(tmp_path, **given))


def test_a_python_function_in_a_file(tmp_path: Path) -> None:
    (tmp_path / "own_wheel.py").write_text("def f(theta, x):\n    return theta[:, :1] * x['s']\n")
    file = write_program(tmp_path, run="", python='"own_wheel.py:f"', emulate="false")
    assert read_simulator(file).simulator.way.runs
    file.write_text(file.read_text().replace("own_wheel.py:f", "own_wheel.py:g"))
    with pytest.raises(CalibError, match="there is no function 'g'"):
        read_simulator(file)


def by(folder: Path, way: str) -> Path:
    """A simulator file that is carried out in another way."""
    file = write_program(folder)
    lines = [line for line in file.read_text().splitlines() if not line.startswith("run =")]
    file.write_text("\n".join([lines[0], way, *lines[1:]]) + "\n")
    return file


def test_a_table_of_runs_is_known_by_its_content(tmp_path: Path) -> None:
    file = by(tmp_path, 'table = "runs.csv"')
    with pytest.raises(CalibError, match="the table of runs cannot be read"):
        read_simulator(file)
    digests = []
    for value in (1.0, 2.0):
        (tmp_path / "runs.csv").write_text(f"mu,s0,s,w,pull\n0.5,0.1,10,4,{value}\n")
        found = read_simulator(file)
        assert not found.simulator.way.runs
        digests.append(found.simulator.digest)
    assert digests[0] != digests[1]


def test_a_table_cannot_be_asked_by_a_sampler(tmp_path: Path) -> None:
    (tmp_path / "runs.csv").write_text("mu,s0,s,w,pull\n0.5,0.1,10,4,1.0\n")
    with pytest.raises(CalibError, match="none where a sampler asks") as caught:
        read_simulator(by(tmp_path, 'table = "runs.csv"\nemulate = false'))
    assert "wheel.toml, emulate" in str(caught.value)


def test_a_server_needs_the_name_of_its_model(tmp_path: Path) -> None:
    with pytest.raises(CalibError, match="the model of the server is not named"):
        read_simulator(by(tmp_path, 'url = "http://localhost:1"'))
    for rows, called in (("all", "config"), ("each", "each")):
        text = f'url = "http://localhost:1"\nmodel = "m"\nrows = "{rows}"\nlimit = 7.0'
        way = read_simulator(by(tmp_path, text)).simulator.way
        assert isinstance(way, UmbridgeWay)
        assert (way.rows, way.limit, way.columns) == (called, 7.0, ("pull",))


def test_the_same_file_is_registered_once_and_a_changed_one_refused(tmp_path: Path) -> None:
    file = write_program(tmp_path, name='"registered_wheel"')
    try:
        found = register_file(file)
        assert register_file(file) is found
        assert simulated_by("registered_wheel") is found
        changed = write_program(tmp_path, name='"registered_wheel"', rows='"each"')
        with pytest.raises(CalibError, match="there is a model 'registered_wheel' already"):
            register_file(changed)
    finally:
        SIMULATED.discard("registered_wheel")
        MODELS.discard("registered_wheel")


def test_a_slow_one_is_not_run_for_each_draw_and_a_quick_one_is(tmp_path: Path) -> None:
    conditions = {"slip_ratio": np.array([0.1, 0.3]), "normal_load_kn": np.array([4.0, 5.0])}
    theta = np.array([[0.5, 0.1], [0.7, 0.2], [-1.0, 0.1]])
    (slow,) = models_of(read_simulator(write_program(tmp_path)).simulator)
    assert slow.predict is not None
    with pytest.raises(CalibError, match="is not run for each parameter vector"):
        slow.predict(theta, conditions)
    fails = "assert p['mu'] > 0"
    quick = write_program(tmp_path, extra=fails, emulate="false", retries="0")
    (model,) = models_of(read_simulator(quick).simulator)
    assert model.predict is not None
    found = model.predict(theta, conditions)
    # Where it fails there is no value.
    np.testing.assert_allclose(found[:2], pull(theta[:2], conditions))
    assert np.isnan(found[2]).all()


def test_a_prior_that_is_no_number_is_named(tmp_path: Path) -> None:
    file = write_program(tmp_path)
    file.write_text(file.read_text().replace("median = 0.5", "median = nan", 1))
    (model,) = models_of(read_simulator(file).simulator)
    with pytest.raises(CalibError, match=r"parameters\.mu.*median = nan is not a finite number"):
        parse_priors(model.priors, "wheel", "wheel", (*model.parameters, "sigma"), {})
