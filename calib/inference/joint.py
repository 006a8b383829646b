"""Several data sets, one posterior: outputs that share parameters, groups that are alike.

*Outputs.* Pull, torque and sinkage of one wheel on one soil, or plates pressed into that soil, are
data on the same parameters. The log likelihoods of all outputs are added, each with its own noise;
a parameter of the same name, unit and meaning is one parameter.

*Groups.* Rows of one run, soil bin, tyre or operator are more alike than rows of several. Of chosen
parameters each group has its own value, in internal coordinates (logarithms of log-normal ones)

    theta_g ~ normal(mu, tau^2),

within the bounds of the prior, where mu has the prior of the prior file and tau, the sd between
groups, an exponential one: tau exceeds the sd of the prior file with a probability of 5 %, a
penalised-complexity prior (Simpson et al. 2017, doi:10.1214/16-STS576). Groups then share what they
have in common (Gelman & Hill 2007, Data Analysis Using Regression and Multilevel Models, ch. 12).

*Coordinates.* What is best sampled, a group's value or its distance from the mean in units of tau,
depends on how much its rows say (Papaspiliopoulos, Roberts & Skold 2007,
doi:10.1214/088342307000000014). Given all other parameters h, a group's values are nearly normal,

    theta_g = m_g(h) + L_g(h) u_g,    V_g = L_g L_g' = (J'J + T^-1)^-1,

J being the derivatives of its standardised residuals at a first estimate and T = diag(tau^2). The
coordinates sampled are h and u, of which u is nearly standard normal whatever the rows say; the
density is exact, with the Jacobian |L_g|.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Integral

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma, log_ndtr, ndtr, ndtri, polygamma

from calib.arguments import takes
from calib.data import Table, as_table
from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS, output_of
from calib.data.reader import Tabular
from calib.errors import CalibError
from calib.inference.calibration import Calibration, ParameterSummary, sd_ratios, summarise
from calib.inference.constants import CHUNK_CELLS, HALF_LN_2PI
from calib.inference.diagnostics import judge
from calib.inference.mode import climb, find_modes, prior_widths
from calib.inference.prior_files import PriorFile
from calib.inference.priors import Prior, Priors, SumAndRatio, sum_and_ratio
from calib.inference.problem import Problem, build_problem
from calib.inference.random import generator, stream
from calib.inference.sampler import (
    Draws,
    Progress,
    SamplerSettings,
    in_coordinates,
    sample_joint,
)
from calib.models import get_model
from calib.models.base import Array, BoundModel, Model

# Ends what a calibration of a group that is not among the data is part of.
NEW_GROUP = "a new group"
# What the noise of each output has for itself.
_OF_NOISE = ("sigma", "nu", "sigma_slope", "rho")


@dataclass(frozen=True)
class Part:
    """One output's rows, or those of one group, and where its parameters are found.

    Parameters
    ----------
    problem : Problem
    columns : ndarray of int, shape (d,)
        Place of each of its free parameters among those of the joint problem.
    group : int
        Place of its group; -1 where there are none.
    own : tuple of (int, int)
        Its parameters that differ between groups: place in the part, place among those pooled.
    """

    problem: Problem
    columns: NDArray[np.intp]
    group: int = -1
    own: tuple[tuple[int, int], ...] = ()

    def coordinates(self, h: Array, theta: Array) -> Array:
        """Internal coordinates (k, d) of the joint ones (k, d_h) and of groups (k, g, q)."""
        t = h[:, self.columns]
        for place, j in self.own:
            t[:, place] = theta[:, self.group, j]
        return t


@dataclass(frozen=True)
class _Centre:
    """Of one part: what its rows say of its group's parameters, linear about a first estimate.

    Parameters
    ----------
    precision : ndarray, shape (q, q)
        J'J of the standardised residuals.
    pull : ndarray, shape (q,)
        J'J theta0 + J'r.
    slope : ndarray, shape (q, d_h)
        Of the pull, over the other parameters.
    sigma : int
        Place of the logarithm of its noise's scale; -1 where that is no coordinate.
    """

    precision: Array
    pull: Array
    slope: Array
    sigma: int


@dataclass(frozen=True, repr=False)
class JointProblem:
    """Parts that share parameters, as one log density; made by `build_joint`.

    Parameters
    ----------
    priors : Priors
        Of the parameters h: shared and separate ones, means and sds between groups.
    parts : mapping of (str, str) to Part
        By output and group; of no group where there are none.
    pooled : tuple of str
        Parameters that differ between groups.
    groups : tuple of str
    shared : mapping of str to tuple of str
        Parameters that several outputs have in common, and these.
    wholes : mapping of str to Problem
        By output, with the rows of all groups.
    column : str
        That tells the groups.
    labels : mapping of str to ndarray of str
        By output, the group of each row.
    """

    priors: Priors
    parts: Mapping[tuple[str, str], Part]
    wholes: Mapping[str, Problem]
    column: str = ""
    labels: Mapping[str, NDArray[np.str_]] = field(default_factory=dict)
    pooled: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    shared: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    centres: Mapping[tuple[str, str], _Centre] = field(default_factory=dict)
    origin: Array = field(default_factory=lambda: np.zeros(0))

    def __repr__(self) -> str:
        rows = sum(len(whole.table) for whole in self.wholes.values())
        groups = f", {len(self.groups)} groups" if self.groups else ""
        return f"<JointProblem of {', '.join(self.outputs)}: {rows} rows{groups}>"

    @property
    def models(self) -> tuple[Model, ...]:
        """The models, by output."""
        return tuple(whole.bound.model for whole in self.wholes.values())

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return tuple(self.wholes)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates that are sampled."""
        return (*self.priors.names, *(f"{p}[{g}]" for g in self.groups for p in self.pooled))

    def without(self, outputs: Collection[str]) -> JointProblem:
        """Return the problem without some outputs, whose parameters stay."""
        parts = {k: p for k, p in self.parts.items() if k[0] not in outputs}
        wholes = {k: w for k, w in self.wholes.items() if k not in outputs}
        return replace(self, parts=parts, wholes=wholes)

    def with_models(self, models: Sequence[Model]) -> JointProblem:
        """Return the problem with other models in the place of those of their names: emulators."""
        named = {model.name: model for model in models}

        def with_its(problem: Problem) -> Problem:
            model = named.get(problem.bound.model.name, problem.bound.model)
            return replace(problem, bound=replace(problem.bound, model=model))

        parts = {k: replace(p, problem=with_its(p.problem)) for k, p in self.parts.items()}
        wholes = {k: with_its(whole) for k, whole in self.wholes.items()}
        return replace(self, parts=parts, wholes=wholes)

    @cached_property
    def _places(self) -> tuple[Array, Array]:
        """Places of means and of sds between groups, each (q,)."""
        names = self.priors.names
        mean = [names.index(p) for p in self.pooled]
        return np.array(mean, dtype=int), np.array(
            [names.index(f"tau_{p}") for p in self.pooled], dtype=int
        )

    @cached_property
    def _bounds(self) -> Array:
        free = {p.name: p for p in self.priors.free}
        return np.array([(free[p].lower, free[p].upper) for p in self.pooled]).reshape(-1, 2).T

    def split(self, t: Array) -> tuple[Array, Array, Array]:
        """Return h (k, d_h), groups' values (k, g, q) and ln|L| (k,) of coordinates (k, d)."""
        (h, u), q, n = self.parted(t), len(self.pooled), len(self.groups)
        if not q:
            return h, u, np.zeros(len(t))
        mean, tau = self._places
        weight = np.exp(-2.0 * h[:, tau])
        precision = np.zeros((len(t), n, q, q))
        precision[..., np.arange(q), np.arange(q)] = weight[:, None]
        pull = np.repeat((weight * h[:, mean])[:, None], n, axis=1)
        away = h - self.origin
        for key, c in self.centres.items():
            g = self.parts[key].group
            scale = np.exp(-2.0 * away[:, c.sigma]) if c.sigma >= 0 else np.ones(len(t))
            precision[:, g] += scale[:, None, None] * c.precision
            pull[:, g] += scale[:, None] * (c.pull - away @ c.slope.T)
        root = np.linalg.cholesky(precision)  # of the inverse of V: L is its inverse's transpose
        back = np.swapaxes(np.linalg.inv(root), -1, -2)
        centre = np.einsum("kgij,kglj,kgl->kgi", back, back, pull)
        theta = centre + np.einsum("kgij,kgj->kgi", back, u)
        ln_size = -np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=(1, 2))
        return h, theta, ln_size

    def log_between(self, h: Array, theta: Array) -> Array:
        """Log density of the groups' values (k, g, q) given their means and sds, shape (k,)."""
        mean, tau = (h[:, None, places] for places in self._places)
        sd = np.exp(tau)
        low, high = self._bounds
        z = (theta - mean) / sd
        inside = ((theta >= low) & (theta <= high)).all(axis=(1, 2))
        a, b = (low - mean) / sd, (high - mean) / sd
        mass = log_ndtr(b) + np.log1p(-np.exp(np.minimum(log_ndtr(a) - log_ndtr(b), 0.0)))
        value = (-0.5 * z * z - tau - HALF_LN_2PI - mass).sum(axis=(1, 2))
        return np.where(inside, value, -np.inf)

    def log_prob(self, t: Array) -> Array:
        """Log posterior density (unnormalised) of coordinates (k, d), shape (k,)."""
        value = np.full(len(t), -np.inf)
        good = np.isfinite(self.priors.log_prob(t[:, : len(self.priors.free)]))
        with np.errstate(all="ignore"):
            h, theta, ln_size = self.split(t[good])
            value[good] = ln_size + self.log_posterior(h, theta)
        return np.where(np.isnan(value), -np.inf, value)

    def log_posterior(self, h: Array, theta: Array) -> Array:
        """Log density of parameters (k, d_h) and groups' values (k, g, q), shape (k,)."""
        with np.errstate(all="ignore"):
            value = self.priors.log_prob(h) + self.log_between(h, theta)
            for i in np.array_split(np.flatnonzero(np.isfinite(value)), self._chunks(len(h))):
                value[i] += self._log_likelihood(h[i], theta[i]) if i.size else 0.0
        return np.where(np.isnan(value), -np.inf, value)

    def _chunks(self, vectors: int) -> int:
        rows = sum(whole.squares.mean.size for whole in self.wholes.values())
        return 1 + vectors * rows // CHUNK_CELLS

    @cached_property
    def _together(self) -> tuple[tuple[tuple[str, str], ...], ...]:
        """Parts whose models have their work in common, and the same parameters and conditions."""
        found: dict[object, list[tuple[str, str]]] = {}
        for key, part in self.parts.items():
            bound, at = part.problem.bound, part.problem.squares.conditions
            shared = bound.model.whole is not None and part.problem.noise.iid_normal
            free = part.problem.priors.names
            columns = part.columns[[n not in _OF_NOISE for n in free]]
            held = tuple((p.name, p.loc) for p in part.problem.priors.entries if p.fixed)
            values = tuple(v.tobytes() for v in at.values())
            same = (bound.model.whole, columns.tobytes(), part.group, held, values)
            found.setdefault(same if shared else key, []).append(key)
        return tuple(map(tuple, found.values()))

    def _log_likelihood(self, h: Array, theta: Array) -> Array:
        """Sum over all parts, of coordinates (k, d_h) and groups' values (k, g, q), shape (k,)."""
        value = np.zeros(len(h))
        for keys in self._together:
            parts, whole = [self.parts[key] for key in keys], None
            for part in parts:
                problem, t = part.problem, part.coordinates(h, theta)
                bound, function = problem.bound, problem.bound.model.whole
                if function is None or len(parts) == 1:
                    value += problem.log_likelihood(t)
                    continue
                if whole is None:
                    natural = problem.of_model(problem.theta(t))
                    whole = bound.call(function, natural, problem.squares.conditions)
                value += problem.log_likelihood(t, bound.part(whole))
        return value

    def parted(self, t: Array) -> tuple[Array, Array]:
        """Part vectors (k, d) into parameters (k, d_h) and groups' values (k, g, q)."""
        d_h = len(self.priors.free)
        return t[:, :d_h], t[:, d_h:].reshape(len(t), len(self.groups), len(self.pooled))

    def about(self, h: Array, theta: Array) -> JointProblem:
        """Return the problem in coordinates about parameters (d_h,) and groups' values (g, q)."""
        centres = {
            key: _linear(part, h, theta, len(self.pooled))
            for key, part in self.parts.items()
            if part.own
        }
        return replace(self, centres=centres, origin=h)


