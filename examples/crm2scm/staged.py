"""The calibration in three stages, as the public scripts state it, beside one joint posterior.

    calib joint … --out joint          (README.md)
    python staged.py joint --out posterior.png

Stage 1 is Kc, Kphi, n of the plates; stage 2 is c, phi of the steady torques; stage 3 is K of the
mean torques, with c and phi held at 2496 Pa and 24 degrees. In each the log likelihood is

    -sum(residual^2) / (2 sigma^2 n),    sigma = 100 N of a plate and 1 N m of a ring,

divided by the n readings, so that all of them count as one. Four chains of Metropolis update one
parameter after another, on the logit scale of its bounds, with 200,000 tuning steps per million;
proposals are rescaled by their acceptance every 100 tuning steps, by PyMC's published rule.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

type Array = NDArray[np.float64]

HERE = Path(__file__).parent
INNER_M, OUTER_M, GRAVITY = 0.15, 0.2, 9.81
ARM_M, AREA_M2 = (INNER_M + OUTER_M) / 2.0, np.pi * (OUTER_M**2 - INNER_M**2)
# Held in the third stage.
COHESION_KPA, FRICTION_DEG = 2.496, 24.0
CHAINS = 4
# What their scripts print of the posterior, and what they go on with.
PUBLISHED = {"Kc": -110.0, "Kphi": 2220.0, "n": 1.2, "c": 2.495, "phi": 24.0, "K": 3.0}
UNITS = {"Kc": "kN/m^(n+1)", "Kphi": "kN/m^(n+2)", "n": "1", "c": "kPa", "phi": "degree", "K": "mm"}


@dataclass(frozen=True)
class Stage:
    """One stage, in kN, kPa, mm, N m and degrees.

    Parameters
    ----------
    names : tuple of str
    bounds : ndarray, shape (2, d)
    start : ndarray, shape (d,)
    predict : callable
        ``(k, d) -> (k, n)``, of all rows.
    measured : ndarray, shape (n,)
    sigma : float
    fitted : ndarray of bool, shape (n,)
    """

    names: tuple[str, ...]
    bounds: Array
    start: Array
    predict: Callable[[Array], Array]
    measured: Array
    sigma: float
    fitted: NDArray[np.bool_]

    def log_likelihood(self, theta: Array) -> Array:
        """Return it, divided by the number of readings, shape (k,)."""
        z = (self.predict(theta) - self.measured)[:, self.fitted] / self.sigma
        return np.asarray(-0.5 * np.square(z).mean(axis=1))


def column(file: str, name: str) -> Array:
    """Return a column of a CSV."""
    with (HERE / file).open(encoding="utf-8") as lines:
        place = lines.readline().strip().split(",").index(name)
    return np.loadtxt(HERE / file, delimiter=",", skiprows=1, usecols=place)


def stages(
    without_sinkages: Collection[float] = (), without_masses: Collection[float] = ()
) -> tuple[Stage, Stage, Stage]:
    """Return the three stages, fitted without some sinkages (mm) and masses (kg)."""
    b, z = (column("plate.csv", f"plate_{q}_mm") for q in ("radius", "sinkage"))
    pressed, b, z = ~np.isin(z, [*without_sinkages]), b / 1000.0, z / 1000.0
    mass = column("steady.csv", "ring_mass_kg")
    loaded = ~np.isin(mass, [*without_masses])
    sheared = 1000.0 * np.radians([1.0, 2.0, 3.0]) * ARM_M

    def plates(theta: Array) -> Array:
        kc, kphi, n = theta.T[:, :, None]
        return (kc / b + kphi) * z**n * (np.pi * b**2)

    def strengths(theta: Array) -> Array:
        c, phi = theta.T[:, :, None]
        return ARM_M * (1000.0 * AREA_M2 * c + GRAVITY * mass * np.tan(np.radians(phi)))

    held = strengths(np.array([[COHESION_KPA, FRICTION_DEG]]))

    def means(theta: Array) -> Array:
        return held * -np.expm1(-sheared / theta).mean(axis=1, keepdims=True)

    force = column("plate.csv", "plate_force_n") / 1000.0
    steady, mean = column("steady.csv", "steady_torque_nm"), column("mean.csv", "mean_torque_nm")
    low, high = np.array([-1e4, 0.0, 0.0]), np.array([1e4, 1e4, 3.0])
    start = np.array([10.0, 10.0, 1.0])
    ring = np.array([[0.0, 0.0], [10.0, 90.0]])
    return (
        Stage(("Kc", "Kphi", "n"), np.array([low, high]), start, plates, force, 0.1, pressed),
        Stage(("c", "phi"), ring, np.array([1.0, 20.0]), strengths, steady, 1.0, loaded),
        Stage(("K",), np.array([[0.0], [100.0]]), np.array([5.0]), means, mean, 1.0, loaded),
    )


def metropolis(stage: Stage, steps: int, rng: np.random.Generator) -> Array:
    """Sample a stage, shape (chains, steps, d)."""
    (lower, upper), tune = stage.bounds, steps // (CHAINS + 1)

    def natural(t: Array) -> Array:
        return np.asarray(lower + (upper - lower) / (1.0 + np.exp(-t)))

    def density(t: Array) -> Array:
        jacobian = -np.abs(t) - 2.0 * np.log1p(np.exp(-np.abs(t)))
        return np.asarray(stage.log_likelihood(natural(t)) + jacobian.sum(axis=1))

    inside = (stage.start - lower) / (upper - lower)
    t = np.tile(np.log(inside / (1.0 - inside)), (CHAINS, 1))
    value, scale, taken = density(t), np.ones_like(t), np.zeros_like(t)
    kept = np.empty((steps, CHAINS, t.shape[1]))
    for i in range(-tune, steps):
        for j in range(t.shape[1]):
            new = t.copy()
            new[:, j] += scale[:, j] * rng.standard_normal(CHAINS)
            proposed = density(new)
            accept = np.log(rng.random(CHAINS)) < proposed - value
            t[accept], value[accept] = new[accept], proposed[accept]
            taken[:, j] += accept
        if i >= 0:
            kept[i] = natural(t)
        elif (i + tune) % 100 == 99:
            scale *= rescaled(taken / 100.0)
            taken[:] = 0.0
    return kept.swapaxes(0, 1)


def rescaled(accepted: Array) -> Array:
    """Return the factor of a proposal's scale for a rate of acceptance."""
    rates, factors = [0.001, 0.05, 0.2, 0.5, 0.75, 0.95], [0.1, 0.5, 0.9, 1.0, 1.1, 2.0, 10.0]
    return np.array(factors)[np.searchsorted(rates, accepted)]


