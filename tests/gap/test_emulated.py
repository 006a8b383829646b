"""An emulator's remaining error in a diagnosis: as in the calibration, shared by both campaigns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import calib
from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.case import Case
from calib.gap.fit import fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis
from calib.gap.noise import Noise
from calib.inference.emulation.prepared import prepare
from calib.inference.likelihood import log_normal
from calib.models.simulators.emulator import emulator_of
from tests.gap.fits import log_joint
from tests.inference.emulation.test_emulate import as_before as as_before
from tests.models.simulators.examples import PRIORS, lab, pull

NOISE = 0.03


def emulated(folder: Path, runs: int) -> Campaigns:
    """The same wheel in both campaigns, its emulator from some runs."""
    calib.register(
        calib.from_callable(
            pull, parameters=PRIORS, conditions=["slip_ratio", "normal_load_kn"],
            output="drawbar_pull_kn", name="wheel", emulate=True, folder=folder, runs=runs,
            first=min(runs, 20), checks=0,
        )
    )  # fmt: skip
    tables = [calib.table_from_arrays(lab(np.random.default_rng(s), NOISE)) for s in (1, 2)]
    prepare("wheel", tables[0], 1)
    return campaigns(Case("case", *tables, {"drawbar_pull": "wheel"}))


def test_a_crude_emulators_error_is_in_the_likelihood(tmp_path: Path) -> None:
    data = emulated(tmp_path, 12)
    (o,) = data.outputs
    simulated = data.simulated["drawbar_pull"]
    emulator = emulator_of(o.problem.bound.model)
    assert emulator is not None
    assert simulated.n_errors >= 1
    forward = Forward(data, Hypothesis("none"), {o.name: NOISE})
    names = [p.name for p in forward.priors.free]
    assert names.count("drawbar_pull.emulator") == simulated.n_errors

    # Its coefficients taken out by integration, it is the density of the calibration: normal with
    # the covariance that noise and emulator have, over the rows of both campaigns together.
    theta = emulator.axes.natural(emulator.regions[-1].centre[None])
    at = simulated.both
    curves = emulator.curves_at(at)[:, 1:]
    covariance = (curves * emulator.typical_variances) @ curves.T
    t = o.priors.to_internal(theta)
    psi = np.zeros((1 + simulated.n_errors, forward.n_dim))
    psi[:, forward.theta_slices[o.name]] = t
    psi[1:, forward.misfit_slices[o.name]] = np.eye(simulated.n_errors)
    predicted = np.concatenate([part[o.name] for part in forward.plain(psi)], axis=1)
    ours = (predicted[1:] - predicted[0]).T @ (predicted[1:] - predicted[0])
    scale = np.sqrt(np.diag(covariance).max())
    np.testing.assert_allclose(ours, covariance, atol=(0.02 * NOISE) ** 2 + 0.01 * scale**2)
    observed = data.observed
    residuals = observed - predicted[:1]
    scaled = curves * np.sqrt(emulator.typical_variances)
    marginal = log_normal(residuals, np.ones(1), scaled, np.array([NOISE]))
    found = np.linalg.slogdet(np.eye(len(observed)) * NOISE**2 + ours)[1]
    weighed = np.linalg.solve(np.eye(len(observed)) * NOISE**2 + ours, residuals[0])
    value = -0.5 * (residuals[0] @ weighed + found + len(observed) * np.log(2.0 * np.pi))
    assert value == pytest.approx(float(marginal[0]), abs=0.05)
    # Conditions of each vector's own, as an effect on a gauge gives, are taken as well.
    own = {name: np.tile(v, (len(psi), 1)) for name, v in at.items()}
    again = simulated.predict(
        psi[:, forward.theta_slices[o.name]], psi[:, forward.misfit_slices[o.name]], own
    )
    np.testing.assert_allclose(again, predicted, rtol=1e-9)


@pytest.mark.slow
def test_a_good_emulator_adds_next_to_nothing(tmp_path: Path) -> None:
    data = emulated(tmp_path, 60)
    simulated = data.simulated["drawbar_pull"]
    assert simulated.n_errors <= 2
    forward = Forward(data, Hypothesis("none"), {"drawbar_pull": NOISE})
    start = np.array([p.loc for p in forward.priors.free])
    start[forward.misfit_slices["drawbar_pull"]] = 0.0
    found = fit(forward, start, {"drawbar_pull": Noise(NOISE)})
    assert np.isfinite(found.log_evidence)
    assert np.isfinite(log_joint(found, found.psi[None])).all()
