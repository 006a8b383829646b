"""The corrected model: by how much it reduces the error, and its predictions at new conditions.

It is the mixture of hypotheses, each a normal about its mode, with the two campaigns it was fitted
to. A correction is only as good as the diagnosis: its bands hold the doubt about the cause too.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from calib.data import Table, write_table
from calib.data.checks import check_conditions
from calib.data.quantities import OUTPUTS, QUANTITIES, role_of
from calib.errors import CalibError, meant
from calib.gap.campaigns import Campaigns, campaigns
from calib.gap.case import Context, cells, read_case, with_declared
from calib.gap.constants import NAMED, SMALLEST_GAP, SURPRISE, WORTH_SAYING
from calib.gap.discrepancy import ShiftMap
from calib.gap.effects import EFFECTS, Effect
from calib.gap.fit import Fit
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, effect_priors, with_case_effects
from calib.gap.mixture import Mixture, Truth
from calib.gap.noise import Noise
from calib.inference.prior_files import whole_text
from calib.inference.priors import Priors
from calib.models.base import Array
from calib.shown import Shown
from calib.validation.prediction import echoed, outside
from calib.validation.questions import Drawn, Sample, Weights

SCHEMA = "calib/corrected/7"


class Corrected:
    """A mixture of hypotheses and the simulator as the lab calibrated it.

    Parameters
    ----------
    lab_mode : mapping of str to ndarray
        Internal parameters of each simulator.
    """

    def __init__(self, mixture: Mixture, lab_mode: Mapping[str, Array]) -> None:
        self.mixture = mixture
        self.lab_mode = lab_mode

    @property
    def data(self) -> Campaigns:
        """The campaigns it was fitted to."""
        return self.mixture.data

    @property
    def faults(self) -> list[str]:
        """Effects of instruments that are part of what is predicted, as probably as not or more."""
        probability: dict[str, float] = {}
        for fit, p in zip(self.mixture.fits, self.mixture.probability, strict=True):
            for effect in fit.forward.hypothesis.effects:
                if effect.instrument:
                    probability[effect.name] = probability.get(effect.name, 0.0) + p
        return [name for name, p in probability.items() if p >= NAMED]

    @property
    def over_runs(self) -> bool:
        """Whether what is predicted depends on the order of the runs, worth a word."""
        probability = 0.0
        for fit, p in zip(self.mixture.fits, self.mixture.probability, strict=True):
            h = fit.forward.hypothesis
            over = {c for effect in h.effects for c in effect.covariates}
            probability += p * bool({"order"} & {*over, h.smooth_over, h.onset_over})
        return probability >= WORTH_SAYING

    @property
    def causes(self) -> tuple[str, ...]:
        """What acts in any of the hypotheses."""
        return tuple(dict.fromkeys(c for fit in self.mixture.fits for c in fit.forward.causes))

    def calibrated(self, conditions: Mapping[str, Array]) -> dict[str, Array]:
        """Predict with the simulator alone, in the outputs' units, shapes (n,)."""
        predicted = {}
        for o in self.data.outputs:
            theta = o.priors.to_natural(self.lab_mode[o.name][None])
            selected = o.problem.bound.model.select(conditions)
            predicted[o.name] = np.asarray(o.problem.bound.predict(theta, selected)[0])
        return predicted


