"""An emulator: what a slow simulator would answer, how surely, and where it has no answer.

Every run gives its output at the same m conditions (the nodes). Runs are a matrix, of which a few
basis curves hold all that matters (Higdon et al. 2008, doi:10.1198/016214507000000888):

    y(theta, x) = m(x) + sum_j c_j(theta) b_j(x)

Each c_j is a function of the parameters alone, known at as many points as there are runs; the
curves are functions of the conditions alone (`kriging` has both). One process over parameters and
conditions would need a nearly singular matrix of runs times nodes on a side.

On disk are the runs it stands on and its length scales, to build it again from.
"""

from __future__ import annotations

import json
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.models import MODELS, get_model
from calib.models.base import Array, Conditions, Model
from calib.models.constants import BEYOND_RUNS
from calib.models.simulators.kriging import (
    Kriging,
    Over,
    Region,
    Scales,
    chunks,
    correlation,
    find_scales,
    krige,
    over_conditions,
)


@dataclass(frozen=True)
class Support:
    """The probability that a run has a value, by a Gaussian process behind a logistic curve.

    At its mode the latent function is the kernel between points and `x` (n, d) times `weights` (n,)
    (Rasmussen & Williams 2006, Eq 3.21).
    """

    x: Array
    weights: Array
    lengths: Array
    amplitude: float

    def latent(self, at: Array) -> Array:
        """Return what is positive where a value is the likelier outcome, (k, d) to (k,)."""
        # Zero far from all runs.
        found = [correlation(some, self.x, self.lengths) @ self.weights for some in chunks(at)]
        return self.amplitude * np.concatenate(found)


