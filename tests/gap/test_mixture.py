"""Draws under all hypotheses at once: how many, how heavy, of what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.gap.hypotheses import Hypothesis, singles
from calib.gap.mixture import Mixture, Truth
from calib.gap.noise import Noise
from tests.gap.cases import CHOICE, campaigns_of
from tests.gap.fits import SIGMA, fit_at


@pytest.fixture(scope="module")
def data():
    return campaigns_of(None)


def offset_fit(data, offset: float):
    (single,) = singles(data, {"force_offset": CHOICE["force_offset"]})
    found = fit_at(data, single)
    psi = found.psi.copy()
    psi[found.forward.phi_slices[0]] = offset
    return replace(found, psi=psi)


def test_readings_have_noise_in_their_own_unit_and_relative_noise_of_ruts(data):
    found = fit_at(data, Hypothesis("none"))
    found = replace(found, noise={**found.noise, "drawbar_pull": Noise(0.03, 2.5)})
    truth = Mixture(data, (found,), (1.0,), 1).at(data.view)
    sds = 0.03 * (1.0 + 2.5 * data.view.slip()), SIGMA["rut_depth"]
    pull, rut = (truth.truth[name] for name in data.names)
    np.testing.assert_allclose(truth.noise["drawbar_pull"], np.tile(sds[0], (1200, 1)))
    np.testing.assert_allclose(truth.noise["rut_depth"], sds[1] * rut)
    for z in (
        (truth.measured["drawbar_pull"] - pull) / sds[0],
        np.log(truth.measured["rut_depth"] / rut) / sds[1],
    ):
        # 1200 x 27 standard normals.
        assert abs(z.mean()) < 5.0 / np.sqrt(z.size)
        assert z.var() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / z.size))


def test_a_cause_may_be_taken_out_of_the_truth_or_put_into_the_simulator(data):
    mixed = Mixture(data, (offset_fit(data, 0.3),), (1.0,), 1)
    usual, without, left_out = (
        mixed.at(data.view, **options)
        for options in ({}, {"without": "force_offset"}, {"left_out": ["force_offset"]})
    )
    name = "drawbar_pull"
    np.testing.assert_allclose(without.truth[name] - without.simulator[name], 0.3)
    np.testing.assert_allclose(left_out.truth[name], usual.simulator[name])
    np.testing.assert_allclose(usual.truth[name] - left_out.truth[name], 0.3)


def test_a_draw_without_a_value_of_one_output_counts_for_none(data):
    found = fit_at(data, Hypothesis("none"))
    sample = np.tile(found.psi, (2, 1))
    sample[1, found.forward.theta_slices["rut_depth"]] = np.nan
    truth = Mixture(data, (replace(found, sample=sample), found), (0.5, 0.5), 1).at(data.view)
    assert 200 < truth.weight.size - 600 < 400
    assert np.isfinite(truth.truth["drawbar_pull"]).all()
    assert truth.weight[-600:].sum() == pytest.approx(0.5)


def test_a_quantile_is_the_first_value_that_so_much_weight_does_not_exceed():
    truth = Truth({}, {}, {}, {}, np.array([0.25, 0.25, 0.3, 0.2]))
    values = np.array([[3.0, 1.0], [1.0, 2.0], [2.0, 3.0], [4.0, 4.0]])
    assert truth.quantile(values, 0.25).tolist() == [1.0, 1.0]
    assert truth.quantile(values, 0.26).tolist() == [2.0, 2.0]
    assert truth.quantile(values, 0.5).tolist() == [2.0, 2.0]
    assert truth.quantile(values, 0.55).tolist() == [2.0, 3.0]
    assert truth.quantile(values, 0.56).tolist() == [3.0, 3.0]
    assert truth.quantile(values, 1.0).tolist() == [4.0, 4.0]