def _linear(part: Part, h: Array, theta: Array, q: int) -> _Centre:
    """Make a part's residuals linear, in noise sds, by central differences."""
    problem = part.problem
    t = part.coordinates(h[None], theta[None])[0]
    steps = 1e-4 * prior_widths(problem.priors)
    natural = problem.theta(
        t + np.concatenate([np.zeros((1, t.size)), *(np.diag(s * steps) for s in (1, -1))])
    )
    scale = problem.scale(natural[:1])
    residuals = np.nan_to_num(problem.residuals(natural) / scale)
    ahead, behind = residuals[1:].reshape(2, t.size, -1)
    jacobian = (behind - ahead).T / (2.0 * steps)  # of the prediction, (n, d)
    places, pooled = np.array(part.own).T
    of_theta, of_h = np.zeros((len(jacobian), q)), np.zeros((len(jacobian), h.size))
    of_theta[:, pooled] = jacobian[:, places]
    rest = np.setdiff1d(np.arange(t.size), places)
    of_h[:, part.columns[rest]] = jacobian[:, rest]
    precision = of_theta.T @ of_theta
    pull = precision @ theta[part.group] + of_theta.T @ residuals[0]
    sigma = problem.priors.free[-1]
    place = int(part.columns[-1]) if sigma.name == "sigma" and sigma.log else -1
    return _Centre(precision, pull, of_theta.T @ of_h, place)


