"""What every kind of task is: a table of the plan, the tasks it stands for, and their work."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

from calib.batch.campaign.place import Place
from calib.errors import CalibError
from calib.models.simulators.registered import slow_simulator


class Section(BaseModel):
    """A table of the plan; each field's description is shown where its value will not do."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
    name: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$",
        description="a word of letters, digits, _ and - that no other table of the plan has",
    )
    seed: int | None = Field(
        default=None, ge=0, description="0 or a positive whole number; the plan's own if left out"
    )


@dataclass(frozen=True)
class Planned:
    """A task as its kind describes it; the label tells it from the others of its table.

    Parameters
    ----------
    settings : mapping of str to object
        All that decides the result beside the inputs and the seed; JSON can hold it.
    inputs : mapping of str to Path
        Files that are read, by the names to show.
    """

    label: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class Task:
    """A task of a plan, of one of `KINDS`, as planned; the seed is from the stream of its name."""

    name: str
    kind: str
    seed: int
    settings: Mapping[str, Any]
    inputs: Mapping[str, Path]


@dataclass(frozen=True)
class Work:
    """What a task gives.

    Parameters
    ----------
    numbers : mapping of str to object
        For the summary: numbers, words and yes or no, or mappings of them. The same on every
        machine with the same libraries, so no times. A posterior says ``converged``.
    files : mapping of str to str or bytes
        Content by relative name.
    """

    numbers: Mapping[str, Any]
    files: Mapping[str, str | bytes] = field(default_factory=dict)


class Kind[S: Section, I](ABC):
    """A kind of task, without state.

    Attributes
    ----------
    name : str
        Of its tables in a plan.
    section : type
        Schema of such a table.
    """

    name: ClassVar[str]
    section: type[S]

    @abstractmethod
    def plan(self, section: S, place: Place) -> Iterator[Planned]:
        """Yield the tasks of a table; `place` finds files beside the plan.

        Raises
        ------
        CalibError
            If the table asks for what there is not.
        """

    @abstractmethod
    def load(self, task: Task) -> I:
        """Read a task's inputs, here; what comes is pickled and sent to where the work is done."""

    @abstractmethod
    def work(self, item: I, seed: int) -> Work:
        """Do the work, in any process on any machine: from the item and the seed alone.

        Raises
        ------
        CalibError
            If it cannot be done; the task then counts as failed, and the others go on.
        """


def refuse_slow_simulators(models: Iterable[str], where: str, verb: str) -> None:
    """Refuse simulators that have to be emulated.

    Tasks are done side by side, each from its inputs alone, while the runs of a simulator are made
    and kept in one folder, for one process at a time.

    Raises
    ------
    CalibError
        Naming the first such model and the verb that can do it.
    """
    for model in models:
        found = slow_simulator(model)
        if found is not None:
            raise CalibError(
                f"the simulator {found.name} behind {model} has to be emulated, which the tasks of "
                "a campaign cannot do side by side", where=where,
                allowed="closed forms, and simulators with emulate = false",
                mend=f"use {verb}, which spreads the runs themselves over --workers",
            )  # fmt: skip