def learn_support(x: Array, ok: NDArray[np.bool_]) -> Support | None:
    """Learn where there is a value from runs; None where none failed.

    `x`, (n, d), is in units of the prior's sds, `ok` of shape (n,).
    """
    if ok.all() or not ok.any():
        return None
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessClassifier
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    kernel = ConstantKernel(10.0, (1.0, 1e3)) * RBF(np.full(x.shape[1], 1.5), (0.2, 10.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        fitted = GaussianProcessClassifier(kernel).fit(x, ok).base_estimator_
    found = fitted.kernel_
    weights = fitted.y_train_ - fitted.pi_
    return Support(
        x, np.asarray(weights), np.atleast_1d(found.k2.length_scale) * np.ones(x.shape[1]),
        float(found.k1.constant_value),
    )  # fmt: skip


@dataclass(frozen=True)
class Axes:
    """Coordinates in which a prior is round.

    `log` says which parameters are taken as logarithms; `loc` and `width` are middle and sd of the
    prior; (d,) each.
    """

    log: NDArray[np.bool_]
    loc: Array
    width: Array

    def of(self, theta: Array) -> Array:
        """Return coordinates of natural parameters, shape (k, d) to (k, d)."""
        with np.errstate(all="ignore"):
            t = np.where(self.log, np.log(np.where(self.log, theta, 1.0)), theta)
        return np.asarray((t - self.loc) / self.width)

    def natural(self, z: Array) -> Array:
        """Return natural parameters of coordinates."""
        t = z * self.width + self.loc
        return np.where(self.log, np.exp(np.minimum(np.where(self.log, t, 0.0), 700.0)), t)


@dataclass(frozen=True)
class Training:
    """The runs that an emulator stands on, those that failed among them.

    Natural parameters `theta` (k, d); `values` (k, m) on the scale of the response, NaN where a run
    failed; `nodes` are canonical conditions (m,). A `noisy` simulator gives other values each time.
    """

    theta: Array
    values: Array
    nodes: Mapping[str, Array]
    noisy: bool = False

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Which runs have values, shape (k,)."""
        return np.asarray(np.isfinite(self.values).all(axis=1))

    def plus(self, theta: Array, values: Array) -> Training:
        """Return these runs and others."""
        return Training(
            np.concatenate([self.theta, theta]), np.concatenate([self.values, values]), self.nodes,
            self.noisy,
        )  # fmt: skip


@dataclass(frozen=True)
class Emulator:
    """See the module.

    `negligible` is an error of the output that does not matter, `mean` (m,) and `curves` (j, m) the
    orthonormal basis, `functions` the coefficients as functions of the parameters in units of the
    prior's sds. `support` says where there is a value at all, `near` the same more finely in
    regions in which some runs failed; `good` whether it was found good enough in all regions.
    """

    training: Training
    axes: Axes
    negligible: float
    mean: Array
    curves: Array
    functions: Kriging
    over: Over
    regions: tuple[Region, ...]
    support: Support | None
    near: tuple[tuple[Region, Support], ...] = ()
    good: bool = False

    @cached_property
    def _weights(self) -> Array:
        return self.over.weights(np.concatenate([self.mean[None], self.curves]))

    def curves_at(self, conditions: Mapping[str, Array]) -> Array:
        """Return mean and basis curves at conditions, shape (..., 1 + j)."""
        return self.over.at(conditions, self._weights)

    def coefficients(self, theta: Array) -> Array:
        """Return the curves' coefficients, shape (k, d) to (k, j); NaN where there is no value."""
        z, known = self._known(theta)
        means = self.functions.mean(z)
        means[~known] = np.nan
        return means

    def with_unknown(self, theta: Array) -> tuple[Array, Array]:
        """Return coefficients (k, j), and which part of `variances` they have, shape (k,)."""
        z, known = self._known(theta)
        means, unknown = self.functions.mean_and_unknown(z)
        means[~known] = np.nan
        return means, unknown

    def with_variance(self, theta: Array) -> tuple[Array, Array]:
        """Return coefficients and their variances, shape (k, j) each."""
        means, unknown = self.with_unknown(theta)
        return means, unknown[:, None] * self.variances

    @property
    def variances(self) -> Array:
        """Variances of the coefficients where no run tells of them, shape (j,)."""
        return self.functions.variances

    @cached_property
    def typical_variances(self) -> Array:
        """Variances of the coefficients where posteriors lie, shape (j,).

        Means over each region's middle and the points one sd from it along each axis.
        """
        points = [np.zeros((0, self.axes.loc.size))]
        for region in self.regions:
            points += [region.centre[None], region.centre + region.root.T,
                       region.centre - region.root.T]  # fmt: skip
        theta = self.axes.natural(np.concatenate(points))
        means, variances = self.with_variance(theta)
        there = variances[np.isfinite(means).all(axis=1)]
        return np.asarray(there.mean(axis=0)) if len(there) else np.zeros(len(self.curves))

    def _known(self, theta: Array) -> tuple[Array, NDArray[np.bool_]]:
        z = self.axes.of(np.atleast_2d(theta))
        known = np.isfinite(z).all(axis=1)
        z = np.where(known[:, None], z, 0.0)
        return z, known & self.holds(z)

    @cached_property
    def _box(self) -> tuple[Array, Array]:
        z = self.axes.of(self.training.theta[self.training.ok])
        return z.min(axis=0) - BEYOND_RUNS, z.max(axis=0) + BEYOND_RUNS

    def holds(self, z: Array) -> NDArray[np.bool_]:
        """Whether the simulator has a value at z, in units of the prior's sds; (k, d) to (k,).

        Far from all runs that have one nothing is known: a posterior that no value is left for
        where it belongs would flee there, into whatever the trend has gone on to.
        """
        low, high = self._box
        near = ((z >= low) & (z <= high)).all(axis=1)
        return np.asarray(near & (self.from_edge(z) >= 0.0))

    def from_edge(self, z: Array) -> Array:
        """Return what is zero where a value is as likely as none, and grows inside, (k,)."""
        found = np.ones(len(z)) if self.support is None else self.support.latent(z)
        for region, support in self.near:
            inside = region.inside(z)
            found[inside] = support.latent(region.coordinates(z[inside]))
        return found

    def predict(self, theta: Array, conditions: Mapping[str, Array]) -> Array:
        """Return the output on the scale of the response, shape (k, n)."""
        at = self.curves_at(conditions)
        c = self.coefficients(theta)
        if at.ndim == 2:
            return np.asarray(at[:, 0] + c @ at[:, 1:].T)
        return np.asarray(at[..., 0] + np.einsum("kj,knj->kn", c, at[..., 1:]))

    def mean_response(self, conditions: Conditions, /, **parameters: Array) -> Array:
        """Return the prediction, as `Model.mean_response`."""
        asked = {name: conditions[name] for name in self.training.nodes}
        return self.predict(np.concatenate(list(parameters.values()), axis=1), asked)

    def uncertain(self, theta: Array, conditions: Conditions) -> tuple[Array, Array, Array]:
        """Return the prediction and its error, as `Model.uncertain`."""
        means, unknown = self.with_unknown(theta)
        at = self.curves_at(conditions)
        curves = at[:, 1:] * np.sqrt(self.variances)
        return at[:, 0] + means @ at[:, 1:].T, unknown, curves


def _basis(near: Array, all_values: Array, negligible: float) -> tuple[Array, Array]:
    """Return mean and orthonormal curves: first those that near runs need, then the rest.

    They leave an rms error of `negligible` near the posterior, of twenty times that elsewhere.
    """
    mean = near.mean(axis=0)
    curves = np.zeros((0, mean.size))
    for values, left in zip((near, all_values), (1.0, 20.0), strict=True):
        rest = values - mean
        rest = rest - (rest @ curves.T) @ curves
        _, size, right = np.linalg.svd(rest, full_matrices=False)
        # Mean square left out if the curves end before the i-th.
        open_ = np.append(np.cumsum((size**2)[::-1])[::-1], 0.0) / values.size
        count = int(np.argmax(open_ <= (left * negligible) ** 2))
        curves = np.concatenate([curves, right[: min(count, 14 - len(curves))]])
    if not len(curves):
        curves = np.ones((1, mean.size)) / np.sqrt(mean.size)
    return mean, curves


def build_emulator(
    training: Training,
    axes: Axes,
    negligible: float,
    regions: Sequence[Region] = (),
    *,
    scales: Scales | None = None,
    known: bool = False,
    over: Over | None = None,
) -> Emulator:
    """Build an emulator on runs.

    The basis serves first the runs in `regions`, where posteriors lie, and edges beyond which there
    is no value are resolved more finely there. `scales` of an earlier emulator are where to begin,
    or `known`; `over` is that of an earlier emulator on the same nodes.
    """
    ok = training.ok
    z, values = axes.of(training.theta), training.values[training.ok]
    inside = np.zeros(len(values), dtype=bool)
    for region in regions:
        inside |= region.inside(z[ok])
    near = values[inside] if inside.sum() >= 8 else values
    mean, curves = _basis(near, values, negligible)
    coefficients = (values - mean) @ curves.T
    if scales is None or not known:
        scales = find_scales(z[ok], coefficients, noisy=training.noisy, start=scales)
    if over is None:
        some = near[np.linspace(0, len(near) - 1, min(12, len(near))).astype(int)]
        over = over_conditions(training.nodes, some)
    return Emulator(
        training, axes, negligible, mean, curves, krige(z[ok], coefficients, scales), over,
        tuple(regions), learn_support(z, ok), _near(z, ok, regions),
    )  # fmt: skip


def _near(
    z: Array, ok: NDArray[np.bool_], regions: Sequence[Region]
) -> tuple[tuple[Region, Support], ...]:
    found = []
    for region in regions:
        inside = region.inside(z)
        x = region.coordinates(z[inside])
        support = learn_support(x, ok[inside]) if inside.any() else None
        if support is not None:
            found.append((region, support))
    return tuple(found)


def emulated_model(model: Model, emulator: Emulator) -> Model:
    """Return a model with an emulator in the place of its equation."""
    return replace(
        model, predict=None, mean_response=emulator.mean_response, uncertain=emulator.uncertain
    )


def emulator_of(model: Model) -> Emulator | None:
    """Return the emulator behind a model; None if there is none."""
    found = getattr(model.mean_response, "__self__", None)
    return found if isinstance(found, Emulator) else None


def save_emulator(emulator: Emulator, model: str, path: Path) -> None:
    """Write an emulator and its model's name to an ``.npz`` path, whole or not at all."""
    t = emulator.training
    meta = {
        "model": model, "nodes": list(t.nodes), "noisy": t.noisy,
        "negligible": emulator.negligible, "reach": [r.reach for r in emulator.regions],
        "good": emulator.good,
    }  # fmt: skip
    arrays: dict[str, Any] = {
        "meta": np.array(json.dumps(meta)), "theta": t.theta, "values": t.values,
        "log": emulator.axes.log, "loc": emulator.axes.loc, "width": emulator.axes.width,
        "over": emulator.over.lengths,
        **{f"node_{i}": v for i, v in enumerate(t.nodes.values())},
        **{f"centre_{i}": r.centre for i, r in enumerate(emulator.regions)},
        **{f"root_{i}": r.root for i, r in enumerate(emulator.regions)},
    }  # fmt: skip
    arrays["lengths"] = emulator.functions.scales.lengths
    arrays["nugget"] = np.array(emulator.functions.scales.nugget)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part.npz")
    # The archive holds no time stamp: equal emulators give equal files.
    np.savez(part, **arrays)
    part.replace(path)


def load_emulator(path: Path) -> tuple[str, Emulator]:
    """Read an emulator and the name of its model; a CalibError if the file is damaged."""
    try:
        with np.load(path, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
        meta = json.loads(str(arrays["meta"]))
        return meta["model"], _built(meta, arrays)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise CalibError(
            f"the emulator cannot be read ({type(error).__name__})", where=str(path),
            hint="make it again from the simulator's runs: call the same command",
        ) from None  # fmt: skip


def _built(meta: dict[str, Any], arrays: dict[str, Any]) -> Emulator:
    nodes = {name: arrays[f"node_{i}"] for i, name in enumerate(meta["nodes"])}
    regions = [
        Region(arrays[f"centre_{i}"], arrays[f"root_{i}"], reach)
        for i, reach in enumerate(meta["reach"])
    ]
    # Files of earlier versions have scales for each curve, which are estimated again.
    kept = Scales(arrays["lengths"], float(arrays["nugget"])) if "nugget" in arrays else None
    values = arrays["values"]
    found = build_emulator(
        Training(arrays["theta"], values, nodes, bool(meta["noisy"])),
        Axes(arrays["log"], arrays["loc"], arrays["width"]), meta["negligible"], regions,
        scales=kept, known=kept is not None,
        over=over_conditions(nodes, values[:1], arrays["over"]),
    )  # fmt: skip
    return replace(found, good=bool(meta.get("good", False)))


def use_emulator(path: Path) -> None:
    """Replace a model by its emulator on disk, in this process."""
    name, emulator = load_emulator(path)
    model = emulated_model(get_model(name), emulator)
    MODELS.discard(name)
    MODELS.add(replace(model))
