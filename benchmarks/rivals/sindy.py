"""Sparse regression of what the calibrated simulator leaves of the field: SINDy on a discrepancy.

The residual, in noise sds of the laboratory, is regressed on a library (Kaheman et al. 2019) by
`pysindy.STLSQ` (Brunton et al. 2016) with its defaults but for the threshold, which is chosen by
AICc of a grid, as Mangan et al. (2017) do; probabilities are Akaike weights of the sets of terms on
the way. Columns have an rms of one over the field.

sindy: polynomials of degree two of the conditions that vary in the field, each output by itself; it
names terms and no cause. sindy_effects: what each effect of the diagnosis's list adds at its
prior's size, and derivatives by the simulator's parameters for a shift of these, outputs together.

Doi 10.1073/pnas.1517384113, 10.1098/rspa.2017.0009, 10.48550/arXiv.1909.08574.
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.special import softmax

from rivals.akaike import acting_alone
from rivals.common import Answer, Array, Curve, Lab, Prepared

_THRESHOLDS = np.geomspace(0.02, 20.0, 40)  # noise sds


def aicc(left: Array, k: int) -> float:
    """AICc of residuals (n,) of a fit with k parameters, the noise among them."""
    n = left.size
    return float(n * np.log(max(left @ left / n, 1e-12)) + 2 * k * n / (n - k - 1))


class Regression:
    """Sparse regression of y (n,) on columns (n, m): weights of sets of columns, the best one."""

    def __init__(self, library: Array, y: Array) -> None:
        from pysindy import STLSQ

        n, m = library.shape
        self.size = np.sqrt(np.square(library).mean(axis=0))
        kept = self.size > 1e-6
        self.size = np.where(kept, self.size, 1.0)
        columns = np.where(kept, library / self.size, 0.0)
        found = {(): (aicc(y, 1), np.zeros(m))}
        for threshold in _THRESHOLDS:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of columns that are nearly the same, of none left
                b = np.asarray(STLSQ(threshold=threshold).fit(columns, y[:, None]).coef_)[0]
            terms = tuple(np.flatnonzero(b).tolist())
            if len(terms) < n - 2:
                found.setdefault(terms, (aicc(y - columns @ b, len(terms) + 1), b))
        weights = softmax([-0.5 * value for value, _ in found.values()])
        self.weights: dict[tuple[int, ...], float] = dict(zip(found, weights.tolist(), strict=True))
        self.chosen = max(self.weights, key=lambda terms: self.weights[terms])
        self.coefficients, some = found[self.chosen][1], columns[:, list(self.chosen)]
        left = y - columns @ self.coefficients
        self.sd = float(np.sqrt(left @ left / (n - len(self.chosen) - 1)))
        self.inverse = np.linalg.pinv(some.T @ some, hermitian=True)

    def at(self, library: Array) -> tuple[Array, Array]:
        """Predict with sd at other rows (k, m), shapes (k,)."""
        columns = library / self.size
        some = columns[:, list(self.chosen)]
        variance = np.einsum("ij,jk,ik->i", some, self.inverse, some)
        return columns @ self.coefficients, self.sd * np.sqrt(np.maximum(variance, 0.0))

    def curve(self, p: Prepared, lab: Lab, field: Array, target: Array) -> Curve:
        """Turn it into a gap at an output's field rows and predictions; in noise sds till here."""
        (gap, gap_sd), (change, after_sd) = (self.at(library) for library in (field, target))
        after = lab.predict(lab.mode[None], p.target)[0] + lab.sd * change
        return Curve(lab.sd * gap, lab.sd * gap_sd, after, lab.sd * after_sd, lab.sd * self.sd)


def _left(p: Prepared, lab: Lab) -> Array:
    """What is left of an output's field rows, in noise sds."""
    return (lab.output.field - lab.predict(lab.mode[None], p.field)[0][lab.output.rows]) / lab.sd


def by_polynomials(p: Prepared) -> Answer:
    """Diagnose a case with polynomials of its conditions."""
    from pysindy import PolynomialLibrary

    curves, none, said = {}, 1.0, {}
    x, at = (2.0 * p.scaled(conditions) - 1.0 for conditions in (p.field, p.target))
    library = PolynomialLibrary(degree=2, include_bias=True).fit(x)
    field, target = (np.asarray(library.transform(v)) for v in (x, at))
    names = library.get_feature_names([*p.inputs] or ["nothing"])
    for lab in p.labs:
        found = Regression(field[lab.output.rows], _left(p, lab))
        none *= found.weights[()]
        curves[lab.name] = found.curve(p, lab, field[lab.output.rows], target)
        said[lab.name] = [names[i] for i in found.chosen]
    return Answer({"none": none, "unknown": 1.0 - none}, curves, {"terms": said})


def by_effects(p: Prepared) -> Answer:
    """Diagnose a case with what the listed effects add."""
    names: list[str] = []
    views = p.data.view, p.data.at_conditions(p.target)
    field, target = ({lab.name: list[Array]() for lab in p.labs} for _ in views)
    for forward, psi in acting_alone(p):
        names.append(forward.hypothesis.name)
        for view, part in ((views[0], field), (views[1], target)):
            full, plain = forward.field_and_plain(psi[None], view)
            for lab in p.labs:
                part[lab.name].append(np.nan_to_num(full[lab.name] - plain[lab.name])[0] / lab.sd)
    for shifted in p.labs:
        names += ["parameter_shift"] * shifted.mode.size
        for view, part in ((views[0], field), (views[1], target)):
            j = shifted.jacobian(shifted.mode, view.conditions) * shifted.scales / shifted.sd
            for lab in p.labs:
                part[lab.name] += [*(j.T if lab is shifted else 0.0 * j.T)]
    columns = {lab.name: np.stack(field[lab.name], axis=1)[lab.output.rows] for lab in p.labs}
    every = np.concatenate([*columns.values()])
    found = Regression(every, np.concatenate([_left(p, lab) for lab in p.labs]))
    probability: dict[str, float] = {}
    for terms, weight in found.weights.items():
        causes = "+".join(sorted({names[i] for i in terms})) or "none"
        probability[causes] = probability.get(causes, 0.0) + weight
    curves = {
        lab.name: found.curve(p, lab, columns[lab.name], np.stack(target[lab.name], axis=1))
        for lab in p.labs
    }
    return Answer(probability, curves)