@takes(models=Mapping, pooled=Sequence, group=str, priors=Mapping)
def build_joint(
    models: Mapping[str, Tabular],
    *,
    group: str = "",
    pooled: Sequence[str] = (),
    priors: Mapping[str, PriorFile | str] | None = None,
) -> JointProblem:
    """Bind models to data that have parameters in common, and read their priors.

    Parameters
    ----------
    models : mapping of str to Table, mapping or pandas.DataFrame
        Models by name, each with its data, which may be the same for several. Rows without a
        model's output are not used for it. Where several models predict one quantity, such as the
        sinkage of a wheel and of a plate, their outputs have the names of the models.
    group : str, optional
        A column of the data: rows of one value are of one group.
    pooled : sequence of str, optional
        Parameters that differ between groups, by partial pooling; at least one if there are groups.
    priors : mapping of str to path, optional
        A prior file for a model, instead of the shipped one.

    Raises
    ------
    CalibError
        As of `calib.build_problem`; if two models predict the same readings, a parameter that
        outputs share has two priors, a column or parameter is not there, or there are fewer than
        three groups.

    Examples
    --------
    >>> import calib
    >>> from calib.inference.joint import build_joint
    >>> ruts = calib.load_he2019("rut_depth")
    >>> joint = build_joint({"modified_bekker": ruts}, group="slip_ratio", pooled=["z_ref"])
    >>> joint.names[:4]
    ('z_ref', 'n0', 'n1', 'sigma')
    """
    files, labels = dict(priors or {}), {}
    wholes: dict[str, Problem] = {}
    tables = {name: _measured(get_model(name).output, data) for name, data in models.items()}
    readings = sum(map(len, tables.values()))
    columns_of = [get_model(name).output for name in tables]
    for name, table in tables.items():
        column, others = get_model(name).output, readings - len(table)
        # The sinkage of a wheel and that of a plate are two outputs.
        output = output_of(column) if columns_of.count(column) == 1 else name
        if any(
            w.bound.model.output == column and np.array_equal(w.observed, table[column])
            for w in wholes.values()
        ):
            raise CalibError(
                f"two models predict the same readings of {output_of(column)}",
                where="build_joint", expected="readings of its own for each model",
                hint="compare them (`calib.compare`)",
            )  # fmt: skip
        whole = build_problem(name, table, files.get(name), others=others)
        # What outputs read at one row have in common, its conditions' errors, would count twice.
        if whole.noise.errors:
            whole.noise.must_be_iid_normal(whole.priors.source, "a joint fit")
        wholes[output] = whole
        if group:
            labels[output] = group_labels(table, group)
    if bool(group) != bool(pooled):
        raise CalibError(
            "groups and pooled parameters belong together", where="build_joint",
            expected="both group and pooled, or neither",
            hint="name the column of the groups, and the parameters that differ between them",
        )  # fmt: skip
    entries, columns, shared = _merged(wholes)
    names = [p.name for p in entries]
    if missing := [p for p in pooled if p not in names or p.startswith(_OF_NOISE)]:
        raise CalibError(
            f"no parameter that can differ between groups: {', '.join(missing)}",
            where="build_joint, pooled",
            expected=", ".join(n for n in names if not n.startswith(_OF_NOISE)),
            hint="name some of these",
        )
    groups = tuple(sorted({g for own in labels.values() for g in own}))
    if group and len(groups) < 3:
        raise CalibError(
            f"the column {group!r} has {len(groups)} different values",
            where="build_joint, group", expected="at least three groups",
            hint="of one or two groups no spread can be estimated: fit each by itself",
        )  # fmt: skip
    entries += [_between(p) for p in entries if p.name in pooled]
    parts = {}
    for output, whole in wholes.items():
        own = tuple(
            (names_at, [*pooled].index(names[c]))
            for names_at, c in enumerate(columns[output])
            if names[c] in pooled
        )
        for g in groups or ("",):
            rows = np.flatnonzero(labels[output] == g) if groups else np.arange(len(whole.table))
            if rows.size:
                problem = whole.with_table(whole.table.take(rows)) if groups else whole
                place = groups.index(g) if groups else -1
                parts[output, g] = Part(problem, np.array(columns[output]), place, own)
    return JointProblem(
        Priors(tuple(entries)), parts, wholes, group, labels, tuple(pooled), groups, shared
    )


