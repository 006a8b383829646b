"""The truth under all hypotheses at once: draws, where the gap lies, which causes act."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from calib.data import Table
from calib.data.quantities import OUTPUTS, columns_of
from calib.gap.campaigns import Campaigns, other_conditions
from calib.gap.constants import FALSE_REGIONS, SHARE_ERROR
from calib.gap.effects import View
from calib.gap.fit import Fit
from calib.gap.noise import noise_conditions
from calib.gap.ranking import Ranking
from calib.inference.random import generator
from calib.models.base import Array


@dataclass(frozen=True)
class Truth:
    """Draws at some conditions, on the outputs' own scales (kN, mm, g/cm^3).

    Parameters
    ----------
    simulator : mapping of str to ndarray, shape (draws, n)
        What the simulator says with the drawn parameters.
    truth : mapping of str to ndarray, shape (draws, n)
        What happens in the field.
    noise : mapping of str to ndarray, shape (draws, n)
        Sd of a measurement there.
    measured : mapping of str to ndarray, shape (draws, n)
        The truth with noise.
    weight : ndarray, shape (draws,)
        Of each draw; they sum to one.
    """

    simulator: Mapping[str, Array]
    truth: Mapping[str, Array]
    noise: Mapping[str, Array]
    measured: Mapping[str, Array]
    weight: Array

    def quantile(self, values: Array, q: float) -> Array:
        """Weighted quantile over the draws, shape (draws, n) to (n,)."""
        order = np.argsort(values, axis=0)
        ordered = np.take_along_axis(values, order, axis=0)
        cumulative = np.cumsum(self.weight[order], axis=0)
        index = np.argmax(cumulative >= q - 1e-12, axis=0)
        return np.asarray(ordered[index, np.arange(values.shape[1])])

    @property
    def means(self) -> dict[str, Array]:
        """Mean of the truth of every output, shapes (n,)."""
        return {name: self.mean(values) for name, values in self.truth.items()}

    def mean(self, values: Array) -> Array:
        """Weighted mean over the draws, shape (n,)."""
        return np.asarray(self.weight @ values)


@dataclass(frozen=True)
class Mixture:
    """Fits and how often each is drawn from."""

    data: Campaigns
    fits: tuple[Fit, ...]
    probability: tuple[float, ...]
    seed: int

    def at(self, view: View, without: str | None = None, left_out: Collection[str] = ()) -> Truth:
        """Draw the truth at conditions.

        Parameters
        ----------
        view : View
            From `Campaigns.at` for conditions other than the field's.
        without : str, optional
            A cause, part of every fit: what is predicted without it is in the simulator's place.
        left_out : collection of str, optional
            Causes that no longer act, in the fits that have them.
        """
        parts = [
            self._part(fit, probability, view, i, without, left_out)
            for i, (fit, probability) in enumerate(zip(self.fits, self.probability, strict=True))
        ]
        weight = np.concatenate([part.weight for part in parts])
        simulator, truth, noise, measured = (
            {n: np.concatenate([getattr(part, kind)[n] for part in parts]) for n in self.data.names}
            for kind in ("simulator", "truth", "noise", "measured")
        )
        return Truth(simulator, truth, noise, measured, weight / weight.sum())

    def _part(
        self,
        fit: Fit,
        probability: float,
        view: View,
        index: int,
        without: str | None,
        left_out: Collection[str],
    ) -> Truth:
        """Draw under one hypothesis; the weights carry its probability."""
        size = max(100, int(1200 * probability))
        rng = generator(self.seed, "gap", "truth", fit.forward.hypothesis.name, index)
        psi = fit.draws(rng, size)
        full, plain = fit.forward.field_and_plain(psi, view)
        if left_out:
            full = fit.forward.without(psi, view, *left_out)
        if without is not None:
            plain = fit.forward.without(psi, view, without)
        # Draws for which a model has no value somewhere are left out for all outputs.
        good = np.ones(size, dtype=np.bool_)
        for o in self.data.outputs:
            good &= np.isfinite(plain[o.name]).all(axis=1) & np.isfinite(full[o.name]).all(axis=1)
        simulator, truth, noise, measured = {}, {}, {}, {}
        for o in self.data.outputs:
            bound, mean = o.problem.bound, full[o.name][good]
            sd = fit.noise[o.name].sd(noise_conditions(view)) * np.ones_like(mean)
            simulator[o.name] = bound.from_response(plain[o.name][good])
            truth[o.name] = bound.from_response(mean)
            noise[o.name] = sd * truth[o.name] if bound.model.response == "log" else sd
            measured[o.name] = bound.from_response(mean + sd * rng.standard_normal(sd.shape))
        n = int(good.sum())
        return Truth(simulator, truth, noise, measured, np.full(n, probability / max(n, 1)))


def mixture(data: Campaigns, ranking: Ranking, seed: int) -> Mixture:
    """Gather the fits that matter, hypotheses by probability, their variants by evidence."""
    fits: list[Fit] = []
    weights: list[float] = []
    for name in ranking.order:
        if ranking.probability[name] < 2e-3 and fits:
            continue
        group = ranking.fits[name]
        score = np.array(ranking.scores[name])
        share = np.exp(score - score.max())
        share /= share.sum()
        for f, s in zip(group, share, strict=True):
            if s > 0.05:
                fits.append(_thinned(f))
                weights.append(ranking.probability[name] * float(s))
    total = sum(weights)
    return Mixture(data, tuple(fits), tuple(w / total for w in weights), seed)


def _thinned(fit: Fit) -> Fit:
    """A fit with as many draws as predictions need and a file should hold.

    They are in the order of the pool that they were picked from: every third stands for all.
    """
    return replace(fit, sample=fit.sample[:: max(len(fit.sample) // 500, 1)])


# Physical roles of the conditions, in the order in which a reader looks for a cause; others follow.
_ROLES = (
    "slip",
    "pressure",
    "ground_pressure",
    "speed",
    "passes",
    "water",
    "water_by_volume",
    "cone",
    "load",
    "order",
)


@dataclass(frozen=True)
class RowGap:
    """Gap of one output at the rows of the field campaign.

    Parameters
    ----------
    rows : ndarray of int, shape (n,)
    gap, sd : ndarray, shape (n,)
        Posterior mean and sd of truth minus simulator, in the output's unit.
    probability : ndarray, shape (n,)
        That the true gap is larger than the noise. Hypotheses without a gap count with their
        probability, so that a null campaign stays quiet over all of its rows at once.
    """

    output: str
    rows: NDArray[np.int64]
    gap: Array
    sd: Array
    probability: Array


@dataclass(frozen=True)
class Region:
    """A stretch of one condition, or a value of a category, over which the gap exceeds the noise.

    Parameters
    ----------
    conditions : mapping of str to (float, float)
        Its ends; of a category both are the place of one value in its list.
    gap : float
        Posterior mean of the mean gap over its rows, in the output's unit.
    interval : tuple of float
        Of the mean gap, 90 %.
    probability : float
        That the mean gap exceeds the noise.
    """

    output: str
    conditions: Mapping[str, tuple[float, float]]
    gap: float
    interval: tuple[float, float]
    probability: float


def conditions_to_search(data: Campaigns) -> list[str]:
    """Return the recorded conditions along which a gap may lie somewhere, in a reader's order.

    Those that the case declares come last.
    """
    roles = (*_ROLES, *other_conditions(data.view))
    known = [c for role in roles for c in columns_of(role) if c in data.view.conditions]
    return [*known, *data.case.covariates]


def row_gaps(
    data: Campaigns, truth: Truth, of: Mapping[str, NDArray[np.int64]] | None = None
) -> tuple[RowGap, ...]:
    """Gap at every field row that has the output, or at other rows of each output."""
    found = []
    for o in data.outputs:
        rows = o.rows if of is None else of[o.name]
        gap = (truth.truth[o.name] - truth.simulator[o.name])[:, rows]
        noise = truth.noise[o.name][:, rows]
        mean = truth.mean(gap)
        sd = np.sqrt(np.maximum(truth.mean(np.square(gap)) - mean**2, 0.0))
        probability = truth.mean((np.abs(gap) > noise).astype(np.float64))
        found.append(RowGap(o.name, rows, mean, sd, np.clip(probability, 0.0, 1.0)))
    return tuple(found)


def unused_rows(data: Campaigns, field: Table) -> dict[str, dict[int, str]]:
    """Return the field rows that an output was not judged by, with the reason."""
    kept = data.case.field
    moved = np.any(
        [kept[n] != values for n, values in field.columns.items() if n not in OUTPUTS.values()],
        axis=0,
    )
    found: dict[str, dict[int, str]] = {}
    for o in data.outputs:
        read = np.isfinite(field[OUTPUTS[o.name]])
        found[o.name] = {
            int(row): _why(bool(read[row]), bool(moved[row]))
            for row in np.setdiff1d(np.arange(len(field)), o.rows)
        }
    return found


def _why(read: bool, moved: bool) -> str:
    if not read:
        return "there is no reading"
    if moved:
        return "the conditions were set aside as a mistake; the gap is where they typically are"
    return "the reading was set aside as an outlier or as no reading at all"


def regions(data: Campaigns, truth: Truth, gaps: tuple[RowGap, ...]) -> tuple[Region, ...]:
    """Contiguous stretches of a condition in which rows probably have a gap of one sign.

    Of each output they are sought one after the other, each among the rows that lie in none of
    those before, or every condition would have a stretch that is but the shadow of the first. Of
    all outputs' they are listed, the surest first, as long as the `false_discovery_rate` stays at
    or below `FALSE_REGIONS`.
    """
    found: list[Region] = []
    for o, row_gap in zip(data.outputs, gaps, strict=True):
        draws = (truth.truth[o.name] - truth.simulator[o.name])[:, o.rows]
        noise = truth.noise[o.name][:, o.rows]
        left = np.ones(o.rows.size, dtype=bool)
        searched = conditions_to_search(data)
        varied = [n for n in searched if np.ptp(data.view.conditions[n][o.rows]) > 0.0]
        for _ in range(3):
            best: tuple[float, Region, NDArray[np.bool_]] | None = None
            # Where none varies one stands for all rows.
            for name in varied or searched[:1]:
                values = data.view.conditions[name][o.rows]
                category = bool(data.case.covariates.get(name))
                for low, high in _stretches(values, row_gap, left, category):
                    inside = (values >= low) & (values <= high)
                    region = _region(truth, o.name, {name: (low, high)}, draws, noise, inside)
                    # As many readings of one mean gap: what tells a long stretch from a short one.
                    weight = region.probability * abs(region.gap) * np.sqrt((inside & left).sum())
                    if region.probability > 0.5 and (best is None or weight > best[0]):
                        best = (float(weight), region, inside)
            if best is None:
                break
            found.append(best[1])
            left &= ~best[2]
    found.sort(key=lambda region: -region.probability)
    while found and false_discovery_rate(found) > FALSE_REGIONS:
        found.pop()
    return tuple(found)


def false_discovery_rate(listed: Collection[Region]) -> float:
    """Expected part of regions whose mean gap does not exceed the noise; 0 of none.

    Its posterior mean, whichever rule chose the regions from the data: Müller, Parmigiani & Rice
    (2006), after Newton et al. (2004), doi:10.1093/biostatistics/5.2.155.
    """
    return sum(1.0 - region.probability for region in listed) / max(len(listed), 1)


def _region(
    truth: Truth,
    output: str,
    conditions: Mapping[str, tuple[float, float]],
    draws: Array,
    noise: Array,
    inside: NDArray[np.bool_],
) -> Region:
    mean = draws[:, inside].mean(axis=1)
    within = np.abs(mean) <= noise[:, inside].mean(axis=1)
    ends = _quantile(truth, mean, 0.05), _quantile(truth, mean, 0.95)
    # So that what is within the noise in no draw is exactly certain.
    probability = 1.0 - float(truth.weight @ within)
    return Region(output, conditions, float(truth.weight @ mean), ends, probability)


def _quantile(truth: Truth, draws: Array, q: float) -> float:
    return float(truth.quantile(draws[:, None], q)[0])


def _stretches(
    values: Array, gap: RowGap, left: NDArray[np.bool_], category: bool
) -> list[tuple[float, float]]:
    """The stretches of distinct values whose rows, those left, probably have a gap of one sign.

    Values of a category have no order, so that each is a stretch of its own.
    """
    distinct = np.unique(values)
    groups = np.array_split(distinct, distinct.size if category else min(8, distinct.size))
    rows = [(values >= group[0]) & (values <= group[-1]) & left for group in groups]
    signs = [_sign(gap, inside) for inside in rows]
    fewest = max(2, values.size // 12)
    found = []
    for (sign, _), run in groupby(
        range(len(groups)), key=lambda i: (signs[i], i if category else 0)
    ):
        at = list(run)
        if sign and sum(int(rows[i].sum()) for i in at) >= fewest:
            found.append((float(groups[at[0]][0]), float(groups[at[-1]][-1])))
    return found


def _sign(gap: RowGap, inside: NDArray[np.bool_]) -> float:
    """The sign of the mean gap of some rows; 0 unless a gap of that sign is probable in them."""
    if not inside.any():
        return 0.0
    sign = np.sign(gap.gap[inside].mean())
    same = gap.probability[inside] * (np.sign(gap.gap[inside]) == sign)
    return float(sign) if same.mean() > 0.5 else 0.0


UNLISTED = "unknown"


@dataclass(frozen=True)
class Included:
    """One cause: the probability that it acts, and its share of the gap with a 90 % interval."""

    probability: float
    share: float
    share_interval: tuple[float, float]


@dataclass(frozen=True)
class Inclusion:
    """All causes that were tested, and what is left to something that is not listed.

    Parameters
    ----------
    causes : mapping of str to Included
        Effects, dependences and ``parameter_shift``, the most probable first.
    residual_discrepancy : Included
        Something unlisted, alone or beside listed causes.
    where : tuple of Region
        Where the remainder lies.
    """

    causes: Mapping[str, Included]
    residual_discrepancy: Included
    where: tuple[Region, ...]

    @property
    def acting(self) -> list[str]:
        """Causes that are more likely to act than not, the largest share first."""
        found = [name for name, c in self.causes.items() if c.probability >= 0.5]
        return sorted(found, key=lambda name: -self.causes[name].share)


def inclusion_probability(probability: Mapping[str, float]) -> dict[str, float]:
    """Return for every cause that is a part of some explanation how probable it is to act."""
    found: dict[str, float] = {}
    for name, p in probability.items():
        for cause in name.split("+"):
            if cause != "none":
                found[cause] = found.get(cause, 0.0) + p
    return {name: min(p, 1.0) for name, p in found.items()}


def inclusion(mixed: Mixture, ranking: Ranking) -> Inclusion:
    """Work out which causes act, and their shares.

    Parameters
    ----------
    ranking : Ranking
        That it was made from.
    """
    data = mixed.data
    found = inclusion_probability(ranking.probability)
    names = sorted((n for n in found if n != UNLISTED), key=lambda n: -found[n])
    shares, weight = _shares(mixed, [*names, UNLISTED])
    included = {
        name: Included(found.get(name, 0.0), *_mean_and_interval(shares[:, i], weight))
        for i, name in enumerate([*names, UNLISTED])
    }
    rest = included.pop(UNLISTED)
    where = _where(data, mixed) if rest.probability >= 0.1 else ()
    return Inclusion(included, rest, where)


def _shares(mixed: Mixture, names: list[str]) -> tuple[Array, Array]:
    """Share of each cause in each draw that has a gap, shape (draws, causes), and weights."""
    shares, weights = [np.zeros((0, len(names)))], [np.zeros(0)]
    for i, (fit, probability) in enumerate(zip(mixed.fits, mixed.probability, strict=True)):
        causes = fit.forward.causes
        if not causes:
            continue
        size = max(60, int(800 * probability))
        rng = generator(mixed.seed, "gap", "shares", fit.forward.hypothesis.name, i)
        rms = _sizes(mixed.data, fit, fit.draws(rng, size))
        rms *= np.exp(SHARE_ERROR * rng.standard_normal(rms.shape))
        rms = rms[np.isfinite(rms).all(axis=1) & (rms.sum(axis=1) > 0.0)]
        part = np.zeros((rms.shape[0], len(names)))
        part[:, [names.index(c) for c in causes]] = rms / rms.sum(axis=1, keepdims=True)
        shares.append(part)
        weights.append(np.full(rms.shape[0], probability / max(rms.shape[0], 1)))
    weight = np.concatenate(weights)
    return np.concatenate(shares), weight / weight.sum()


def _sizes(data: Campaigns, fit: Fit, psi: Array) -> Array:
    """Rms of what goes with each cause over all field rows, in noise sds, shape (k, causes)."""
    forward = fit.forward
    full = forward.field(psi, data.view)
    columns = []
    for cause in forward.causes:
        other = forward.without(psi, data.view, cause)
        gone = data.in_noise({name: full[name] - other[name] for name in full}, fit.noise)
        columns.append(np.sqrt(np.square(np.hstack([*gone.values()])).mean(axis=1)))
    return np.stack(columns, axis=1)


def _mean_and_interval(share: Array, weight: Array) -> tuple[float, tuple[float, float]]:
    if not share.size:
        return 0.0, (0.0, 0.0)
    order = np.argsort(share)
    cumulative = np.cumsum(weight[order])
    low, high = (float(share[order][np.searchsorted(cumulative, q)]) for q in (0.05, 0.95))
    mean = float(weight @ share)
    return mean, (min(low, mean), max(high, mean))


def _where(data: Campaigns, mixed: Mixture) -> tuple[Region, ...]:
    """Where what is not listed lies: the gap that is left once the listed causes are in."""
    unlisted = [
        (fit, p)
        for fit, p in zip(mixed.fits, mixed.probability, strict=True)
        if UNLISTED in fit.forward.causes
    ]
    if not unlisted:
        return ()
    total = sum(p for _, p in unlisted)
    of_these = replace(
        mixed,
        fits=tuple(fit for fit, _ in unlisted),
        probability=tuple(p / total for _, p in unlisted),
    )
    truth = of_these.at(data.view, without=UNLISTED)
    return regions(data, truth, row_gaps(data, truth))