def save_corrected(corrected: Corrected, folder: Path) -> None:
    """Write ``corrected.json`` and the campaigns into an existing folder."""
    case = corrected.data.case
    inner = folder / "case"
    inner.mkdir()
    tables = {"lab": case.lab, "field": case.field, "fresh": case.new_conditions}
    lines = []
    for key, (name, table) in zip(("calibration", "field", "predict"), tables.items(), strict=True):
        if table is not None:
            columns = table.as_in_file(cells(table.columns, case.covariates))
            sds = {error.sd for _, error in corrected.data.errors}
            columns |= {name: cells for name, cells in table.extra.items() if name in sds}
            if name == "fresh" and table.text:  # its predictions repeat it as it was written
                columns |= dict(zip(table.header, zip(*table.text, strict=True), strict=True))
            write_table(inner / f"{name}.csv", columns)
            lines.append(f'{key} = "{name}.csv"')
    lines += ["", "[models]", *(f'{output} = "{model}"' for output, model in case.models.items())]
    lines += ["", "[priors]"] if case.priors else []
    for output, priors in case.priors.items():
        text = whole_text(priors, case.models[output])
        (inner / f"{output}_priors.toml").write_text(text, encoding="utf-8")
        lines.append(f'{output} = "{output}_priors.toml"')
    lines += ["", "[covariates]"] if case.covariates else []
    for name, levels in case.covariates.items():
        lines.append(f"{json.dumps(name)} = {json.dumps(list(levels) or 'number')}")
    lines += _context_lines(case.context) if case.context else []
    (inner / "case.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    content = {
        "schema": SCHEMA,
        "seed": corrected.mixture.seed,
        "lab_mode": {name: t.tolist() for name, t in corrected.lab_mode.items()},
        "fits": [
            _fit_document(fit, probability)
            for fit, probability in zip(
                corrected.mixture.fits, corrected.mixture.probability, strict=True
            )
        ],
    }
    (folder / "corrected.json").write_text(json.dumps(content) + "\n", encoding="utf-8")


def _context_lines(context: Context) -> list[str]:
    soil = [] if context.same_soil is None else [f"same_soil = {json.dumps(context.same_soil)}"]
    lines = ["", "[context]", *soil, f"excluded = {json.dumps(list(context.excluded))}"]
    lines += ["[context.suspected]", *(f"{name} = {p!r}" for name, p in context.suspected.items())]
    for name, sizes in context.sizes.items():
        lines.append(f"[context.sizes.{name}]")
        lines += [f"{p} = {{mean = {s.mean!r}, sd = {s.sd!r}}}" for p, s in sizes.items()]
    return lines


def _fit_document(fit: Fit, probability: float) -> dict[str, Any]:
    h = fit.forward.hypothesis
    return {
        "name": h.name,
        "effects": [e.name for e in h.effects],
        "shift": h.shift,
        "shift_as": h.shift_as,
        "shift_over": h.shift_over,
        "shift_map": _shift_document(fit.forward.shift),
        "smooth": h.smooth,
        "smooth_outputs": list(h.smooth_outputs),
        "smooth_over": h.smooth_over,
        "smooth_decay": h.smooth_decay,
        "onset_over": h.onset_over,
        "probability": probability,
        "sample": _short(fit.sample),
        "field": {o: _short([values])[0] for o, values in _field(fit).items()},
        "noise": {o: asdict(n) for o, n in fit.noise.items()},
    }


def _field(fit: Fit) -> dict[str, Array]:
    """Predict the field rows at the mode, on the scale of the response."""
    return {
        o: values[0]
        for o, values in fit.forward.field(fit.psi[None], fit.forward.data.view).items()
    }


def _shift_document(shift: ShiftMap | None) -> dict[str, Any] | None:
    if shift is None:
        return None
    parameters = {o: matrix.tolist() for o, matrix in shift.parameters.items()}
    return {"parameters": parameters, "radius_error": shift.radius_error.tolist()}


def _load_shift(document: dict[str, Any] | None) -> ShiftMap | None:
    if document is None:
        return None
    parameters = {o: np.array(matrix) for o, matrix in document["parameters"].items()}
    return ShiftMap(parameters, np.array(document["radius_error"]))


def _short(draws: Iterable[Array]) -> list[list[float]]:
    """Twelve digits of each number, so that the file stays small."""
    return [[float(f"{value:.12g}") for value in row] for row in draws]