def _measured(column: str, data: Tabular) -> Table:
    """Return the rows that have an output."""
    table = as_table(data, allow_missing=tuple(OUTPUTS.values()))
    table.must_have(column)
    return table.take(np.flatnonzero(np.isfinite(table[column])))


def group_labels(table: Table, group: str) -> NDArray[np.str_]:
    """Return the group of every row, as text; a CalibError if there is no such column."""
    if group in table.extra:
        return np.array([cell.strip() for cell in table.extra[group]])
    if group in table.header and len(table.text) == len(table):
        return np.array([row[table.header.index(group)].strip() for row in table.text])
    if group in table:
        return np.array([plain_number(v, 12) for v in table[group]])
    raise CalibError(
        f"there is no column {group!r}", where=table.source,
        expected=", ".join(table.header), hint="name the column whose values tell the groups",
    )  # fmt: skip


def _merged(
    wholes: dict[str, Problem],
) -> tuple[list[Prior], dict[str, list[int]], dict[str, tuple[str, ...]]]:
    """Merge the free parameters of all outputs: entries, places by output, which are shared.

    What is shared refers to the same reference conditions: those of the first output.
    """
    entries: list[Prior] = []
    known: dict[tuple[str, str, str], int] = {}
    of: dict[int, list[str]] = {}
    columns: dict[str, list[int]] = {}
    for output, whole in wholes.items():
        model, columns[output] = whole.bound.model, []
        taken = {p.name for p in entries}
        for prior in whole.priors.free:
            noise = prior.name in _OF_NOISE
            key = (prior.name, prior.unit, output if noise else model.meanings.get(prior.name, ""))
            if key in known:
                first = entries[known[key]]
                if replace(first, name=prior.name, reason="", source="", text="") != replace(
                    prior, reason="", source="", text=""
                ):
                    raise CalibError(
                        f"{prior.name} is one parameter and has two priors: {first.text}, and "
                        f"{prior.text} for {output}", where=f"{whole.priors.source}, {prior.name}",
                        expected="the same prior for all outputs that share it",
                        hint="give the models prior files that agree",
                    )  # fmt: skip
            else:
                known[key] = len(entries)
                alone = len(wholes) == 1 or (prior.name not in taken and not noise)
                name = prior.name if alone else f"{prior.name}_{output}"
                entries.append(replace(prior, name=name))
            columns[output].append(known[key])
            of.setdefault(known[key], []).append(output)
    shared = {entries[i].name: tuple(outputs) for i, outputs in of.items() if len(outputs) > 1}
    references = next(iter(wholes.values())).bound.references
    for output, whole in wholes.items():
        if shared and set(references) == set(whole.bound.references):
            wholes[output] = replace(whole, bound=BoundModel(whole.bound.model, references))
    return entries, columns, shared


