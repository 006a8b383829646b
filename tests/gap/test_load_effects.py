"""A user's own effects, from a file outside the package."""

from pathlib import Path

import pytest

import calib
from calib.batch.user_code import run_file
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.diagnose import diagnose
from calib.gap.effects import EFFECTS, Effect
from calib.gap.effects.user import check_effects, load_effects
from calib.gap.hypotheses import effect_priors
from tests.gap.cases import make_case

CODE = """
from calib.gap.effects import Effect, Known


class CrossWind(Effect):
    name = "cross_wind"
    title = "wind on the rig adds to the pull"
    parameters = ("force",)
    outputs = ("pull",)

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
        ("import sys\nsys.exit(0)\n", PRIOR, "does not run: SystemExit: 0"),
    ],
)
def test_what_cannot_be_loaded_is_refused(tmp_path, code, prior, word):
    with pytest.raises(CalibError, match=word):
        load_effects(write(tmp_path, code, prior))


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(CalibError, match="cannot be read"):
        load_effects(tmp_path / "none.py")


RETURN = "        return location + phi[:, :1]\n"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "cross_wind"', 'name = "rate_effect"', "an effect of calib's own"),
        ('outputs = ("pull",)', 'outputs = ("pul",)', "did you mean pull?"),
        ('outputs = ("pull",)', 'outputs = ("drawbar_pull",)', "by its physical role, 'pull'"),
        ('outputs = ("pull",)', 'outputs = "pull"', "with the comma"),
        (
            'outputs = ("pull",)',
            'outputs = ("pull",); needs = ("drawbar",)',
            "in needs",
        ),
        ('    outputs', '    covariates = ("sped",)\n    outputs', "did you mean speed?"),
        ('    outputs', '    covariate = ("speed",)\n    outputs', "did you mean covariates?"),
        ('    outputs', '    latex = "$P + F$"\n    outputs', 'write latex = ("$P + F$",), with'),
        ('    outputs', '    covariates = ("speed")\n    outputs', "is the text 'speed'"),
        ('    outputs', '    latex = (1,)\n    outputs', "latex is (1,)"),
        ('    outputs', '    form = ("slope",)\n    outputs', "unknown name 'slope' in form"),
        ('    outputs', '    known = {"pull": 1}\n    outputs', "write known = (Known("),
        ('    outputs', '    known = (Known("sinkage", 1),)\n    outputs', "output one of pull"),
        ('    outputs', '    known = (Known("pull", 2),)\n    outputs', "sign -1, 0 or 1"),
        ('    outputs', '    known = (Known("pull", zero_at="slip"),)\n    outputs',
         "with the comma"),
        ('    outputs', '    known = (Known("pull", zero_at=("slipp",)),)\n    outputs',
         "did you mean slip?"),
        ("def on_output", "def on_outputs", "did you mean on_output?"),
    ],
)  # fmt: skip
def test_what_an_effect_declares_wrongly_is_named(tmp_path, old, new, words):
    with pytest.raises(CalibError) as caught:
        load_effects(write(tmp_path, CODE.replace(old, new)))
    assert words in str(caught.value)
    assert "mine.py, effect" in str(caught.value)


@pytest.mark.parametrize(
    ("attribute", "given", "words"),
    [
        ("form", ("slipp",), "did you mean slip?"), ("covariates", "tread", '("tread",), with'),
        ("outputs", "pull", '("pull",), with'), ("latex", "$P$", '("$P$",), with'),
        ("name", "rate_effect", "of calib's own"),
    ],
)  # fmt: skip
def test_what_an_effect_declares_wrongly_is_named_when_it_is_registered(attribute, given, words):
    kind = type("Mine", (Effect,), {"name": "mine", "outputs": ("pull",), attribute: given})
    with pytest.raises(CalibError) as caught:
        calib.register(kind())
    assert words in str(caught.value)
    assert "mine" not in EFFECTS


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (
            "        return location + phi[:, :1] * undefined\n",
            "line 12: it does not run: NameError",
        ),
        ('        return location + view.conditions["nothing"]\n', "KeyError: 'nothing'"),
        ("        return phi[:, 0]\n", "an array of float64 of shape (8,)"),
        ("        pass\n", "on_output for drawbar_pull returned NoneType"),
        ('        return location + float("nan")\n', "no finite number for drawbar_pull"),
        ("        location += phi[:, :1]\n        return location\n", "mean response it is given"),
        ("        return location\n", "it changes nothing on this case"),
        (
            RETURN + "\n    def on_conditions(self, phi, output, conditions, view):\n"
            "        return {}\n",
            "on_conditions returned a dict with",
        ),
    ],
)
def test_an_effect_that_cannot_be_evaluated_is_refused(tmp_path, code, words):
    path = write(tmp_path, CODE.replace(RETURN, code))
    with pytest.raises(CalibError) as caught:
        check_effects(load_effects(path), make_case("force_offset"))
    assert words in str(caught.value)
    assert "mine.py, effect cross_wind" in str(caught.value)


@pytest.mark.parametrize(
    ("sign", "kept", "broken"),
    [(1, "abs(phi[:, :1])", "phi[:, :1] - 1.0"), (-1, "-abs(phi[:, :1])", "phi[:, :1] + 1.0"),
     (0, "phi[:, :1]", None)],
)  # fmt: skip
def test_an_effect_adds_nothing_against_its_known_sign(tmp_path, sign, kept, broken):
    case = make_case("force_offset")

    def checked(added: str) -> None:
        known = f'    known = (Known("pull", {sign}),)\n    outputs'
        code = CODE.replace("    outputs", known).replace("phi[:, :1]", added)
        folder = tmp_path / str(len(list(tmp_path.iterdir())))  # a file is run once
        folder.mkdir()
        check_effects(load_effects(write(folder, code)), case)

    checked(kept)
    if broken is not None:
        with pytest.raises(CalibError, match=f"nothing {'below' if sign > 0 else 'above'} zero"):
            checked(broken)


MOST = (
    "import numpy as np\n"
    + CODE.replace("    outputs", '    known = (Known("pull", at_most="the pull"),)\n    outputs')
    + """
    def most(self, phi, output, location, view):
        return np.maximum(location, 0.0)
