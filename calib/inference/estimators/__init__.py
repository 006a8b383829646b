"""Point estimates: several methods, one problem in, one `PointEstimate` out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.batch.threads import one_thread
from calib.data.registry import Registry
from calib.errors import CalibError
from calib.inference.estimators.base import PointEstimate
from calib.inference.estimators.genetic import GeneticSettings, estimate_genetic, minimise_genetic
from calib.inference.estimators.least_squares import estimate_least_squares
from calib.inference.estimators.search import estimate_differential_evolution
from calib.inference.problem import Problem
from calib.inference.trial import try_simulator
from calib.models import get_model

__all__ = [
    "METHODS", "GeneticSettings", "Method", "PointEstimate", "compare", "estimate", "method_name",
    "methods_for", "minimise_genetic",
]  # fmt: skip


@dataclass(frozen=True)
class Method:
    """A way to estimate the parameters of a model.

    Parameters
    ----------
    estimate : callable
        ``(problem, rng, **settings) -> PointEstimate``.
    title, short, words : str
        In a legend, at the head of a narrow column, and in a sentence.
    models : tuple of str
        The models it is for; empty for all.
    place : int
        Where it stands among the others: the least first.
    """

    name: str
    estimate: Callable[..., PointEstimate]
    title: str
    short: str
    words: str
    models: tuple[str, ...] = ()
    place: int = 100

    def register(self) -> None:
        """Have it applied wherever all methods are."""
        METHODS.add(self)


METHODS: Registry[Method] = Registry(
    "method of estimation",
    lambda method: method.name,
    Method("genetic", estimate_genetic, "genetic algorithm", "GA", "the genetic algorithm",
           place=10),
    Method(
        "differential_evolution", estimate_differential_evolution, "differential evolution", "DE",
        "differential evolution", place=20,
    ),
    Method("least_squares", estimate_least_squares, "least squares", "LS",
           "multi-start least squares", place=30),
)  # fmt: skip


def method_name(name: str) -> str:
    """Return how a method is called in a legend."""
    return METHODS[name].title if name in METHODS else name


def methods_for(model_name: str) -> tuple[str, ...]:
    """Return the methods that apply to a model, in their order.

    Raises
    ------
    CalibError
        If there is no model of that name.
    """
    name = get_model(model_name).name
    known = sorted(METHODS.values(), key=lambda method: method.place)
    return tuple(m.name for m in known if not m.models or name in m.models)


@one_thread()
def estimate(
    problem: Problem, method: str, rng: np.random.Generator, **settings: Any
) -> PointEstimate:
    """Estimate the parameters of a problem by one method.

    Parameters
    ----------
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
    try_simulator(problem)
    return METHODS[method].estimate(problem, rng, **settings)


def compare(
    problem: Problem, rng: np.random.Generator, methods: Sequence[str] | None = None
) -> tuple[PointEstimate, ...]:
    """Estimate by several methods, each on its own random stream.

    Parameters
    ----------
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
