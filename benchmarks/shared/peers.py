"""The same posteriors for the peers: our problems written in PyMC."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.inference.problem import Problem

__all__ = ["pymc_model"]


def pymc_model(problem: Problem) -> Any:
    """Write a problem in PyMC: the same priors, truncations, likelihood and coordinates.

    Parameters
    ----------
    problem : Problem
        Of one of the models in `_LOCATION`.

    Returns
    -------
    pymc.Model
        Its free variables are our internal coordinates, under our names; the logarithm of a
        log-normal parameter is normal there, which is the geometry PyMC would choose itself.
    """
    import pymc as pm
    import pytensor.tensor as pt

    with pm.Model() as model:
        natural = {}
        for prior in problem.priors.entries:
            if prior.fixed:
                natural[prior.name] = pt.as_tensor(prior.loc)
                continue
            lower, upper = prior.lower, prior.upper
            if not np.isfinite(prior.scale):
                t = pm.Uniform(prior.name, lower, upper)
            elif np.isfinite(lower) or np.isfinite(upper):
                t = pm.TruncatedNormal(
                    prior.name,
                    prior.loc,
                    prior.scale,
                    lower=lower if np.isfinite(lower) else None,
                    upper=upper if np.isfinite(upper) else None,
                )
            else:
                t = pm.Normal(prior.name, prior.loc, prior.scale)
            natural[prior.name] = pt.exp(t) if prior.log else t
        location = _LOCATION[problem.bound.model.name](natural, problem, pm, pt)
        pm.Normal("response", location, natural["sigma"], observed=problem.response)
    return model


def _magic_formula_pressure(v: dict[str, Any], problem: Problem, pm: Any, pt: Any) -> Any:
    references, conditions = problem.bound.references, problem.conditions
    distinct, level = np.unique(conditions["inflation_pressure_psi"], return_inverse=True)
    u = (distinct - references["p_mid_psi"]) / references["p_half_psi"]
    at = {}
    for q in "KDG":
        low, high, bend = (v[f"{q}_{end}"] for end in ("lo", "hi", "bend"))
        mean, half = 0.5 * (low + high), 0.5 * (high - low)
        at[q] = mean + half * u + bend * mean * (u * u - 1.0)
        # Positive between the end pressures: so are the ends, being log-normal, and the vertex,
        # where it lies between them, must be.
        curvature = bend * mean
        inside = (curvature > 0.0) & (pt.abs(half) < 2.0 * curvature)
        lowest = mean - curvature - half**2 / pt.switch(inside, 4.0 * curvature, 1.0)
        pm.Potential(f"{q}_positive", pt.switch(inside & (lowest <= 0.0), -np.inf, 0.0))
    C = v["C"]
    B = (at["K"] / (C * at["D"]))[level]
    bx = B * (100.0 * conditions["slip_ratio"])
    E = 1.0 - at["G"][level]
    return at["D"][level] * pt.sin(C * pt.arctan(bx - E * (bx - pt.arctan(bx))))


def _modified_bekker(v: dict[str, Any], problem: Problem, pm: Any, pt: Any) -> Any:
    conditions = problem.conditions
    pressure = conditions["average_ground_pressure_kpa"] / problem.bound.references["p_ref_kpa"]
    exponent = v["n0"] + v["n1"] * conditions["slip_ratio"]
    pm.Potential("exponent_positive", pt.switch(pt.all(exponent > 0.0), 0.0, -np.inf))
    ln_mm_per_m = np.log(1000.0)
    return (
        np.log(pressure) + v["n0"] * (pt.log(v["z_ref"]) - ln_mm_per_m)
    ) / exponent + ln_mm_per_m


def _ayers_perumpral(v: dict[str, Any], problem: Problem, pm: Any, pt: Any) -> Any:
    conditions, references = problem.conditions, problem.bound.references

    def ln_water_term(water: Any) -> Any:
        return pt.log(v["C2"] + (water - v["C3"]) ** 2)

    ln_index = np.log(conditions["cone_index_kpa"] / references["ci_ref_kpa"])
    drier = ln_water_term(conditions["gravimetric_water_content"]) - ln_water_term(
        references["water_ref"]
    )
    return v["gamma_ref"] * pt.exp((ln_index + drier) / v["C4"])


_LOCATION = {
    "magic_formula_pressure": _magic_formula_pressure,
    "modified_bekker": _modified_bekker,
    "ayers_perumpral": _ayers_perumpral,
}
