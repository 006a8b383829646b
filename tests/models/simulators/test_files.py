"""Simulator files: what is wrong is named with file and key."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.errors import CalibError
from calib.models.simulators.files import read_simulator
from calib.models.simulators.registered import from_callable, models_of
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
        ("name =", "nmae = 1\nname =", ["unknown key nmae", "was name meant?"]),
        ('name = "wheel"\n', "", ["name is missing"]),
        ("name =", "limit = -1\nname =", ["limit"]),
        ("[conditions]", "[emulator]\nrun = 3\n[conditions]", ["emulator.run", "was runs meant?"]),
        ("[parameters.sigma]", "[parameters.simga]", ["no prior of the noise", "sigma"]),
        ('"drawbar_pull_n"', '"drawbar_push"', ["drawbar_push", "no known quantity"]),
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


def test_a_python_function_in_a_file(tmp_path: Path) -> None:
    (tmp_path / "own_wheel.py").write_text("def f(theta, x):\n    return theta[:, :1] * x['s']\n")
    file = write_program(tmp_path, run="", python='"own_wheel.py:f"', emulate="false")
    assert read_simulator(file).simulator.way.runs
    file.write_text(file.read_text().replace("own_wheel.py:f", "own_wheel.py:g"))
    with pytest.raises(CalibError, match="there is no function 'g'"):
        read_simulator(file)
