"""What a kind of campaign task is: its table in a plan, its tasks, and their work."""

from __future__ import annotations

import glob
import json
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

from calib.errors import CalibError
from calib.inference.emulation import Emulation
from calib.models import Model
from calib.models.simulators.registered import simulated_by
from calib.report.numbers import finite


@dataclass(frozen=True)
class Place:
    """Where a table of a plan stands: its folder, and plan and table for messages."""

    folder: Path
    where: str

    def find(self, key: str, patterns: Sequence[str], *, holding: str = "") -> list[Path]:
        """Return what some patterns match, each once, in the order of patterns and names.

        Patterns have ``*``, ``?``, ``[]`` and ``**``. Folders are wanted that hold a file, or files
        if none is named.

        Raises
        ------
        CalibError
            If a pattern matches nothing, naming the plan's key.
        """
        found: dict[Path, None] = {}
        for pattern in patterns:
            # Path.glob takes no absolute patterns.
            names = sorted(glob.glob(pattern, root_dir=self.folder, recursive=True))  # noqa: PTH207
            paths = [self.folder / name for name in names]
            good = [p for p in paths if ((p / holding) if holding else p).is_file()]
            if not good:
                wanted = f"folder with a {holding}" if holding else "file"
                raise CalibError(
                    f"no {wanted} is called {pattern!r}", where=f"{self.where}, {key}",
                    expected=f"names and patterns such as *, relative to {self.folder}",
                    hint="correct it, or put the data there",
                )  # fmt: skip
            found |= dict.fromkeys(good)
        return list(found)

    def file(self, key: str, name: str) -> Path:
        """Return one file; a CalibError if there is none."""
        path = self.folder / name
        if not path.is_file():
            raise CalibError(
                f"there is no file {name!r}", where=f"{self.where}, {key}",
                expected=f"a file, relative to {self.folder}", hint="correct the name",
            )  # fmt: skip
        return path

    @contextmanager
    def telling(self, key: str) -> Iterator[None]:
        """Say of what goes wrong inside at which key of the plan it was."""
        try:
            yield
        except CalibError as error:
            raise error.within(f"{self.where}, {key}") from None

    def name(self, path: Path) -> str:
        """Return a path as the plan would name it."""
        if path.is_relative_to(self.folder):
            return path.relative_to(self.folder).as_posix()
        return path.as_posix()

    def word(self, path: Path) -> str:
        """Return a path as a part of a task's name: its name in the plan without the suffix."""
        return word(self.name(path.with_suffix("") if path.is_file() else path))


def word(text: str) -> str:
    """Return a text as a part of a task's name."""
    joined = "-".join(part for part in text.split("/") if part not in ("", "."))
    return re.sub(r"[^A-Za-z0-9._+=-]+", "_", joined.replace("..", "up"))


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


EMULATION = "emulation.json"


@dataclass(frozen=True)
class Emulated:
    """What became of the simulator of a task's model: the emulator in its place, and how well.

    It is emulated where the campaign was started, as the runs of all tasks are kept in the
    simulator's one folder, for one process at a time; the model is sent to where the work is done.
    """

    model: Model
    documents: tuple[Mapping[str, Any], ...]

    @classmethod
    def of(cls, *emulations: Emulation) -> Emulated:
        """Put together what one task needs; the last emulation has the emulator."""
        model = emulations[-1].problem.bound.model
        return cls(model, tuple(e.document() for e in emulations))

    @property
    def passed(self) -> bool:
        """Whether the emulator is good enough."""
        return all(d["passed"] for d in self.documents)

    @property
    def numbers(self) -> dict[str, Any]:
        """Key numbers for the summary."""
        return {
            "runs": sum(d["runs"] for d in self.documents),
            "failed_runs": sum(len(d["failed"]) for d in self.documents),
            "passed": self.passed,
            "reasons": " | ".join(reason for d in self.documents for reason in d["reasons"]),
        }


def emulation_file(found: Iterable[Emulated]) -> str:
    """Return `EMULATION`: what is known of the emulations of a task, by model."""
    documents = {e.model.name: list(e.documents) for e in found}
    return json.dumps(finite(documents), indent=1) + "\n"


def simulators_of(models: Iterable[str]) -> dict[str, Any]:
    """Return what the results of a task depend on of simulators of the user's own."""
    found = {m: s.simulator.digest for m in models if (s := simulated_by(m)) is not None}
    return {"simulators": found} if found else {}
