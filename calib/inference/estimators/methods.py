"""The methods of point estimation, by name; a source's own are registered by its package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from calib.data.registry import Registry
from calib.inference.estimators.base import PointEstimate
from calib.inference.estimators.differential_evolution import estimate_differential_evolution
from calib.inference.estimators.genetic import estimate_genetic
from calib.inference.estimators.least_squares import estimate_least_squares


@dataclass(frozen=True)
class Method:
    """A way to estimate the parameters of a model.

    Parameters
    ----------
    name : str
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
