"""Point estimates: several methods, one problem in, one `PointEstimate` out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.batch.environment import one_thread
from calib.data.registry import Registry
from calib.errors import CalibError
from calib.inference.design import try_simulator
from calib.inference.estimators import (
    GeneticSettings,
    estimate_genetic,
    estimate_least_squares,
    minimise_genetic,
)
from calib.inference.problem import Problem
from calib.inference.search import PointEstimate, estimate_differential_evolution
from calib.models import get_model

__all__ = [
    "METHODS", "GeneticSettings", "Method", "PointEstimate", "compare", "estimate", "method_name",
    "methods_for", "minimise_genetic",
]  # fmt: skip


@dataclass(frozen=True)
class Method:
    """A way to estimate the parameters of a model.

    `estimate` is ``(problem, rng, **settings) -> PointEstimate``; `title`, `short` and `words` name
    it in a legend, at the head of a narrow column, and in a sentence. It is for the named `models`,
    or for all; the least `place` comes first.
    """

    name: str
    estimate: Callable[..., PointEstimate]
    title: str
    short: str
    words: str
    models: tuple[str, ...] = ()
    place: int = 100

    def register(self) -> None:
        """Apply it wherever all methods apply."""
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
    """Return the name of a method for a legend."""
    return METHODS[name].title if name in METHODS else name


def methods_for(model_name: str) -> tuple[str, ...]:
    """Return the methods that apply to a model, in their order."""
    name = get_model(model_name).name
    known = sorted(METHODS.values(), key=lambda method: method.place)
    return tuple(m.name for m in known if not m.models or name in m.models)


@one_thread()
def estimate(
    problem: Problem, method: str, rng: np.random.Generator, **settings: Any
) -> PointEstimate:
    """Estimate the parameters of a problem by one method.

    Settings are keyword arguments of the method's function, such as
    ``settings=GeneticSettings(NP=100)`` for ``"genetic"``. A CalibError if the method does not
    exist, does not apply to the model, or fails on these data.
    """
    model = problem.bound.model.name
    if method not in methods_for(model):
        found = f"method {method!r} does not apply to model {model}"
        raise CalibError(
            found if method in METHODS else f"there is no method {method!r}",
            expected=", ".join(methods_for(model)),
            hint="use one of these methods",
        )
    try_simulator(problem)
    return METHODS[method].estimate(problem, rng, **settings)


def compare(
    problem: Problem, rng: np.random.Generator, methods: Sequence[str] | None = None
) -> tuple[PointEstimate, ...]:
    """Estimate by several methods, each on its own random stream, in the order of the methods.

    By default these are all that apply to the model, without those that cannot read the data (no
    rise of the pull, one ground pressure); methods that are named raise their error.
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
