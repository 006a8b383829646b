"""One figure: what a posterior costs with each sampler, and the likelihood against its floor."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from calib.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    VERMILION,
    legend_below,
    panels,
    style,
)
from report.rows import NAMES, RHAT_MAX, sound

__all__ = ["draw"]

_SAMPLERS = (
    ("calib default", "calib, default", BLUE, "o"),
    ("calib long", "calib, long", BLUE, "s"),
    ("nutpie default", "PyMC + nutpie, default", VERMILION, "o"),
    ("nutpie long", "PyMC + nutpie, long", VERMILION, "s"),
    ("stretch", "emcee's stretch move", GREEN, "^"),
)
_LIBRARIES = (("numexpr", ORANGE, "^"), ("Numba", GREEN, "D"), ("JAX", VERMILION, "v"))


def draw(measured: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Draw what was measured of the posterior and the likelihood parts."""
    with style():
        figure, axes = panels(
            2, 3, height=50.0, width=180.0, left=14.0, right=4.0, top=7.0, bottom=27.0,
            gap_x=17.0, gap_y=17.0,
        )  # fmt: skip
        handles: dict[str, Any] = {}
        for ax, key in zip(axes[0], NAMES, strict=True):
            if "posterior" in measured:
                handles |= _time(ax, measured["posterior"]["problems"][key])
            ax.set_title(f"{NAMES[key]}: one core")
        if "posterior" in measured:
            _evaluations(axes[1, 0], measured["posterior"]["problems"])
        if "likelihood" in measured:
            handles |= _likelihood(axes[1, 1], measured["likelihood"])
        if "genetic" in measured:
            handles |= _genetic(axes[1, 2], measured["genetic"]["problems"])
        legend_below(figure, handles, ncols=4)
        figure.savefig(path, dpi=200)


def _time(ax: Axes, problem: Mapping[str, Any]) -> dict[str, Any]:
    handles = {}
    for name, label, colour, marker in _SAMPLERS:
        runs = problem["runs"][name]
        x, y = [r["seconds"] for r in runs], [r["ess_bulk"] for r in runs]
        (handles[label],) = ax.plot(
            x, y, marker, color=colour, mfc="none" if marker == "s" else colour, ms=4.0, alpha=0.8,
        )  # fmt: skip
    ax.set(xscale="log", yscale="log", xlabel="seconds", ylabel="smallest bulk ESS")
    ax.margins(0.12)
    runs = [r for name in ("nutpie default", "nutpie long") for r in problem["runs"][name]]
    apart = sum(not sound(r) for r in runs)
    if apart:
        ax.annotate(
            f"{apart} of nutpie's runs: R-hat > {RHAT_MAX:g}", (0.97, 0.03), fontsize=6,
            xycoords="axes fraction", ha="right", color=VERMILION,
        )  # fmt: skip
    _rates(ax)
    return handles


def _rates(ax: Axes) -> None:
    """Lines of equal ESS per second."""
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    x = np.array([x0, x1])
    for rate in 10.0 ** np.arange(1, 8):
        if rate * x1 > y0 and rate * x0 < y1:
            ax.plot(x, rate * x, ":", color=GREY, lw=0.6, zorder=0)
            at = min(x1, y1 / rate)
            if rate * at > y0 * (y1 / y0) ** 0.1:
                ax.annotate(
                    f"$10^{int(np.log10(rate))}$/s", (at, rate * at), fontsize=6, color=GREY,
                    ha="right", va="top", xytext=(-2.0, -3.0), textcoords="offset points",
                )  # fmt: skip
    ax.set(xlim=(x0, x1), ylim=(y0, y1))


