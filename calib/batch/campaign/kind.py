"""What the kinds of campaign task have in common: tables of a plan, tasks, slow simulators."""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from calib.batch.folders import read_folder
from calib.errors import CalibError
from calib.inference.emulation import Emulation
from calib.models import Model
from calib.models.simulators.declaration import simulated_by
from calib.report.numbers import finite


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
class Task:
    """A task of a plan: its name, kind and seed, the files it reads by the names to show.

    Settings are all else that decides the result; JSON can hold them.
    """

    name: str
    kind: str
    seed: int
    settings: Mapping[str, Any]
    inputs: Mapping[str, Path]


# A task's part of the name, settings and inputs.
type Planned = tuple[str, Mapping[str, Any], Mapping[str, Path]]
# Numbers for the summary, and files by relative name. The numbers are words, numbers and yes or no,
# or mappings of them, and the same on every machine with the same libraries, so no times. A
# posterior says ``converged``.
type Work = tuple[dict[str, Any], Mapping[str, str | bytes]]


@dataclass(frozen=True)
class Kind:
    """A kind of task: the schema of its tables in a plan, and what is done with one.

    `plan` yields the tasks of a table. `load` makes, where the campaign was started, the item that
    is pickled and sent to `work`, which is called with it and the seed on any machine.
    """

    section: type[Section]
    plan: Callable[[Any, Place], Iterator[Planned]]
    load: Callable[[Task], Any]
    work: Callable[[Any, int], Work]


@dataclass(frozen=True)
class Place:
    """Where a table of a plan stands: its folder, and plan and table for messages."""

    folder: Path
    where: str

    def find(self, key: str, patterns: Sequence[str], *, holding: str = "") -> list[Path]:
        """Return what some patterns match, each once, in the order of patterns and names.

        Patterns have ``*``, ``?``, ``[]`` and ``**``. Folders are wanted that hold a file, or files
        if none is named. A CalibError names the key of a pattern that matches nothing.
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
                    f"no {wanted} is called {pattern!r}",
                    where=f"{self.where}, {key}",
                    expected=f"names and patterns such as *, relative to {self.folder}",
                    hint="correct it, or put the data there",
                )
            found |= dict.fromkeys(good)
        return list(found)

    def file(self, key: str, name: str) -> Path:
        """Return one file; a CalibError if there is none."""
        path = self.folder / name
        if not path.is_file():
            raise CalibError(
                f"there is no file {name!r}",
                where=f"{self.where}, {key}",
                expected=f"a file, relative to {self.folder}",
                hint="correct the name",
            )
        return path

    @contextmanager
    def naming(self, key: str) -> Iterator[None]:
        """Name the key of the plan in errors from inside."""
        try:
            yield
        except CalibError as error:
            raise error.within(f"{self.where}, {key}") from None

    def name(self, path: Path) -> str:
        """Return a path as the plan would name it."""
        inside = path.is_relative_to(self.folder)
        return (path.relative_to(self.folder) if inside else path).as_posix()

    def word(self, path: Path) -> str:
        """Return a path as a part of a task's name: its name in the plan without the suffix."""
        return word(self.name(path.with_suffix("") if path.is_file() else path))


def word(text: str) -> str:
    """Return a text as a part of a task's name."""
    joined = "-".join(part for part in text.split("/") if part not in ("", "."))
    return re.sub(r"[^A-Za-z0-9._+=-]+", "_", joined.replace("..", "up"))


@dataclass(frozen=True)
class Emulated:
    """The emulator in the place of a task's slow simulator, and the records of its emulations.

    It is made where the campaign was started, as the runs of all tasks are kept in the simulator's
    one folder, for one process at a time. The model is sent to where the work is done.
    """

    model: Model
    documents: tuple[Mapping[str, Any], ...]

    @classmethod
    def of(cls, *emulations: Emulation) -> Emulated:
        """Put together what one task needs; the last emulation has the emulator."""
        model = emulations[-1].problem.bound.model
        return cls(model, tuple(e.document() for e in emulations))

    @property
    def numbers(self) -> dict[str, Any]:
        """Key numbers for the summary; whether the emulator is good enough."""
        return {
            "runs": sum(d["runs"] for d in self.documents),
            "failed_runs": sum(len(d["failed"]) for d in self.documents),
            "passed": all(d["passed"] for d in self.documents),
            "reasons": " | ".join(reason for d in self.documents for reason in d["reasons"]),
        }


def emulation_file(found: Iterable[Emulated]) -> dict[str, str]:
    """Return the file that says what is known of the emulations of a task, by model."""
    documents = {e.model.name: list(e.documents) for e in found}
    return {"emulation.json": json.dumps(finite(documents), indent=1) + "\n"}


def simulators_of(models: Iterable[str]) -> dict[str, Any]:
    """Return what the results of a task depend on of simulators of the user's own."""
    found = {m: s.simulator.digest for m in models if (s := simulated_by(m)) is not None}
    return {"simulators": found} if found else {}


def files_of(write: Callable[[Path], object]) -> dict[str, bytes]:
    """Return the files that a function writes into a folder."""
    with TemporaryDirectory() as scratch:
        write(Path(scratch))
        return read_folder(Path(scratch))
