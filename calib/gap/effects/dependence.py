"""Dependence on a recorded condition that the simulator ignores.

Let u be the condition over its median in the laboratory: the logarithm of the ratio where factors
of it count (normal load, speed), else the difference over half the range of both campaigns. Then

    y' = y exp(c u + b u^2) + a u W  (pull, and whatever is compared as it is; W the normal load)
    ln z' = ln z + c u + b u^2       (sinkage, and whatever is compared by its logarithm)

with c, b of each output, and a of the pull. Forces on a wheel are nearly proportional to the load
(c = 1), by dimensional analysis at constant contact pressure; about that c is free.

As often the condition acts through the simulator's parameters as well, theta + delta u in the place
of theta with |u| <= 1 in the field (`Forward.along`): it changes the shape of the curve, not only
its scale. The prior of delta is that of a parameter shift, so that one other value of the condition
is told from a shift by what is known beforehand alone.

Of a category (operator, site) each value has a factor of its own, ln z' = ln z + d_j or
y' = y exp(d_j) + a_j W, with none for the one that is most frequent in the laboratory.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from calib.data.quantities import QUANTITIES, columns_of
from calib.gap.effects.base import Effect, Known, View, each
from calib.models.base import Array

PREFIX = "depends_on_"
_SOURCE = "Wismer & Luth (1973), Brixius (1987): traction over load depends on the load by its "
_SOURCE += "mobility number only; Bekker (1969): sinkage grows with pressure to the power 1/n"


class DependsOn(Effect):
    """The output depends on a recorded condition that its simulator ignores.

    Parameters
    ----------
    role : str
        Physical role of the condition.
    stem : str
        Its name without the unit.
    logs : mapping of str to bool
        Physical roles of the outputs whose simulators ignore it, and whether their logarithms are
        compared.
    half_range : float
        Of the condition over both campaigns, in its unit.
    """

    form = ("slip", "pressure", "shape")

    def __init__(self, role: str, stem: str, logs: Mapping[str, bool], half_range: float) -> None:
        self.role, self.logs, self.half_range = role, dict(logs), half_range
        self.name = f"{PREFIX}{stem}"
        self.title = f"the output depends on the {stem.replace('_', ' ')}, which its model ignores"
        self.outputs = tuple(logs)
        self.covariates = (role,)
        self.known = tuple(Known(output, zero_at=(role,)) for output in self.outputs)
        self.of_factors = any(QUANTITIES[c].of_factors for c in columns_of(role))
        self._additive = tuple(o for o, log in logs.items() if not log and o == "pull")
        self.parameters = (
            *(f"{output}_{kind}" for output in logs for kind in ("slope", "bend")),
            *(f"{output}_offset" for output in self._additive),
        )
        self.priors = self._priors()

    def _priors(self) -> str:
        lines = [f'model = "{self.name}"']
        for parameter in self.parameters:
            output, kind = parameter.rsplit("_", 1)
            mean, sd = 0.0, {"slope": 0.3, "bend": 0.15, "offset": 0.02}[kind]
            if kind == "slope" and self.of_factors:
                mean, sd = {
                    ("load", "pull"): (1.0, 0.3),
                    ("load", "sinkage"): (0.7, 0.5),
                }.get((self.role, output), (0.0, 0.5))
            lines.append(
                f"[parameters.{parameter}]\n"
                f'dist = "normal"\nmean = {mean}\nsd = {sd}\nunit = "1"\n'
                f'reason = "Change with the {self.role}, which the simulator ignores"\n'
                f'source = "{_SOURCE}"'
            )
        return "\n\n".join(lines) + "\n"

    def covariate(self, view: View) -> Array:
        """The condition over the laboratory's, u, shape (n,)."""
        values, lab = view.of(self.role), view.lab_of(self.role)
        if self.of_factors:
            return np.log(np.maximum(values, 1e-6) / max(lab, 1e-6))
        return (values - lab) / self.half_range

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Scale the output along the condition."""
        if output not in self.logs:
            return mean_response
        u = self.covariate(view)
        p = dict(zip(self.parameters, each(phi), strict=True))
        change = np.clip(p[f"{output}_slope"] * u + p[f"{output}_bend"] * u**2, -4.0, 4.0)
        if self.logs[output]:
            return np.asarray(mean_response + change)
        changed = mean_response * np.exp(change)
        if output in self._additive:
            changed = changed + p[f"{output}_offset"] * u * view.load_kn
        return np.asarray(changed)

    def shape(self, view: View) -> Array | None:
        """The condition itself."""
        return self.covariate(view)


class DiffersBy(Effect):
    """The output differs between the values of a recorded category.

    Parameters
    ----------
    column : str
        Of the category, as the places of its values in a list.
    levels : sequence of str
        Its values.
    logs : mapping of str to bool
        Physical roles of the outputs, and whether their logarithms are compared.
    usual : int
        Place of the value that is most frequent in the laboratory.
    """

    form = ("slip", "pressure")

    def __init__(
        self, column: str, levels: Sequence[str], logs: Mapping[str, bool], usual: int
    ) -> None:
        self.column, self.logs, self.usual = column, dict(logs), usual
        self.name = f"{PREFIX}{column}"
        self.title = f"the output differs by {column.replace('_', ' ')}"
        self.outputs = tuple(logs)
        self.covariates = (column,)
        self._levels = [j for j in range(len(levels)) if j != usual]
        slug = {j: re.sub(r"\W+", "_", levels[j]).strip("_") or str(j) for j in self._levels}
        if len(set(slug.values())) < len(slug):
            slug = {j: f"{word}_{j}" for j, word in slug.items()}
        self._additive = tuple(o for o, log in logs.items() if not log and o == "pull")
        self.parameters = (
            *(f"{output}_factor_{slug[j]}" for output in logs for j in self._levels),
            *(f"{output}_offset_{slug[j]}" for output in self._additive for j in self._levels),
        )
        reference = re.sub(r"\W+", " ", levels[usual]).strip()
        self.priors = f'model = "{self.name}"\n' + "".join(
            f'\n[parameters."{p}"]\ndist = "normal"\nmean = 0.0\n'
            f'sd = {0.02 if "_offset_" in p else 0.3}\nunit = "1"\n'
            f'reason = "How it differs from {reference}, the most frequent"\n'
            'source = "This project: no published value was found; wide enough to be noticed"\n'
            for p in self.parameters
        )

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Scale the output by the factor of each row's value."""
        if output not in self.logs:
            return mean_response
        code = np.rint(view.of(self.column)).astype(int)
        hot = np.array([code == j for j in self._levels], dtype=float)
        # Factors of each output, then offsets of those that have them, of as many values each.
        kinds = [*(f"{o}_factor" for o in self.logs), *(f"{o}_offset" for o in self._additive)]
        p = dict(zip(kinds, np.split(phi, len(kinds), axis=1), strict=True))
        change = np.clip(p[f"{output}_factor"] @ hot, -4.0, 4.0)
        if self.logs[output]:
            return np.asarray(mean_response + change)
        changed = mean_response * np.exp(change)
        if output in self._additive:
            changed = changed + p[f"{output}_offset"] @ hot * view.load_kn
        return np.asarray(changed)
