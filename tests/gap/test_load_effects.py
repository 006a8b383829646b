"""A user's own effects, from a file outside the package."""

from pathlib import Path

import pytest

from calib.errors import CalibError
from calib.gap.case import campaigns
from calib.gap.effects.load import load_effects
from calib.gap.hypotheses import effect_priors
from tests.gap.cases import make_case

CODE = """
from calib.gap.effects import Effect


class CrossWind(Effect):
    name = "cross_wind"
    title = "wind on the rig adds to the pull"
    parameters = ("force",)
    outputs = ("drawbar_pull",)

    def on_output(self, phi, output, location, view):
        return location + phi[:, :1]
"""
PRIOR = """model = "cross_wind"
[parameters.force]
dist = "normal"
mean = 0.0
sd = 0.02
relative_to = "normal_load_kn"
default_reference = 5.0
unit = "kN"
reason = "gusts"
source = "a guess"
"""


def write(folder: Path, code: str = CODE, prior: str | None = PRIOR) -> Path:
    path = folder / "mine.py"
    path.write_text(code)
    if prior is not None:
        (folder / "cross_wind.toml").write_text(prior)
    return path


def test_an_effect_and_its_priors_are_loaded(tmp_path):
    effects = load_effects(write(tmp_path))
    assert list(effects) == ["cross_wind"]
    data = campaigns(make_case("force_offset"))
    priors = effect_priors(data, effects["cross_wind"])
    assert priors.names == ("force",)
    assert priors.free[0].scale == pytest.approx(0.02 * data.view.load_kn)


@pytest.mark.parametrize(
    ("code", "prior", "word"),
    [
        (CODE, None, "has no priors"),
        ("x = 1\n", PRIOR, "defines no effect"),
        ("import nothing_of_this_name\n", PRIOR, "does not run"),
    ],
)
def test_what_cannot_be_loaded_is_refused(tmp_path, code, prior, word):
    with pytest.raises(CalibError, match=word):
        load_effects(write(tmp_path, code, prior))


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(CalibError, match="cannot be read"):
        load_effects(tmp_path / "none.py")
