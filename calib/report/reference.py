"""What the source of some data printed of its own results, to be shown beside ours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import ClassVar

from calib.data.registry import Registry
from calib.models.base import Array, BoundModel

type Limit = tuple[float, str]


@dataclass(frozen=True)
class Figure:
    """One printed figure.

    Parameters
    ----------
    text : str
        The figure as printed, in the stated unit; percentages as fractions.
    unit : str
        "1" where there is none.
    note : str
        What was inferred, and from what; empty where nothing was.
    """

    text: str
    unit: str = "1"
    note: str = ""

    @property
    def value(self) -> float:
        """The figure as a number."""
        return float(self.text)

    @property
    def half_unit(self) -> float:
        """Half a unit of the last printed digit."""
        exponent = Decimal(self.text).as_tuple().exponent
        return 0.5 * 10.0 ** int(exponent)

    def agrees(self, value: float) -> bool:
        """Whether a value, rounded to the printed digits, is this figure."""
        return abs(value - self.value) <= self.half_unit


@dataclass(frozen=True)
class FittedTable:
    """Estimates of one model, and the goodness of fit printed with them.

    With where they are printed, the equations fitted, and how to read them.
    """

    source: str
    model: str
    estimates: Mapping[str, Figure]
    quality: Mapping[str, Figure]
    note: str = ""

    @property
    def figures(self) -> dict[str, Figure]:
        """The estimates, and the goodness of fit."""
        return {**self.estimates, **self.quality}

    @property
    def place(self) -> str:
        """Where they are printed, in short."""
        return self.source.partition(",")[0]

    @property
    def values(self) -> dict[str, float]:
        """The estimates as numbers."""
        return {name: figure.value for name, figure in self.estimates.items()}


class Reference:
    """A source's results on its own data: by default it printed nothing.

    Attributes
    ----------
    label : str
        Of the data they are on (`Table.label`).
    alone : mapping of str to (mapping of int to FittedTable)
        By method: estimates at each value of `Model.alone` by itself.
    """

    label: str = ""
    alone: ClassVar[Mapping[str, Mapping[int, FittedTable]]] = {}

    def table(self, model: str) -> FittedTable | None:
        """Return the printed estimates of a model."""
        return None

    def quality(self, model: str) -> Mapping[str, Figure]:
        """Return the printed goodness of fit that can stand beside ours."""
        return {}

    def curve(self, model: str, conditions: Mapping[str, Array]) -> tuple[Array, str] | None:
        """Return the printed fit at conditions, and where it is printed."""
        return None

    def sampled(self, bound: BoundModel) -> dict[str, float]:
        """Return the sampled parameters that the printed figures amount to."""
        return {}

    def limits(self, model: str) -> tuple[Limit, ...]:
        """Return the largest relative errors that are stated, and on what."""
        return ()

    def parameters(self, model: str) -> Mapping[str, Figure]:
        """Return the printed parameters of a model, empty where there are none."""
        table = self.table(model)
        return table.estimates if table else {}

    def source(self, model: str) -> str:
        """Return where `parameters` are printed."""
        table = self.table(model)
        return table.source if table else ""

    def beside(self, method: str, value: float) -> FittedTable | None:
        """Return the estimates at one value by a method, or by the genetic algorithm."""
        if not float(value).is_integer():
            return None
        tables = self.alone.get(method) or self.alone.get("genetic", {})
        return tables.get(int(value))

    def register(self) -> None:
        """Have it shown beside results on data of its label."""
        REFERENCES.add(self)


NOTHING = Reference()
REFERENCES: Registry[Reference] = Registry("reference", lambda reference: reference.label)


def reference_of(label: str) -> Reference:
    """Return what was printed on data of a label."""
    return REFERENCES.get(label, NOTHING)