"""
)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("np.maximum(location, 0.0)", "np.zeros(3)", "most for drawbar_pull returned an array of"),
        ("np.maximum(location, 0.0)", "None", "most for drawbar_pull returned NoneType"),
        ("np.maximum(location, 0.0)", "location.astype(complex)", "returned an array of complex"),
        ("np.maximum(location, 0.0)", "-abs(location)", "most returned -"),
        ("np.maximum(location, 0.0)", "np.nan * location", "most returned nan"),
        ("np.maximum(location, 0.0)", "view.of('wind')", "does not run: KeyError"),
        ("return np.maximum(location, 0.0)", "location *= 0.0\n        return location",
         "most changes the mean response"),
        ("most(self, phi, output, location, view)", "most(self, location)", "does not run: Type"),
        ('"the pull"', '"  "', "at_most words"),
        ('"the pull"', "True", "at_most words"),
        ("    def most(", "    most = 3.0\n\n    def other(", "the method most is float"),
    ],
)  # fmt: skip
def test_what_bounds_an_effect_is_tried_as_well(tmp_path, old, new, words):
    case = make_case("force_offset")
    assert MOST.count(old) == 1
    check_effects(load_effects(write(tmp_path, MOST)), case)
    folder = tmp_path / "broken"
    folder.mkdir()
    with pytest.raises(CalibError, match=words):
        check_effects(load_effects(write(folder, MOST.replace(old, new))), case)


def test_an_effect_that_a_case_cannot_show_is_not_tried(tmp_path):
    code = CODE.replace('("pull",)', '("density",)').replace(RETURN, "        raise ValueError\n")
    check_effects(load_effects(write(tmp_path, code)), make_case("force_offset"))


def test_a_good_effect_passes_the_trial(tmp_path):
    path = write(tmp_path)
    check_effects(load_effects(path), make_case("force_offset"))


REGISTERED = "import calib\n" + CODE.replace(
    "    def on_output", f'    priors = """{PRIOR}"""\n\n    def on_output'
)


def diagnose_with(path: Path) -> None:
    """What a file declares is checked when it registers it; then it is tried out."""
    run_file(path, "models")
    diagnose(make_case("force_offset"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("phi[:, :1]", "phii[:, :1]", "it does not run: NameError"),
        ("phi[:, :1]", "exit(0)", "it does not run: SystemExit: 0"),
        ("phi[:, :1]", 'view.of("temperature")', "it does not run: KeyError: 'temperature'"),
        ("location + phi[:, :1]", "phi[:, 0]", "an array of float64 of shape (8,)"),
        ("def on_output", "def on_ouput", "did you mean on_output?"),
        ('outputs = ("pull",)', 'outputs = ("drawbar_pull",)', "by its physical role, 'pull'"),
        (
            "    outputs",
            '    covariates = ("soil_temp",)\n    outputs',
            "unknown name 'soil_temp' in covariates",
        ),
    ],
)
def test_an_effect_that_a_file_registers_is_checked_as_well(tmp_path, old, new, words):
    code = REGISTERED.replace(old, new) + "\n\ncalib.register(CrossWind())\n"
    try:
        with pytest.raises(CalibError) as caught:
            diagnose_with(write(tmp_path, code, None))
    finally:
        EFFECTS.discard("cross_wind")
    assert words in str(caught.value)
    assert "mine.py, effect cross_wind" in str(caught.value)