def _between(p: Prior) -> Prior:
    """Return the prior of the sd between groups: above the sd of the prior with 5 %."""
    sd = p.scale if np.isfinite(p.scale) else (p.upper - p.lower) / np.sqrt(12.0)
    rate = -float(np.log(0.05)) / sd
    return Prior(
        f"tau_{p.name}", "1" if p.log else p.unit,
        f"Between groups {p.name} varies by no more than its prior does, with 95 %",
        "Simpson et al. (2017), doi:10.1214/16-STS576", f"exponential({rate:.3g})", True,
        float(digamma(1.0)) - float(np.log(rate)), float(np.sqrt(polygamma(1, 1.0))),
        gamma=(1.0, rate),
    )  # fmt: skip


@dataclass(frozen=True, repr=False)
class JointCalibration:
    """The posterior of a joint problem; a mapping of outputs to calibrations is `outputs`.

    Parameters
    ----------
    problem : JointProblem
    draws : Draws
        In the coordinates of the problem's priors, then groups' values.
    seed : int
    settings : SamplerSettings
    """

    problem: JointProblem
    draws: Draws
    seed: int
    settings: SamplerSettings

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT CONVERGED"
        return f"<JointCalibration of {', '.join(self.problem.outputs)}, {state}>"

    @property
    def converged(self) -> bool:
        """Whether the convergence criteria are met."""
        return self.draws.report.passed

    @cached_property
    def _split(self) -> tuple[Array, Array]:
        return self.problem.parted(self.draws.flat)

    @cached_property
    def parameters(self) -> Mapping[str, Array]:
        """Draws of all parameters in natural values, shape (chains, draws) each."""
        priors, shape = self.problem.priors, self.draws.t.shape
        natural = priors.to_natural(self._split[0])
        found = {p.name: natural[:, i] for i, p in enumerate(priors.entries)}
        log = {p.name: p.log for p in priors.free}
        for j, p in enumerate(self.problem.pooled):
            own = self._split[1][:, :, j]
            own = np.exp(own) if log[p] else own
            found |= {f"{p}[{g}]": own[:, i] for i, g in enumerate(self.problem.groups)}
        return {n: v.reshape(shape[0] * shape[1], shape[2]) for n, v in found.items()}

    @cached_property
    def summary(self) -> Mapping[str, ParameterSummary]:
        """Summaries of all parameters by name, sds between groups and groups' values among them."""
        units = {p.name: p.unit for p in self.problem.priors.free}
        units |= {f"{p}[{g}]": units[p] for p in self.problem.pooled for g in self.problem.groups}
        ratios = sd_ratios(self.problem.priors, self._split[0])
        return summarise(self.parameters, units, self.draws.t.shape[:3], ratios)

    def calibration(self, output: str, group: str | None = None) -> Calibration:
        """Return what the posterior says of one output, to predict, plot and validate with.

        Parameters
        ----------
        output : str
        group : str, optional
            A group of the data. Without it, where there are groups, a *new* one, whose parameters
            are drawn from the distribution between groups.

        Raises
        ------
        CalibError
            If there is no such output or group.
        """
        keys = [key for key in self.problem.parts if key[0] == output]
        if not keys or (group is not None and (output, group) not in keys):
            raise CalibError(
                f"there is no {output}{f' of group {group!r}' if group else ''}",
                where="JointCalibration.calibration",
                expected=", ".join(
                    " of group ".join(k) if k[1] else k[0] for k in self.problem.parts
                ),
                hint="name one of these",
            )
        h, theta = self._split
        part = self.problem.parts[keys[0] if group is None else (output, group)]
        label, new = f"{output} {group or ''}".strip(), ""
        if group is None and self.problem.groups:
            theta = self._new(h)[:, None]
            part = replace(part, problem=self.problem.wholes[output], group=0)
            label, new = f"{output} of a new group", f", {NEW_GROUP}"
        t = part.coordinates(h, theta).reshape(*self.draws.t.shape[:3], -1)
        report = judge(
            t, part.problem.names, self.settings.gate,
            tau=np.full(t.shape[-1], self.draws.report.tau.max()), steps=self.draws.report.steps,
        )  # fmt: skip
        if not self.converged:
            report = replace(report, passed=False, reasons=self.draws.report.reasons)
        flat = t.reshape(-1, t.shape[-1])
        # Of its own rows under its own priors, as those of a run by itself.
        own = part.problem.log_prob(flat).reshape(t.shape[:-1])
        middle = flat[int(np.argmax(self.draws.log_prob))]
        draws = replace(
            self.draws, t=t, log_prob=own, report=report, mode=middle, log_evidence=np.nan
        )
        joint = f"{', '.join(self.problem.outputs)}"
        if self.problem.groups:
            joint += f" in {len(self.problem.groups)} groups"
        return Calibration(part.problem, draws, self.seed, label, (), self.settings, joint + new)

    @property
    def outputs(self) -> Mapping[str, Calibration]:
        """A calibration of each output by name; of a new group, where there are groups."""
        return {output: self.calibration(output) for output in self.problem.outputs}

    def _new(self, h: Array) -> Array:
        """Draw the values of a new group, within bounds, (k, q)."""
        mean, tau = (h[:, places] for places in self.problem._places)
        sd, (low, high) = np.exp(tau), self.problem._bounds
        u = generator(self.seed, "new group").uniform(size=mean.shape)
        a, b = ndtr((low - mean) / sd), ndtr((high - mean) / sd)
        return np.asarray(mean + sd * ndtri(a + u * (b - a)))


