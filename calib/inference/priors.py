"""Priors of many parameters, evaluated for many parameter vectors at once.

Every distribution on offer is a (truncated) normal or a uniform, on the parameter or on its
logarithm. That is enough for physical priors, and it lets one array expression evaluate all
parameters; one of the noise may have a gamma distribution. Sampling happens in *internal*
coordinates: the logarithm for log-normal parameters and that one, the parameter itself otherwise.
`calib.inference.prior_files` reads them from TOML.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc, gammaincinv, gammaln, log_ndtr, ndtr, ndtri, ndtri_exp

from calib.errors import CalibError
from calib.inference.likelihood import IID_NORMAL, Noise
from calib.models.base import Array

type Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Prior:
    """One parameter's prior in internal coordinates: what it is, why, after whom, and in words.

    Parameters
    ----------
    log : bool
        Whether the internal coordinate is the logarithm.
    loc, scale : float
        Of the normal; an infinite scale makes it uniform between the bounds, zero fixes it.
    gamma : tuple of (float, float), optional
        Shape and rate of a gamma distribution, whose internal coordinate is the logarithm; `loc`
        and `scale` are then the mean and sd of that.
    """

    name: str
    unit: str
    reason: str
    source: str
    text: str
    log: bool
    loc: float
    scale: float
    lower: float = -np.inf
    upper: float = np.inf
    gamma: tuple[float, float] | None = None

    @property
    def fixed(self) -> bool:
        """Whether the parameter is not sampled."""
        return self.scale == 0.0


def prior_references(columns: Mapping[str, NDArray[np.float64]]) -> dict[str, float]:
    """Return the scales that priors may be relative to: medians of columns (n,), where positive."""
    medians = {
        name: float(np.median(values[np.isfinite(values)]))
        for name, values in columns.items()
        if np.isfinite(values).any()
    }
    return {name: median for name, median in medians.items() if median > 0.0}


def _in_tail(a: Array, b: Array, u: Array) -> Array:
    """Quantiles (k, d) of standard normals between bounds (d,) far below zero."""
    with np.errstate(divide="ignore", under="ignore"):
        log_mass = np.logaddexp(np.log1p(-u) + log_ndtr(a), np.log(u) + log_ndtr(b))
    return np.asarray(ndtri_exp(log_mass), dtype=np.float64)


@dataclass(frozen=True)
class Priors:
    """The joint prior of a problem, evaluated on the free parameters.

    Entries stand in the order of the model's parameters, others of the noise and its scale
    ``sigma`` last; text and source are those of the TOML file they were read from.
    """

    entries: tuple[Prior, ...]
    text: str = ""
    source: str = ""
    noise: Noise = IID_NORMAL
    free: tuple[Prior, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "free", tuple(p for p in self.entries if not p.fixed))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(p.name for p in self.free)

    @cached_property
    def _arrays(self) -> tuple[Array, ...]:
        loc, scale, lower, upper = (
            np.array([getattr(p, a) for p in self.free]) for a in ("loc", "scale", "lower", "upper")
        )
        normal = np.isfinite(scale) & np.array([p.gamma is None for p in self.free], bool)
        precision = np.where(normal, 1.0 / scale, 0.0)
        return loc, scale, lower, upper, precision

    @cached_property
    def _bounds(self) -> tuple[Array, Array, Mask]:
        """Bounds in sds, on the side where the mass is accurate, and whether that is the other."""
        loc, _, lower, upper, precision = self._arrays
        with np.errstate(invalid="ignore"):
            a, b = (lower - loc) * precision, (upper - loc) * precision
        swap = a > 0.0
        return np.where(swap, -b, a), np.where(swap, -a, b), swap

    @cached_property
    def _gammas(self) -> tuple[tuple[int, float, float], ...]:
        """Place, shape and rate of the gamma distributions."""
        return tuple((j, *p.gamma) for j, p in enumerate(self.free) if p.gamma is not None)

    @cached_property
    def _log_normaliser(self) -> float:
        _, scale, lower, upper, precision = self._arrays
        a, b, _ = self._bounds
        with np.errstate(divide="ignore", invalid="ignore"):
            mass = log_ndtr(b) + np.log1p(-np.exp(log_ndtr(a) - log_ndtr(b)))
            normals = -np.log(scale) - 0.5 * np.log(2.0 * np.pi) - mass
            uniforms = -np.log(upper - lower)
        for j, shape, rate in self._gammas:
            low, high = gammainc(shape, rate * np.exp([lower[j], upper[j]]))
            uniforms[j] = shape * np.log(rate) - gammaln(shape) - np.log(high - low)
        return float(np.where(precision > 0.0, normals, uniforms).sum())

    def log_prob(self, t: Array) -> Array:
        """Log prior density of internal coordinates, (k, d) to (k,); ``-inf`` outside bounds."""
        loc, _, lower, upper, precision = self._arrays
        z = (t - loc) * precision
        inside = ((t >= lower) & (t <= upper)).all(axis=1)
        value = -0.5 * np.einsum("kd,kd->k", z, z) + self._log_normaliser
        for j, shape, rate in self._gammas:
            value += shape * t[:, j] - rate * np.exp(np.minimum(t[:, j], 700.0))
        return np.where(inside, value, -np.inf)

    def ppf(self, u: Array) -> Array:
        """Map the unit cube to internal coordinates, shape (k, d) to (k, d)."""
        loc, scale, lower, upper, precision = self._arrays
        a, b, swap = self._bounds
        with np.errstate(invalid="ignore"):
            below, above = ndtr(a), ndtr(b)
            u_left = np.where(swap, 1.0 - u, u)
            z = ndtri(below + u_left * (above - below))
            # So small a probability has lost digits, or is zero; its logarithm is not.
            if (tail := above < 1e-290).any():
                z[:, tail] = _in_tail(a[tail], b[tail], u_left[:, tail])
            normals = loc + scale * np.where(swap, -z, z)
            uniforms = lower + u * (upper - lower)
            values = np.where(precision > 0.0, normals, uniforms)
        for j, shape, rate in self._gammas:
            low, high = gammainc(shape, rate * np.exp([lower[j], upper[j]]))
            x = gammaincinv(shape, low + u[:, j] * (high - low)) / rate
            values[:, j] = np.log(np.maximum(x, 1e-300))
        return np.asarray(np.clip(values, lower, upper))

    def central(self, level: float) -> dict[str, tuple[float, float]]:
        """Return each free parameter's central interval of a level, in natural values."""
        tail = np.array([[0.5 - 0.5 * level], [0.5 + 0.5 * level]])
        ends = self.to_natural(self.ppf(np.repeat(tail, len(self.free), axis=1)))
        return {
            p.name: (float(low), float(high))
            for p, low, high in zip(self.entries, *ends, strict=True)
            if not p.fixed
        }

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Draw internal coordinates, shape (size, d)."""
        return self.ppf(rng.uniform(size=(size, len(self.free))))

    def stack(self, draws: Mapping[str, Array], shape: tuple[int, ...]) -> Array:
        """Return draws of all parameters by name, fixed ones added, as an array (*shape, d_all)."""
        by_name = [
            np.full(shape, p.loc) if p.fixed else draws[p.name].reshape(shape) for p in self.entries
        ]
        return np.stack(by_name, axis=-1)

    def to_natural(self, t: Array) -> Array:
        """Return all parameters, fixed ones included, shape (k, d) to (k, d_all)."""
        t = np.atleast_2d(t)
        fixed, free, logs = self._layout
        full = np.tile(fixed, (len(t), 1))
        full[:, free] = t
        full[:, logs] = np.exp(np.minimum(full[:, logs], 700.0))
        return full

    @cached_property
    def _layout(self) -> tuple[Array, Mask, Mask]:
        """Values of the fixed parameters, which are free, and which on a log scale."""
        free = np.array([not p.fixed for p in self.entries])
        logs = np.array([p.log and not p.fixed for p in self.entries])
        return np.array([p.loc for p in self.entries]), free, logs

    def to_internal(self, natural: Array, margin: float = 1e-9) -> Array:
        """Map all natural parameters, shape (k, d_all), inside the bounds, shape (k, d)."""
        natural = np.atleast_2d(natural)
        picked = []
        for i, prior in enumerate(self.entries):
            if not prior.fixed:
                x = natural[:, i]
                t = np.log(np.maximum(x, 1e-300)) if prior.log else x
                picked.append(np.clip(t, prior.lower + margin, prior.upper - margin))
        return np.stack(picked, axis=1)

    def fix(self, values: Mapping[str, float]) -> Priors:
        """Return the same priors with some natural parameters held at values."""
        unknown = set(values) - {p.name for p in self.entries}
        if unknown:
            raise CalibError(
                f"cannot fix {', '.join(sorted(unknown))}",
                where=self.source,
                expected=", ".join(p.name for p in self.entries),
            )
        units = {p.name: p.unit for p in self.entries}
        held = {
            name: Prior(
                name, units[name], "held fixed for this fit", "this call", f"fixed at {value:g}",
                False, float(value), 0.0,
            )
            for name, value in values.items()
        }  # fmt: skip
        entries = tuple(held.get(p.name, p) for p in self.entries)
        return Priors(entries, self.text, self.source, self.noise)


@dataclass(frozen=True)
class SumAndRatio(Priors):
    """The same priors in other coordinates: of two logarithms a and b, ln(e^a + c e^b) and b - a.

    The posterior is then nearly normal where data determine only the sum and that of a and b is a
    bent ridge. The Jacobian is one, so densities are unchanged.

    Parameters
    ----------
    first, second : int
        Places of a and b among the free parameters.
    ln_times : float
        ln c.
    """

    first: int = 0
    second: int = 1
    ln_times: float = 0.0

    def joined(self, t: Array) -> Array:
        """Return coordinates (..., d) of those by parameter."""
        u = np.array(t)
        b = t[..., self.second] + self.ln_times
        u[..., self.first] = np.logaddexp(t[..., self.first], b)
        u[..., self.second] = b - t[..., self.first]
        return u

    def by_parameter(self, u: Array) -> Array:
        """Invert `joined`."""
        t = np.array(u)
        t[..., self.first] -= np.logaddexp(0.0, u[..., self.second])
        t[..., self.second] += t[..., self.first] - self.ln_times
        return t

    def log_prob(self, t: Array) -> Array:
        """As of `Priors`."""
        return super().log_prob(self.by_parameter(t))

    def ppf(self, u: Array) -> Array:
        """As of `Priors`."""
        return self.joined(super().ppf(u))

    def to_natural(self, t: Array) -> Array:
        """As of `Priors`."""
        return super().to_natural(self.by_parameter(np.atleast_2d(t)))

    def to_internal(self, natural: Array, margin: float = 1e-9) -> Array:
        """As of `Priors`."""
        return self.joined(super().to_internal(natural, margin))


def sum_and_ratio(
    priors: Priors, joined: tuple[str, str, str] | None, conditions: Mapping[str, Array]
) -> Priors:
    """Return priors in coordinates to sample in, if a model joins two of its parameters.

    Parameters
    ----------
    joined : tuple of str, optional
        Two parameters, and the condition whose mean is c. They need log-normal priors without
        bounds; with others the priors are returned as they are.
    """
    if joined is None or not {*joined[:2]} <= {*priors.names}:
        return priors
    *names, condition = joined
    first, second = (priors.names.index(name) for name in names)
    for p in (priors.free[first], priors.free[second]):
        if (
            not p.log
            or p.gamma
            or not np.isfinite(p.scale)
            or p.lower > -np.inf
            or p.upper < np.inf
        ):
            return priors
    return SumAndRatio(
        priors.entries, priors.text, priors.source, priors.noise, first, second,
        float(np.log(conditions[condition].mean())),
    )  # fmt: skip
