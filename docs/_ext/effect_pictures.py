"""What an effect does to the outputs it touches, over the condition that matters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache

import numpy as np
import pandas as pd
from declared_models import example_table
from declared_text import code
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from calib.data import Table, table_from_arrays
from calib.data.quantities import physical_role
from calib.gap.campaigns import Campaigns, OutputData, campaigns
from calib.gap.case import Case
from calib.gap.effects import Effect
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, effect_priors
from calib.gap.ranking import calibrate_lab
from calib.inference.random import generator, latin
from calib.models import MODELS
from calib.report.figures import style
from calib.report.labels import axis_of
from calib.validation.constants import N_DRAWS

_MODELS = {
    "drawbar_pull": "magic_formula_pressure",
    "rut_depth": "modified_bekker",
    "bulk_density": "ayers_perumpral",
}
# What the examples lack: in the laboratory, and in the field, from one row to the next.
_LAB = {"pass_number": (1.0,), "speed_m_s": (1.0,)}
_FIELD = {"pass_number": (1.0, 2.0, 3.0, 4.0), "speed_m_s": (0.25, 0.5, 1.0, 2.0, 4.0)}
# What is misread, where it is no covariate.
_OVER = {"water_content_bias": "water"}


@cache
def _campaigns(roles: tuple[str, ...]) -> Campaigns:
    """The examples as a case of some outputs: its campaigns differ in what they lack alone."""
    models = {o: name for o, name in _MODELS.items() if physical_role(o) in roles}
    return campaigns(Case("examples", _gathered(_LAB), _gathered(_FIELD), models))


def _gathered(lacking: Mapping[str, tuple[float, ...]]) -> Table:
    """Rows of all examples; a condition that one lacks is the median of the others'."""
    rows, outputs = [], [MODELS[name].output for name in _MODELS.values()]
    for name in _MODELS.values():
        model, example = MODELS[name], example_table(MODELS[name])
        own = {c: example[c] for c in (*model.conditions, model.output)}
        own |= {c: np.resize(values, len(example)) for c, values in lacking.items()}
        rows.append(pd.DataFrame(own | {"run_order": np.arange(1.0, len(example) + 1.0)}))
    table = pd.concat(rows, ignore_index=True)
    filled = table.fillna(table.drop(columns=outputs).median())
    return table_from_arrays(dict(filled.items()), allow_missing=outputs)


def said(effect: Effect) -> tuple[str, str]:
    """Say what is drawn over what, and how."""
    shown = [(o.problem.bound.model, over) for o, over in _panels(effect)]
    drawn = (f"{axis_of(m.output).name} over {axis_of(over).name}".lower() for m, over in shown)
    models = " and ".join(f"[{code(m.name)}](../models/{m.name}.md)" for m, _ in shown)
    return f"{' and '.join(drawn)}, with it and without", (
        f"Dashed: the simulator alone, {models} fitted to the example there. Blue: with each "
        "parameter of the effect at its prior median, which is no effect where either sign is "
        "possible. The band is from the 5 % to the 95 % point of what the prior gives at each "
        "place; thin lines are six draws from it. Other conditions are at their medians."
    )


def drawn(effect: Effect) -> bytes:
    """Draw every output it touches; return the PNG file."""
    shown = list(_panels(effect))
    width = style.DOUBLE_MM if len(shown) > 1 else style.MIDDLE_MM
    margins = {"left": 17.0, "bottom": 20.0, "gap_x": 18.0}
    with style.style():
        figure, axes = style.panels(1, len(shown), height=58.0, width=width, **margins)
        for ax, (o, over) in zip(axes.flat, shown, strict=True):
            handles = _panel(ax, effect, o, over)
        style.legend_below(figure, handles, 2 * len(shown))
        return style.png_bytes(figure)


def _panels(effect: Effect) -> Iterator[tuple[OutputData, str]]:
    """Outputs that it touches, each with the column over which it is drawn."""
    data = _campaigns(effect.outputs)
    over = data.view.column(_OVER.get(effect.name, next(iter(effect.covariates), "")))
    for o in data.outputs:
        conditions = o.problem.bound.model.conditions
        # A condition that is misread matters where the simulator has it.
        yield o, over if over and (effect.varies or over in conditions) else conditions[0]


def _panel(ax: Axes, effect: Effect, o: OutputData, over: str) -> dict[str, Artist]:
    data = _campaigns(effect.outputs)
    modes, noise = calibrate_lab(data, 1)
    priors = effect_priors(data, effect)
    hypothesis = Hypothesis(effect.name, (effect,), (priors,))
    forward = Forward(data, hypothesis, {name: n.sigma for name, n in noise.items()})
    u = latin(generator(0, "docs", effect.name), N_DRAWS, len(priors.free))
    psi = np.zeros((1 + len(u), forward.n_dim))
    for name, mode in modes.items():
        psi[:, forward.theta_slices[name]] = mode
    psi[:, forward.phi_slices[0]] = priors.ppf(np.vstack([np.full(u.shape[1], 0.5), u]))
    recorded = data.view.conditions[over][o.rows]
    recorded = recorded if np.ptp(recorded) else data.view.conditions[over]
    at = np.linspace(recorded.min(), recorded.max(), 200)
    x, y = axis_of(over), axis_of(o.problem.bound.model.output)
    with_it, alone = (
        y.scale(o.problem.bound.from_response(found[o.name]))
        for found in forward.field_and_plain(psi, data.at_conditions({over: at}))
    )
    along = x.scale(at)
    low, high = np.quantile(with_it[1:], [0.05, 0.95], axis=0)
    band = ax.fill_between(along, low, high, color=style.BLUE, alpha=0.2, lw=0.0)
    (median,) = ax.plot(along, with_it[0], color=style.BLUE, lw=1.6)
    (dashed,) = ax.plot(along, alone[0], color=style.VERMILION, lw=1.4, ls=style.DASHES[1])
    ax.margins(x=0.0)
    # A draw may go far beyond the band, and would flatten all others.
    ax.set(xlabel=x.label, ylabel=y.label, ylim=ax.get_ylim())
    thin = ax.plot(along, with_it[1:7].T, color=style.BLUE, lw=0.5, alpha=0.7)
    if x.unit == "number":
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return {
        "simulator alone": dashed,
        "with the effect at its prior median": median,
        "5 to 95 % of its prior": band,
        "drawn from its prior": thin[0],
    }
