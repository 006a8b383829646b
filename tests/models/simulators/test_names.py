"""A name is that of one thing, or is refused before any work, with file and key."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.errors import CalibError
from calib.models import MODELS
from calib.models.simulators.files import read_simulator
from calib.models.simulators.registered import SIMULATED
from tests.models.simulators.examples import PRIORS, lab, pull, write_program
from tests.registered import forgotten


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    """Forget what a test registers."""
    with forgotten(MODELS, SIMULATED):
        yield


@pytest.mark.parametrize(
    ("old", "new", "key", "words"),
    [
        ("s = ", "mu = ", "conditions.mu", "the condition mu has the name of the parameter mu"),
        ("pull = ", "mu = ", "outputs.mu", "the output mu has the name of the parameter mu"),
        ("s = ", "pull = ", "outputs.pull", "the output pull has the name of the condition pull"),
        ("s = ", "sigma = ", "conditions.sigma", "has the name of the noise"),
        (".mu]", ".sigma_pull]", "parameters.sigma_pull", "has the name of the noise of pull"),
        (".mu]", ".chain]", "parameters.chain", "a dimension of the files of draws"),
        (".mu]", ".draw]", "parameters.draw", "a dimension of the files of draws"),
        (".mu]", ".row]", "parameters.row", "a dimension of the files of draws"),
        (".mu]", ".kind]", "parameters.kind", "a column of the list of failed runs"),
        (".mu]", ".slip_ratio]", "conditions.s", "the name of the parameter slip_ratio"),
        (".mu]", ".drawbar_pull_kn]", "outputs.pull", "the name of the parameter drawbar_pull_kn"),
        ('"normal_load_kn"', '"drawbar_pull_lbf"', "outputs.pull", r"of conditions\.w"),
        # A letter that can be written in two ways.
        (".mu]\n", '."\u015f"]\n', "conditions.s\u0327", "the name of the parameter \u015f"),
    ],
)
def test_two_things_of_one_name_are_refused(
    tmp_path: Path, old: str, new: str, key: str, words: str
) -> None:
    file = write_program(tmp_path)
    text = file.read_text(encoding="utf-8")
    if "\u0327" in key:
        text = text.replace("\ns = ", '\n"s\u0327" = ')
    assert text.count(old) == 1
    file.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(CalibError, match=words) as refused:
        read_simulator(file)
    for word in (f"wheel.toml, simulator wheel, {key}", "hint: rename"):
        assert word in str(refused.value)


def test_a_quantity_that_two_outputs_give_is_refused() -> None:
    noise = PRIORS[PRIORS.index("[parameters.sigma]") :]
    priors = PRIORS.replace(noise, "") + "".join(
        noise.replace(".sigma]", f".sigma_{name}]") for name in ("front", "rear")
    )
    with pytest.raises(
        CalibError, match=r"the name of the column drawbar_pull_kn of outputs\.front"
    ):
        calib.from_callable(
            pull, parameters=priors, conditions=["slip_ratio", "normal_load_kn"],
            output={"front": "drawbar_pull_n", "rear": "drawbar_pull_kn"},
        )  # fmt: skip


@pytest.mark.parametrize("name", ["chain", "draw", "row", "sigma", "slip_ratio", "drawbar_pull_kn"])
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
    from calib.models.simulators.files import load_files

    with pytest.raises(CalibError, match="chain has the name of a dimension") as refused:
        load_files([path])
    assert "mine.py" in str(refused.value)


def test_registering_is_all_or_nothing() -> None:
    """Of two outputs the second model's name is taken."""
    noise = PRIORS[PRIORS.index("[parameters.sigma]") :]
    priors = PRIORS.replace(noise, "") + "".join(
        noise.replace(".sigma]", f".sigma_{name}]") for name in ("pull", "rut")
    )
    given = {"parameters": PRIORS, "conditions": ["slip_ratio", "normal_load_kn"]}
    calib.register(calib.from_callable(
        pull, output="drawbar_pull_kn", name="both_rut_depth", **given,  # type: ignore[arg-type]
    ))  # fmt: skip
    priors = priors.replace('"kN"', '"1"').replace('"1"', '"kN"', 3).replace('"kN"', '"1"', 2)
    both = calib.from_callable(
        pull, output={"pull": "drawbar_pull_kn", "rut": "rut_depth_mm"}, name="both",
        **given | {"parameters": priors},  # type: ignore[arg-type]
    )  # fmt: skip
    with pytest.raises(CalibError, match="'both_rut_depth' already"):
        calib.register(both)
    assert "both_drawbar_pull" not in MODELS
    assert "both" not in SIMULATED


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
    calib.register(calib.from_callable(
        pull, parameters=priors, output="drawbar_pull_kn", name="wheel",
        conditions=["slip_ratio", "normal_load_kn"],
    ))  # fmt: skip
    table = calib.table_from_arrays(lab(np.random.default_rng(1)) | {"run_order": np.arange(18.0)})
    assert calib.build_problem("wheel", table).bound.model.parameters[0] == name
    file = tmp_path / "own.toml"
    file.write_text(f'model = "wheel"\n[likelihood]\n{likelihood}\n{priors}')
    with pytest.raises(CalibError, match=f"the model has a parameter {name}") as refused:
        calib.build_problem("wheel", table, file)
    assert "own.toml, [likelihood]" in str(refused.value)
