"""What the engineer knows before the diagnosis: causes suspected or excluded, sizes that are known.

It changes what is believed before the data, never the data; a diagnosis that was given a context
says what it finds without it as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calib.errors import CalibError, in_words
from calib.inference.priors import Prior, Priors

if TYPE_CHECKING:
    from calib.gap.hypothesis import Hypothesis


# A known size that is so many sds (its own and its prior's) off may be in another unit.
_UNUSUAL = 4.0
_Number = Annotated[float, Field(ge=-1e15, le=1e15)]


class Size(BaseModel):
    """A parameter of an effect as it is known: mean and sd, in its own unit."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    mean: _Number
    sd: Annotated[float, Field(gt=1e-15, le=1e15)]


class _Written(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    suspected: dict[str, Annotated[float, Field(gt=0.0, lt=1.0)]] = {}
    excluded: list[str] = []
    sizes: dict[str, dict[str, Size]] = {}


@dataclass(frozen=True)
class Context:
    """What is put into a diagnosis besides its data.

    Parameters
    ----------
    suspected : mapping of str to float
        Prior probability that a cause acts, whatever acts besides.
    excluded : tuple of str
        Causes that cannot have acted.
    sizes : mapping of str to mapping of str to Size
        Effect to parameter to what is known of it.
    """

    suspected: Mapping[str, float] = field(default_factory=dict)
    excluded: tuple[str, ...] = ()
    sizes: Mapping[str, Mapping[str, Size]] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.suspected or self.excluded or self.sizes)

    @property
    def names(self) -> tuple[str, ...]:
        """Every cause it speaks of."""
        return tuple(dict.fromkeys([*self.suspected, *self.excluded, *self.sizes]))

    def sized(self, single: Hypothesis) -> Hypothesis:
        """Return an effect with what is known of its size in the place of its prior.

        Raises
        ------
        CalibError
            If it has no such parameter, or the mean is not within the bounds of its prior.
        """
        known = self.sizes.get(single.name)
        if not known:
            return single
        (priors,) = single.effect_priors
        strange = set(known) - {p.name for p in priors.free}
        if strange:
            raise CalibError(
                f"{single.name} has no parameter {min(strange)!r}", where="[context] sizes",
                expected=", ".join(p.name for p in priors.free), hint="correct the name",
            )  # fmt: skip
        return replace(single, effect_priors=(_known(single.name, priors, known),))

    def unusual(self, single: Sequence[Hypothesis]) -> list[str]:
        """Say which sizes are far from what their effects usually have, as in another unit.

        Parameters
        ----------
        single : sequence of Hypothesis
            Effects by themselves, with their usual priors.
        """
        said = []
        for h in single:
            for p in h.effect_priors[0].free:
                size = self.sizes.get(h.name, {}).get(p.name)
                if size is None:
                    continue
                loc, scale = _on_its_scale(size, p)
                apart = abs(loc - p.loc) / float(np.hypot(scale, p.scale))
                if apart > _UNUSUAL:
                    low, high = (p.loc + s * p.scale for s in (-1.0, 1.0))
                    low, high = (float(np.exp(e)) if p.log else e for e in (low, high))
                    said.append(
                        f"[context] sizes: {h.name} is said to have {p.name} {size.mean:g} ± "
                        f"{size.sd:g}{_unit(p.unit)}, {apart:.0f} sds from what is usual "
                        f"({low:.3g} to {high:.3g}): check its sign and unit, for the diagnosis "
                        "takes it as it is"
                    )
        return said

    def words(self, single: Sequence[Hypothesis] = ()) -> list[str]:
        """Say what was put in, sizes in the units of the effects that are given."""
        units = {(h.name, p.name): _unit(p.unit) for h in single for p in h.effect_priors[0].free}
        said = [f"{n.replace('_', ' ')} suspected ({p:g})" for n, p in self.suspected.items()]
        said += [f"{name.replace('_', ' ')} excluded" for name in self.excluded]
        said += [
            f"{name.replace('_', ' ')}: {parameter} {size.mean:g} ± {size.sd:g}"
            f"{units.get((name, parameter), '')}"
            for name, known in self.sizes.items()
            for parameter, size in known.items()
        ]
        return said


def _unit(unit: str) -> str:
    return "" if unit in {"1", "dimensionless", ""} else f" {unit}"


def _on_its_scale(size: Size, p: Prior) -> tuple[float, float]:
    """Mean and sd, of the logarithm where the prior is of that."""
    return (float(np.log(size.mean)), size.sd / size.mean) if p.log else (size.mean, size.sd)


def _known(effect: str, priors: Priors, known: Mapping[str, Size]) -> Priors:
    entries = []
    for p in priors.entries:
        size = known.get(p.name)
        if size is None:
            entries.append(p)
            continue
        if p.log and size.mean <= 0.0:
            raise CalibError(
                f"{effect}: {p.name} is positive", where="[context] sizes",
                expected="a mean above zero", hint="correct it",
            )  # fmt: skip
        loc, scale = _on_its_scale(size, p)
        if not p.lower <= loc <= p.upper:
            low, high = (np.exp(end) if p.log else end for end in (p.lower, p.upper))
            raise CalibError(
                f"{effect}: {p.name} cannot be {size.mean:g}", where="[context] sizes",
                expected=f"a mean from {low:g} to {high:g}",
                hint="correct it, or declare an effect of your own with another prior",
            )  # fmt: skip
        entries.append(replace(p, loc=loc, scale=scale))
    return Priors(tuple(entries), priors.text, priors.source)


def read_context(content: Any, where: str) -> Context:
    """Check the table ``[context]`` of a ``case.toml``.

    Parameters
    ----------
    content : Any
        The table, or None where there is none.
    where : str
        Its file, for messages.

    Raises
    ------
    CalibError
        Naming the entry, and what is allowed there.
    """
    if content is None:
        return Context()
    try:
        written = _Written.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise CalibError(
            in_words(first), where=f"{where}, context.{place}",
            expected="suspected = {name = probability}, excluded = [names], "
            "sizes = {name = {parameter = {mean = …, sd = …}}}",
            hint="write, for example: suspected = {lug_thrust = 0.5} and, in the next line, "
            'excluded = ["sensor_drift"]',
        ) from None  # fmt: skip
    twice = set(written.suspected) & set(written.excluded)
    if twice:
        raise CalibError(
            f"{min(twice)} is both suspected and excluded", where=f"{where}, [context]",
            hint="leave one of the two out",
        )  # fmt: skip
    return Context(written.suspected, tuple(written.excluded), written.sizes)
