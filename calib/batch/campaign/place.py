"""Files named in a plan: found beside it, and called by names that do not depend on the machine."""

from __future__ import annotations

import glob
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from calib.errors import CalibError


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
                    allowed=f"names and patterns such as *, relative to {self.folder}",
                    mend="correct it, or put the data there",
                )  # fmt: skip
            found |= dict.fromkeys(good)
        return list(found)

    def file(self, key: str, name: str) -> Path:
        """Return one file; a CalibError if there is none."""
        path = self.folder / name
        if not path.is_file():
            raise CalibError(
                f"there is no file {name!r}", where=f"{self.where}, {key}",
                allowed=f"a file, relative to {self.folder}", mend="correct the name",
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