def load_corrected(folder: Path, effects: Mapping[str, Effect] = EFFECTS) -> Corrected:
    """Load the corrected model of a diagnosis.

    Parameters
    ----------
    folder : Path
        Written by `calib diagnose`.
    effects : mapping of str to Effect, optional
        Must hold the effects that were considered.

    Raises
    ------
    CalibError
        If the folder has no corrected model, it is damaged, or it predicts otherwise than when it
        was saved, as with other effects or priors.
    """
    path = Path(folder) / "corrected.json"
    try:
        content = json.loads(path.read_bytes())
        if content["schema"] != SCHEMA:
            raise ValueError
        data = campaigns(read_case(Path(folder) / "case"))
        lab_mode = {name: np.array(t) for name, t in content["lab_mode"].items()}
        known = with_case_effects(data, effects)
        priors = cache(lambda name: effect_priors(data, known[name]))
        fits = tuple(_load_fit(data, f, known, priors, lab_mode) for f in content["fits"])
        probability = tuple(float(f["probability"]) for f in content["fits"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CalibError(
            f"there is no readable corrected model ({type(error).__name__})",
            where=str(path),
            expected="a folder written by `calib diagnose`",
            hint="run the diagnosis again",
        ) from None
    return Corrected(Mixture(data, fits, probability, int(content["seed"])), lab_mode)


def _load_fit(
    data: Campaigns,
    document: dict[str, Any],
    effects: Mapping[str, Effect],
    priors: Callable[[str], Priors],
    lab_mode: Mapping[str, Array],
) -> Fit:
    unknown = [name for name in document["effects"] if name not in effects]
    if unknown:
        raise CalibError(
            f"the corrected model uses the effect {', '.join(unknown)}, which is not known here",
            expected=", ".join(effects),
            hint="pass the Python file that defines it as the diagnosis was given it: "
            "--models FILE if it registers the effect, else --effects FILE",
        )
    hypothesis = Hypothesis(
        document["name"],
        tuple(effects[name] for name in document["effects"]),
        tuple(map(priors, document["effects"])),
        document["shift"],
        document["shift_as"],
        document["smooth"],
        tuple(document["smooth_outputs"]),
        document["smooth_over"],
        document["smooth_decay"],
        document["onset_over"],
        shift_over=document["shift_over"],
    )
    noise = {o: Noise(**n) for o, n in document["noise"].items()}
    # What the coordinates of a shift mean is the file's, whatever the priors shipped now say.
    shift = _load_shift(document["shift_map"])
    sigma = {o: n.sigma for o, n in noise.items()}
    forward = Forward(data, hypothesis, sigma, lab_mode, shift)
    sample = np.array(document["sample"])
    if sample.shape[1:] != (forward.n_dim,):
        raise ValueError("shape")
    fit = Fit(forward, noise, 0.0, {}, sample)
    for o, values in _field(fit).items():
        said = np.array(document["field"][o])
        if not np.allclose(values, said, rtol=0.0, atol=1e-4 * sigma[o], equal_nan=True):
            raise CalibError(
                f"the hypothesis {document['name']} no longer predicts the {o} that it was saved "
                "with: its effects, their priors or a model have changed since",
                expected="the code, priors and effects of the diagnosis",
                hint="run the diagnosis again, or pass the file of effects as it was then",
            )
    return fit


def covered(corrected: Corrected, table: Table) -> dict[str, Array]:
    """Return what the campaigns covered of a table's conditions, by canonical column.

    Of the order of the runs it is what the field covered, if anything depends on it.

    Parameters
    ----------
    table : Table
        New conditions.
    """
    case = corrected.data.case
    return {
        name: np.concatenate(
            [
                t[name]
                for t in (case.lab, case.field)
                # A drift of the field's instrument has nothing to do with the laboratory's runs.
                if name in t and (t is case.field or role_of(name) != "order")
            ]
        )
        for name in corrected.data.view.conditions
        if name not in OUTPUTS.values()
        and name in table
        and not case.covariates.get(name)
        and (corrected.over_runs or role_of(name) != "order")
    }


def all_conditions(corrected: Corrected, table: Table) -> tuple[Table, dict[str, Array]]:
    """Return new conditions with the declared columns, and their values, the order's too.

    Raises
    ------
    CalibError
        If a condition is missing.
    """
    table = with_declared(table, corrected.data.case.covariates)
    needed = corrected.data.view.conditions
    order = corrected.data.view.column("order")
    missing = [n for n in needed if n not in table and n not in (*OUTPUTS.values(), order)]
    if missing:
        raise CalibError(
            f"the corrected model needs {', '.join(missing)}",
            where=table.source,
            expected="the conditions and covariates of the field campaign",
            hint="add the columns",
        )
    conditions = dict(table.columns)
    if order is not None and order not in conditions:
        # A drift is taken as it stood at the end of the campaign.
        conditions[order] = np.full(len(table), corrected.data.view.order_range[1])
    return table, conditions


def predict_columns(
    corrected: Corrected, table: Table, left_out: Collection[str] = ()
) -> dict[str, Array | list[str]]:
    """Lay out a prediction at new conditions: columns as given, before, after, 90 % band, flags.

    Parameters
    ----------
    table : Table
        With the conditions of all models and the covariates of the effects.
    left_out : collection of str, optional
        Causes that no longer act, as of an instrument that was mended; hypotheses without them
        predict as before.

    Raises
    ------
    CalibError
        If a condition is missing, or a cause is none of the corrected model.
    """
    table, conditions, truth = _truth(corrected, table, left_out)
    columns = echoed(table, *OUTPUTS.values())
    for name, p in predict_new(truth, corrected.calibrated(conditions)).items():
        column = OUTPUTS[name]
        columns |= {
            f"{column}_before": p.before,
            f"{column}_after": p.after,
            f"{column}_after_lower": p.lower,
            f"{column}_after_upper": p.upper,
        }
    known = covered(corrected, table)
    flags = outside(known, {name: table[name] for name in known}) or [()] * len(table)
    return columns | {"outside_calibrated_range": ["+".join(row) for row in flags]}


def _truth(
    corrected: Corrected, table: Table, left_out: Collection[str]
) -> tuple[Table, dict[str, Array], Truth]:
    """Draw what happens at conditions; return a table with declared covariates, and them, too."""
    unknown = [cause for cause in left_out if cause not in corrected.causes]
    if unknown:
        raise CalibError(
            f"the corrected model has no cause {', '.join(unknown)} to leave out",
            expected=", ".join(corrected.causes) or "none: it has no cause",
            hint=meant(unknown[0], corrected.causes, "name one of these, or leave nothing out"),
        )
    table, conditions = all_conditions(corrected, table)
    at = corrected.data.at_conditions(conditions)
    return table, conditions, corrected.mixture.at(at, left_out=left_out)


@dataclass(frozen=True, repr=False)
class CorrectedPrediction(Shown):
    """A prediction of a diagnosis at new conditions.

    Parameters
    ----------
    conditions : mapping of str to ndarray, shape (n,)
        By canonical column.
    columns : mapping of str to ndarray or list of str
        As `predict_columns` lays them out.
    index : tuple, optional
        Labels of the rows in the data frame that was given.
    """

    conditions: Mapping[str, Array]
    columns: Mapping[str, Array | list[str]]
    index: tuple[object, ...] | None = None
    _made: tuple[Corrected, Table, Collection[str]] = field(kw_only=True)

    def draws(self, output: str) -> Drawn:
        """Return weighted draws of an output by its column: of what happens, and of a reading.

        They hold the doubt about the cause. Monte Carlo errors of what is asked of them are given
        the causes' probabilities. A CalibError names the outputs there are.
        """
        if f"{output}_after" not in self.columns:
            outputs = [n.removesuffix("_after") for n in self.columns if n.endswith("_after")]
            raise CalibError(
                f"the diagnosis has no output {output}", where="draws",
                expected=", ".join(outputs), hint="name one of these columns",
            )  # fmt: skip
        truth = _truth(*self._made)[2]
        nowhere = np.isnan(np.asarray(self.columns[f"{output}_after"], dtype=np.float64))
        # Draws that were picked several times are one.
        every = np.concatenate([*truth.truth.values()], axis=1)
        same = np.unique(every, axis=0, return_inverse=True)[1].ravel()
        effective = 1.0 / float(np.square(np.bincount(same, truth.weight)).sum())
        name = next(o for o in truth.truth if OUTPUTS[o] == output)
        mean, reading = (
            Sample(np.where(nowhere, np.nan, v), Weights(truth.weight, same, effective))
            for v in (truth.truth[name], truth.measured[name])
        )
        alone = not any(o.problem.noise.correlated_along for o in self._made[0].data.outputs)
        return Drawn(self.conditions, mean, reading, together=alone)

    def __repr__(self) -> str:
        """Name the outputs, and say how many rows are outside."""
        outputs = [n.removesuffix("_after") for n in self.columns if n.endswith("_after")]
        flags = self.columns["outside_calibrated_range"]
        return (
            f"<CorrectedPrediction of {', '.join(outputs)} at {len(flags)} rows, "
            f"{sum(map(bool, flags))} outside the calibrated range>"
        )


def check_units_of(corrected: Corrected, table: Table) -> None:
    """Refuse conditions to predict that look, as a whole, as if they were in another unit."""
    campaigns = corrected.data.case.lab, corrected.data.case.field
    # Effects depend on conditions that the model may lack.
    for name in sorted({*corrected.data.view.conditions} & {*table} & {*QUANTITIES}):
        known = [t[name] for t in campaigns if name in t]
        check_conditions(table, {name: np.concatenate(known)} if known else {})


def predict_corrected(
    corrected: Corrected, table: Table, left_out: Collection[str] = ()
) -> CorrectedPrediction:
    """Predict at new conditions; see `predict_columns`."""
    conditions = {n: v for n, v in table.columns.items() if n not in OUTPUTS.values()}
    made = corrected, table, tuple(left_out)
    return CorrectedPrediction(conditions, predict_columns(*made), _made=made)


@dataclass(frozen=True)
class Shrink:
    """Root-mean-square error of the noise-free prediction before and after the correction.

    The errors and the noise floor are posterior medians, the fraction is that of the errors. The
    interval is that of 90 % of the fraction's posterior with its lower end set farther off, by as
    much as nature surprises, and reaches at least to the fraction.
    """

    rmse_before: float
    rmse_after: float
    fraction: float
    interval: tuple[float, float]
    noise_floor: float


@dataclass(frozen=True)
class NewPrediction:
    """Predictions of one output at new conditions; the band is the 90 % predictive one."""

    before: Array
    after: Array
    lower: Array
    upper: Array


def predict_new(truth: Truth, before: Mapping[str, Array]) -> dict[str, NewPrediction]:
    """Predict with the calibrated simulator and with the corrected one."""
    found = {}
    for name, values in truth.truth.items():
        after = truth.mean(values)
        low, high = (truth.quantile(truth.measured[name], q) for q in (0.05, 0.95))
        # Where the simulator has no value, the correction of it is none either; nor is a mean that
        # a few extreme draws make.
        no_value = np.isnan(before[name] + after) | (after < low) | (after > high)
        of_it = (np.where(no_value, np.nan, part) for part in (after, low, high))
        found[name] = NewPrediction(before[name], *of_it)
    return found


def shrink(
    data: Campaigns, truth: Truth, before: Mapping[str, Array], after: Mapping[str, Array]
) -> dict[str, Shrink]:
    """Posterior of the shrink of every output that probably has a gap.

    Parameters
    ----------
    truth : Truth
        At conditions that were not fitted.
    before, after : mapping of str to ndarray, shape (n,)
        Predictions by the simulator as it was calibrated, and with the correction.
    """
    found = {o.name: _shrink_of(truth, before[o.name], after[o.name], o.name) for o in data.outputs}
    return {name: value for name, value in found.items() if value is not None}


def _shrink_of(truth: Truth, before: Array, after: Array, name: str) -> Shrink | None:
    values, simulator = truth.truth[name], truth.simulator[name]
    # Where the simulator has no value, far outside what it was fitted to, there is no error either.
    known = np.isfinite(before) & np.isfinite(values + simulator).all(axis=0)
    if not known.any():
        return None
    values, simulator, before, after = (a[..., known] for a in (values, simulator, before, after))
    floor = np.sqrt(np.square(truth.noise[name][:, known]).mean(axis=1))
    gap = np.sqrt(np.square(values - simulator).mean(axis=1))
    if float(truth.weight @ (gap > SMALLEST_GAP * floor)) < 0.5:
        return None
    before_error = np.sqrt(np.square(values - before).mean(axis=1))
    after_error = np.sqrt(np.square(values - after).mean(axis=1))
    fraction = 1.0 - after_error / np.maximum(before_error, 1e-12)

    def quantile(draws: Array, q: float) -> float:
        return float(truth.quantile(draws[:, None], q)[0])

    low, median, high = (quantile(fraction, q) for q in (0.05, 0.5, 0.95))
    left = max(1.0 - median, 1e-12)
    low = 1.0 - left * (max(1.0 - low, left) / left) ** SURPRISE
    errors = quantile(before_error, 0.5), quantile(after_error, 0.5)
    # The errors' own ratio, so that the three numbers agree where people read them together.
    stated = 1.0 - errors[1] / max(errors[0], 1e-12)
    interval = min(low, stated), max(high, stated)
    return Shrink(*errors, stated, interval, quantile(floor, 0.5))
