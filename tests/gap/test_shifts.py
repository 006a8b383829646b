"""How parameters shift: each alone, or together as with another soil."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from calib.errors import CalibError
from calib.gap import discrepancy as module
from calib.gap.campaigns import campaigns
from calib.gap.constants import RADIUS_ERROR, SHIFT_DIFFERENCE
from calib.gap.corrected import Corrected, load_corrected, predict_columns, save_corrected
from calib.gap.describe import shifts
from calib.gap.discrepancy import ZERO_OF_SLIP, another_soil, quantities
from calib.gap.effects import EFFECTS
from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, singles
from calib.gap.mixture import Mixture
from calib.gap.noise import Noise
from calib.inference.mode import prior_widths
from calib.inference.prior_files import default_priors
from calib.models import MODELS as KNOWN
from tests.gap.cases import MODELS, NOISE, PULL_ONLY, campaigns_of, make_case

SIGMA = {o: NOISE[o] for o in MODELS}
SIZE = 0.25


@pytest.fixture(scope="module")
def data():
    return campaigns_of(None)


def drawn_shifts(data, shift_as) -> dict[str, np.ndarray]:
    """Shifts of each parameter in units of its prior sd, drawn from the prior."""
    forward = Forward(data, Hypothesis("parameter_shift", shift=SIZE, shift_as=shift_as), SIGMA)
    psi = forward.priors.sample(np.random.default_rng(1), 40_000)[:, forward.shift_slice]
    shift = forward.shift
    assert shift is not None
    return {
        name: (psi @ shift.parameters[o.name].T)[:, i] / width
        for o in data.outputs
        for i, (name, width) in enumerate(zip(o.priors.names, prior_widths(o.priors), strict=True))
    } | {ZERO_OF_SLIP: psi @ shift.radius_error / RADIUS_ERROR}


def test_end_pressures_share_a_shift_and_differ_by_another():
    assert quantities(("K_lo", "K_hi", "K_bend", "C")) == ["K", "K_difference", "K_bend", "C"]
    assert quantities(("K_lo", "K_hi")) == ["K", "K_difference"]
    assert quantities(("K", "Sh")) == ["K", "Sh"]
    assert quantities(("z_ref", "n")) == ["z_ref", "n0"]


def test_alone_all_pressures_change_alike_and_shapes_less(data):
    drawn = drawn_shifts(data, "alone")
    sds = {name: float(values.std()) for name, values in drawn.items()}
    assert sds["D_lo"] == pytest.approx(SIZE * np.hypot(1.0, SHIFT_DIFFERENCE), rel=0.03)
    assert sds["z_ref"] == pytest.approx(SIZE, rel=0.03)
    assert sds[ZERO_OF_SLIP] == pytest.approx(SIZE, rel=0.03)
    for name in ("K_bend", "D_bend", "G_bend", "n1"):
        assert sds[name] == pytest.approx(SIZE * SHIFT_DIFFERENCE, rel=0.03)
    between = float(np.corrcoef(drawn["D_lo"], drawn["D_hi"])[0, 1])
    d2 = SHIFT_DIFFERENCE**2
    assert between == pytest.approx((1.0 - d2) / (1.0 + d2), abs=0.01)
    assert np.corrcoef(drawn["D_lo"], drawn["z_ref"])[0, 1] == pytest.approx(0.0, abs=0.02)


def test_with_another_soil_they_covary_as_the_prior_file_says(data):
    file = tomllib.loads(default_priors("shifts/another_soil").read_text())["parameters"]
    ways = {name: np.array(row["ways"]) for name, row in file.items()}
    drawn = drawn_shifts(data, "soil")
    shared = {
        "K": 0.5 * (drawn["K_lo"] + drawn["K_hi"]),
        "K_difference": 0.5 * (drawn["K_hi"] - drawn["K_lo"]),
        "D": 0.5 * (drawn["D_lo"] + drawn["D_hi"]),
        "z_ref": drawn["z_ref"],
        "n0": drawn["n0"],
        "n1": drawn["n1"],
        ZERO_OF_SLIP: drawn[ZERO_OF_SLIP],
    }
    for a, x in shared.items():
        for b, y in shared.items():
            expected = ways[a] @ ways[b] + (file[a]["own"] ** 2 if a == b else 0.0)
            scale = x.std() * y.std()
            assert np.mean(x * y) == pytest.approx(SIZE**2 * expected, abs=0.03 * scale), (a, b)


def test_a_softer_soil_gives_less_pull_and_deeper_ruts(data):
    drawn = drawn_shifts(data, "soil")
    assert np.corrcoef(drawn["D_lo"], drawn["z_ref"])[0, 1] < -0.2
    assert np.corrcoef(drawn["K_lo"], drawn["D_lo"])[0, 1] > 0.3


def test_what_the_file_does_not_know_shifts_by_itself():
    data = campaigns(make_case(None, models=PULL_ONLY))
    drawn = drawn_shifts(data, "soil")
    assert drawn["Sh"].std() == pytest.approx(SIZE, rel=0.03)
    assert np.corrcoef(drawn["Sh"], drawn["D"])[0, 1] == pytest.approx(0.0, abs=0.02)


def test_the_prior_names_quantities_of_the_models_and_says_where_it_comes_from():
    known = {q for m in KNOWN.values() for q in quantities(m.parameters)}
    assert set(another_soil()) <= known | {ZERO_OF_SLIP}
    content = tomllib.loads(default_priors("shifts/another_soil").read_text())
    for key in ("unit", "reason", "source"):
        assert len(content[key]) > 5
    assert len(content["ways"]) == len(next(iter(another_soil().values()))[0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ways = [", "cannot be read"),
        ('unit = "1"\nreason = "x"\nsource = "y"\nways = []\n', "cannot be read"),
        (
            'unit = "1"\nreason = "x"\nsource = "y"\nways = ["a", "b"]\n'
            "[parameters.K]\nways = [1.0]\nown = 0.5\n",
            "as many loadings",
        ),
    ],
)
def test_a_damaged_prior_is_refused(tmp_path, monkeypatch, text, said):
    (tmp_path / "another_soil.toml").write_text(text)
    monkeypatch.setattr(module, "default_priors", lambda _: tmp_path / "another_soil.toml")
    with pytest.raises(CalibError, match=said):
        another_soil()


def fitted(data) -> Fit:
    """A soil that shifted by one sd of its first coordinate."""
    forward = Forward(data, Hypothesis("parameter_shift", shift=SIZE, shift_as="soil"), SIGMA)
    psi = np.array([p.loc for p in forward.priors.free])
    psi[forward.shift_slice.start] = SIZE
    noise = {o: Noise(s) for o, s in SIGMA.items()}
    return Fit(forward, psi, 1e-4 * np.eye(psi.size), noise, 0.0, 0.0, {})


def test_the_page_tells_the_shift_of_each_parameter_not_of_a_coordinate(data):
    fit = fitted(data)
    shift = fit.forward.shift
    assert shift is not None
    matrix = shift.parameters["drawbar_pull"]
    names = data.outputs[0].priors.names
    found = {p.name: p for p in shifts(data.outputs, fit)}
    for name in ("K_lo", "K_hi"):
        i = names.index(name)
        value = 100.0 * np.expm1(SIZE * matrix[i, 0])
        assert found[name].mean == pytest.approx(value, rel=0.06)
        assert found[name].unit == "percent"


def test_a_shifted_soil_is_saved_and_loaded(data, tmp_path):
    fit = fitted(data)
    mode = {o.name: np.array([p.loc for p in o.priors.free]) for o in data.outputs}
    corrected = Corrected(Mixture(data, (fit,), (1.0,), 3), mode)
    save_corrected(corrected, tmp_path)
    loaded = load_corrected(tmp_path)
    assert loaded.mixture.fits[0].forward.hypothesis.shift_as == "soil"
    before, after = (predict_columns(c, data.case.field) for c in (corrected, loaded))
    for name in (n for n in before if "_before" in n or "_after" in n):
        np.testing.assert_allclose(after[name], before[name], rtol=1e-9)


def test_another_table_since_does_not_change_a_saved_model(data, tmp_path, monkeypatch):
    fit = fitted(data)
    mode = {o.name: np.array([p.loc for p in o.priors.free]) for o in data.outputs}
    corrected = Corrected(Mixture(data, (fit,), (1.0,), 3), mode)
    save_corrected(corrected, tmp_path)
    before = predict_columns(corrected, data.case.field)
    table = {name: (3.0 * ways, own) for name, (ways, own) in another_soil().items()}
    monkeypatch.setattr(module, "another_soil", lambda: table)
    after = predict_columns(load_corrected(tmp_path), data.case.field)
    for name in (n for n in before if "_before" in n or "_after" in n):
        np.testing.assert_allclose(after[name], before[name], rtol=1e-9)


@pytest.mark.parametrize("shift_as", ["alone", "soil"])
def test_another_zero_of_slip_is_a_wrong_rolling_radius(data, shift_as):
    shifted = Forward(data, Hypothesis("parameter_shift", shift=SIZE, shift_as=shift_as), SIGMA)
    assert shifted.shift is not None
    psi = np.array([[p.loc for p in shifted.priors.free]])
    # Coordinates that shift the zero of slip and no parameter.
    all_rows = np.concatenate(
        [*shifted.shift.parameters.values(), shifted.shift.radius_error[None]]
    )
    only = np.linalg.solve(all_rows, np.eye(len(all_rows))[-1])
    psi[0, shifted.shift_slice] = 0.04 * only
    (wrong,) = singles(data, {"slip_zero_shift": EFFECTS["slip_zero_shift"]})
    known = Forward(data, wrong, SIGMA)
    other = np.array([[p.loc for p in known.priors.free]])
    other[0, known.phi_slices[0]] = 0.04
    found, expected = (f.field(x, data.view) for f, x in ((shifted, psi), (known, other)))
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-9)
        assert not np.allclose(values, shifted.simulator(psi, data.view)[name], rtol=1e-3)


def test_without_a_pull_the_zero_of_slip_is_not_sought():
    models = {"rut_depth": "modified_bekker"}
    ruts = campaigns(make_case(None, models=models))
    forward = Forward(ruts, Hypothesis("parameter_shift", shift=SIZE), {"rut_depth": 0.05})
    assert forward.shift is not None
    assert not forward.shift.radius_error.any()
    assert forward.shift_slice.stop - forward.shift_slice.start == 3


def test_the_page_tells_a_clear_shift_of_the_zero_of_slip(data):
    fit = fitted(data)
    shift = fit.forward.shift
    assert shift is not None
    psi = fit.psi.copy()
    psi[fit.forward.shift_slice] = 0.02 * shift.radius_error / np.square(shift.radius_error).sum()
    sizes = shifts(data.outputs, replace(fit, psi=psi, covariance=1e-8 * fit.covariance))
    assert next(p.mean for p in sizes if not p.name) == pytest.approx(2.0)