def _evaluations(ax: Axes, problems: Mapping[str, Any]) -> None:
    shown = [s for s in _SAMPLERS if s[0] in ("calib default", "nutpie long", "stretch")]
    for i, key in enumerate(NAMES):
        for name, _, colour, marker in shown:
            runs = problems[key]["runs"][name]
            if name.startswith("nutpie"):
                runs = [r for r in runs if sound(r)]
            values = [r["evaluations_per_bulk"] for r in runs]
            ax.plot([i] * len(values), values, marker, color=colour,
                    mfc="none" if marker == "s" else colour, alpha=0.8)  # fmt: skip
    ax.axhline(6.0, color=BLACK, lw=0.8, ls="--")
    ax.annotate("asked: 6", (2.45, 6.9), fontsize=7, ha="right")
    ax.axhline(1.0, color=GREY, lw=0.8, ls=":")
    ax.annotate("independent\ndraws: 1", (-0.45, 0.93), fontsize=7, va="top", color=GREY)
    ax.set_xticks(range(len(NAMES)), [n.replace(" ", "\n", 1) for n in NAMES.values()])
    ax.set(yscale="log", ylim=(0.3, 400.0), xlim=(-0.5, 2.5), ylabel="evaluations per bulk ESS")
    ax.set_title("likelihoods (nutpie: with gradients)")


def _likelihood(ax: Axes, measured: Mapping[str, Any]) -> dict[str, Any]:
    handles = {}
    rows = measured["rows"]
    x = [r["rows"] for r in rows]
    for key, label, colour, dash in (
        ("cells_per_second", "calib's log posterior", BLUE, "-"),
        ("floor_cells_per_second", "floor: NumPy's sin, arctan", BLACK, "--"),
    ):
        s = [r[key] for r in rows]
        (handles[label],) = ax.plot(
            x, [1e-6 * v["median"] for v in s], dash, marker="o", color=colour
        )
        ax.fill_between(
            x, [1e-6 * v["low"] for v in s], [1e-6 * v["high"] for v in s], color=colour,
            alpha=0.15, lw=0.0,
        )  # fmt: skip
    # Libraries have the sums of squares to work out, with each pressure's coefficients ready.
    for name, colour, marker in (("calib", BLUE, "s"), *_LIBRARIES):
        found = [r for r in measured["peers"] if name in r["cells_per_second"]]
        if found:
            y = [1e-6 * r["cells_per_second"][name]["median"] for r in found]
            label = f"{name}, squares alone"
            (handles[label],) = ax.plot([r["rows"] for r in found], y, ":", marker=marker,
                                        mfc="none", color=colour)  # fmt: skip
    ax.set(
        xscale="log",
        yscale="log",
        xlabel="rows (cell: row times vector)",
        ylabel="million cells per second",
        ylim=(8.0, 400.0),
    )
    ax.set_title("likelihood of drawbar pull: one core")
    return handles


def _genetic(ax: Axes, problems: Mapping[str, Any]) -> dict[str, Any]:
    handles = {}
    for i, p in enumerate(problems.values()):
        for shift, ((name, m), colour) in enumerate(
            zip(p["methods"].items(), (BLUE, ORANGE, VERMILION), strict=True)
        ):
            y = i + 0.25 * (shift - 1)
            s = {k: 1e3 * v for k, v in m["seconds"].items()}
            handles[name] = ax.barh(y, s["median"], 0.23, color=colour)
            ax.plot([s["low"], s["high"]], [y, y], color=BLACK, lw=0.6)
            ax.annotate(f" {m['at_the_optimum']}/{m['seeds']}", (s["high"], y), fontsize=5.5,
                        va="center")  # fmt: skip
    labels = [NAMES.get(k, k.replace("drawbar_pull at ", "")).replace(" ", "\n") for k in problems]
    ax.set_yticks(range(len(labels)), labels, fontsize=6)
    ax.invert_yaxis()
    high = max(m["seconds"]["high"] for p in problems.values() for m in p["methods"].values())
    ax.set(xscale="log", xlabel="milliseconds (seeds at it)",
           xlim=(2.0, 4e3 * high))  # fmt: skip
    ax.set_title("to the optimum: one core")
    return handles
