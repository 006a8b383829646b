"""Point estimates: several methods, one problem in, one `PointEstimate` out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from calib.batch.threads import one_thread
from calib.errors import CalibError
from calib.he2019.estimators.geometric import estimate_geometric
from calib.he2019.estimators.rut_regression import (
    RutRegression,
    estimate_published_regression,
    rut_regression,
)  # fmt: skip
from calib.inference.estimators.base import PointEstimate
from calib.inference.estimators.differential_evolution import estimate_differential_evolution
from calib.inference.estimators.genetic import GeneticSettings, estimate_genetic, minimise_genetic
from calib.inference.estimators.least_squares import estimate_least_squares
from calib.inference.problem import Problem
from calib.models import MODELS, get_model

__all__ = [
    "METHODS", "GeneticSettings", "PointEstimate", "RutRegression", "compare", "estimate",
    "methods_for", "minimise_genetic", "rut_regression",
]  # fmt: skip

METHODS = (
    "geometric", "genetic", "differential_evolution", "least_squares", "published_regression",
)  # fmt: skip

_ESTIMATORS: Mapping[str, Callable[..., PointEstimate]] = MappingProxyType(
    {
        "geometric": estimate_geometric,
        "genetic": estimate_genetic,
        "differential_evolution": estimate_differential_evolution,
        "least_squares": estimate_least_squares,
        "published_regression": estimate_published_regression,
    }
)
_MODELS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "geometric": ("magic_formula", "magic_formula_pressure"),
        "published_regression": ("bekker", "modified_bekker"),
    }
)


def methods_for(model_name: str) -> tuple[str, ...]:
    """Return the methods that apply to a model, in the order of `METHODS`.

    Raises
    ------
    CalibError
        If there is no model of that name.
    """
    name = get_model(model_name).name
    return tuple(method for method in METHODS if name in _MODELS.get(method, MODELS))


@one_thread()
def estimate(
    problem: Problem, method: str, rng: np.random.Generator, **settings: Any
) -> PointEstimate:
    """Estimate the parameters of a problem by one method.

    Parameters
    ----------
    problem : Problem
    method : str
        One of `methods_for` the problem's model.
    rng : Generator
        Of the methods that draw random numbers; the others ignore it.
    **settings
        Keyword arguments of the method's function, such as ``settings=GeneticSettings(NP=100)``
        for ``"genetic"`` or ``max_slip=0.3`` for ``"published_regression"``.

    Raises
    ------
    CalibError
        If there is no such method, it does not apply to the model, or it fails on these data.
    """
    model = problem.bound.model.name
    if method not in methods_for(model):
        found = f"method {method!r} does not apply to model {model}"
        raise CalibError(
            found if method in METHODS else f"there is no method {method!r}",
            allowed=", ".join(methods_for(model)),
            mend="use one of these methods",
        )
    return _ESTIMATORS[method](problem, rng, **settings)


def compare(
    problem: Problem, rng: np.random.Generator, methods: Sequence[str] | None = None
) -> tuple[PointEstimate, ...]:
    """Estimate by several methods, each on its own random stream.

    Parameters
    ----------
    problem : Problem
    rng : Generator
    methods : sequence of str, optional
        All that apply to the model by default. Of these, one that cannot read the data (no rise
        of the pull, one ground pressure) is left out; methods named here raise their error.

    Returns
    -------
    tuple of PointEstimate
        In the order of the methods.
    """
    found = []
    chosen = methods_for(problem.bound.model.name) if methods is None else tuple(methods)
    for method, stream in zip(chosen, rng.spawn(len(chosen)), strict=True):
        try:
            found.append(estimate(problem, method, stream))
        except CalibError:
            if methods is not None:
                raise
    return tuple(found)