@takes(problem=JointProblem, seed=Integral, settings=SamplerSettings)
def calibrate_joint(
    problem: JointProblem,
    seed: int,
    *,
    settings: SamplerSettings | None = None,
    progress: Progress | None = None,
) -> JointCalibration:
    """Sample the posterior of a joint problem.

    Parameters
    ----------
    seed : int
        Same seed, same numbers.
    settings : SamplerSettings, optional
    progress : callable, optional
        Called with steps done and steps planned.

    Returns
    -------
    JointCalibration
        Read ``converged`` before use.

    Raises
    ------
    CalibError
        If no parameters of positive probability can be found.

    Examples
    --------
    >>> import calib
    >>> from calib.inference.joint import build_joint, calibrate_joint
    >>> joint = build_joint({"bekker": calib.load_he2019("rut_depth")})
    >>> calibrate_joint(joint, seed=1).converged
    True
    """
    if problem.groups:
        problem = _centred(problem, generator(seed, "joint", "centre"))
    chosen = settings or SamplerSettings()
    sources = dict.fromkeys(part.problem.table.source for part in problem.parts.values())
    priors = problem.priors
    for part in problem.parts.values():
        model, conditions = part.problem.bound.model, part.problem.conditions
        if not isinstance(priors, SumAndRatio):
            priors = sum_and_ratio(priors, model.joined, conditions)
    draws = sample_joint(
        problem.log_prob, priors, stream(seed, "joint", "sample"), problem.names, chosen,
        where=", ".join(sources), progress=progress,
        dear=any(bool(m.slow or m.uncertain) for m in problem.models),
    )  # fmt: skip
    if problem.groups:

        def by_group(t: Array) -> Array:
            h, theta, _ = problem.split(t.reshape(-1, t.shape[-1]))
            return np.column_stack([h, theta.reshape(len(h), -1)]).reshape(t.shape)

        draws = in_coordinates(draws, by_group, problem.names, chosen.gate)
        value = problem.log_posterior(*problem.parted(draws.flat))
        draws = replace(draws, log_prob=value.reshape(draws.t.shape[:-1]))
    return JointCalibration(problem, draws, seed, chosen)