def bands(stage: Stage, draws: Array, sigma: float, rng: np.random.Generator) -> Array:
    """Return the ends of the 90 % bands of new readings, (2, n), of draws (..., d)."""
    theta = draws.reshape(-1, draws.shape[-1])
    new = stage.predict(theta[rng.integers(len(theta), size=20_000)])
    return np.quantile(new + sigma * rng.standard_normal(new.shape), [0.05, 0.95], axis=0)


def covered(stage: Stage, draws: Array, rows: Array, rng: np.random.Generator) -> dict[str, str]:
    """Count readings within bands, by sigma: as stated, and as the divided likelihood has it."""
    found = {}
    for name, factor in (("stated", 1.0), ("divided", stage.fitted.sum() ** 0.5)):
        low, high = bands(stage, draws, factor * stage.sigma, rng)
        inside = (low <= stage.measured) & (stage.measured <= high)
        found[name] = f"{inside[rows].sum()} of {rows.sum()}"
    return found


def run(steps: int, rng: np.random.Generator) -> tuple[dict[str, Any], dict[str, Array]]:
    """Run the three stages: what is found, and draws by parameter."""
    from calib.inference.diagnostics import convergence

    found: dict[str, Any] = {"steps": steps}
    draws: dict[str, Array] = {}
    for number, (stage, less) in enumerate(
        zip(stages(), stages((50, 175), (75, 175)), strict=True), 1
    ):
        start = time.perf_counter()
        sampled = metropolis(stage, steps, rng)
        seconds = round(time.perf_counter() - start, 1)
        flat = sampled.reshape(-1, sampled.shape[-1])
        draws |= dict(zip(stage.names, flat[::100].T, strict=True))
        hats, sizes, _ = convergence(sampled[:, None])  # each chain by itself
        for name, *of in zip(stage.names, flat.mean(0), flat.std(0), sizes, hats, strict=True):
            found[name] = dict(zip(("mean", "sd", "ess", "rhat"), map(float, of), strict=True))
        found[f"stage {number}"] = {
            "seconds": seconds,
            "correlations": np.corrcoef(flat.T).round(3).tolist(),
            "fitted, within 90 %": covered(stage, sampled, stage.fitted, rng),
            "left out, within 90 %": covered(
                less, metropolis(less, steps // 5, rng), ~less.fitted, rng
            ),
        }
    return found, draws


def draw(folder: Path, staged: Mapping[str, Array], out: Path) -> None:
    """Draw densities of both, and what is left of the readings with the bands of both."""
    from scipy.stats import gaussian_kde

    from calib.inference.joint_files import load_joint
    from calib.report.figures.style import BLUE, GREY, VERMILION, panels, style
    from calib.validation.prediction import predict

    joint = load_joint(folder)
    rng = np.random.default_rng(1)
    with style():
        figure, axes = panels(3, 3, height=36.0, gap_x=14.0, gap_y=15.0, top=12.0, bottom=12.0)
        for ax, (name, unit) in zip(axes[:2].flat, UNITS.items(), strict=True):
            ours, theirs = joint.parameters[name].ravel(), staged[name]
            middle, sd = ours.mean(), ours.std()
            x = np.linspace(middle - 4.0 * sd, middle + 4.0 * sd, 400)
            ax.plot(x, gaussian_kde(ours[::5])(x), color=BLUE, label="joint, sigma unknown")
            ax.plot(x, gaussian_kde(theirs)(x), color=VERMILION, ls="--", label="three stages")
            ax.axvline(PUBLISHED[name], color=GREY, ls=":", label="value that was used")
            ax.set(xlabel=f"{name} ({unit})", yticks=[], ylim=(0.0, None))
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="upper center", ncols=3)
        said = (
            ("plates: 200 mm, 300 mm", "row", "kN"), ("steady torques", "mass (kg)", "N m"),
            ("mean torques", "mass (kg)", "N m"),
        )  # fmt: skip
        mass = column("steady.csv", "ring_mass_kg")
        for ax, stage, calibration, (title, at, unit) in zip(
            axes[2], stages(), joint.outputs.values(), said, strict=True
        ):
            band = predict(calibration, calibration.problem.table)
            low, high = band.predictive.lower[0.9], band.predictive.upper[0.9]
            theta = np.stack([staged[name] for name in stage.names], axis=-1)
            sigma = stage.sigma * stage.measured.size**0.5
            own, median = bands(stage, theta, sigma, rng), band.predictive.median
            x = mass if unit == "N m" else np.arange(1, median.size + 1)
            for half in np.array_split(np.arange(x.size), 1 if unit == "N m" else 2):
                ax.fill_between(
                    x[half], (low - median)[half], (high - median)[half],
                    color=BLUE, alpha=0.2, lw=0,
                )  # fmt: skip
                for end in own:
                    ax.plot(x[half], (end - median)[half], color=VERMILION, ls="--")
            ax.plot(x, stage.measured - median, "o", color="black", ms=3)
            ax.set(xlabel=at, ylabel=f"measured - median ({unit})", title=title)
        figure.savefig(out, dpi=150)


def main() -> None:
    """Run the three stages, print what they find as JSON, and draw both."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("joint", type=Path, help="folder of calib joint")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=2019)
    parser.add_argument("--out", type=Path, default=Path("posterior.png"))
    options = parser.parse_args()
    import_module("crm2scm")  # registers the models of the folder
    found, staged = run(options.steps, np.random.default_rng(options.seed))
    print(json.dumps(found, indent=1))
    draw(options.joint, staged, options.out)


if __name__ == "__main__":
    main()