def _centred(problem: JointProblem, rng: np.random.Generator) -> JointProblem:
    """Return the problem in coordinates about estimates of each group by itself."""
    priors, (mean, tau) = problem.priors, problem._places

    def together(h: Array) -> Array:
        """Density of parameters (k, d_h) that are the same in all groups."""
        value, theta = priors.log_prob(h), np.repeat(h[:, None, mean], len(problem.groups), axis=1)
        with np.errstate(all="ignore"):
            for part in problem.parts.values():
                value = value + part.problem.log_likelihood(part.coordinates(h, theta))
        return np.where(np.isnan(value), -np.inf, value)

    h = find_modes(together, priors, rng)[0].t
    scale = prior_widths(priors)[mean]
    theta = np.repeat(h[None, mean], len(problem.groups), axis=0)
    for g in range(len(problem.groups)):
        own = [p for p in problem.parts.values() if p.group == g]

        def alone(x: Array, g: int = g, own: Sequence[Part] = tuple(own)) -> Array:
            """Density of one group's values (k, q), the other parameters held."""
            full = np.repeat(theta[None], len(x), axis=0)
            full[:, g] = x
            value = -0.5 * np.square((x - h[mean]) / scale).sum(axis=1)
            with np.errstate(all="ignore"):
                for part in own:
                    value = value + part.problem.log_likelihood(
                        part.coordinates(np.repeat(h[None], len(x), axis=0), full)
                    )
            return np.where(np.isnan(value), -np.inf, value)

        theta[g] = climb(alone, theta[g][None], scale, *problem._bounds)[0][0]
    h = h.copy()
    h[mean] = theta.mean(axis=0)
    h[tau] = np.log(np.maximum(theta.std(axis=0, ddof=1), 0.05 * scale))
    return problem.about(h, theta)
