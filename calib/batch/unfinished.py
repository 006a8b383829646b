"""Results that are finished before their command is: written if it does not come to do so itself.

A command that is interrupted, or finds no room for its result at the end, has as a rule finished
something: posteriors of some of its models, say. Each is kept here, in memory, as soon as it is
there; other processes leave theirs in a folder.
"""

from __future__ import annotations

import pickle
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

__all__ = ["drop", "keep", "place", "rescue", "saved", "work_for", "working"]

type Write = Callable[[Path], object]

# Folders that commands of this process have written, or what of theirs was rescued.
saved: list[Path] = []
_kept: dict[str, Write] = {}
_place: Path | None = None
_works_for_another = False


@contextmanager
def working(folder: Path) -> Iterator[None]:
    """Keep what is finished within the block; the folder, which is new, is for other processes."""
    global _place
    folder.mkdir()
    _place = folder
    try:
        yield
    finally:
        _place = None
        _kept.clear()


def work_for(folder: Path | None) -> None:
    """Leave what is finished in this process for another in its folder, if it has one."""
    global _place, _works_for_another
    _place, _works_for_another = folder, True


def place() -> Path | None:
    """Return the folder for other processes, if this one keeps what is finished."""
    return _place


def keep(name: str, write: Write) -> None:
    """Keep a result until its command has written it.

    Parameters
    ----------
    name : str
        Of the folder that it gets if the command does not.
    write : callable
        Writes it into an empty folder; can be pickled where other processes finish it.
    """
    if _place is None:
        return
    if not _works_for_another:
        _kept[name] = write
        return
    with suppress(Exception):  # a copy in case of need: the result itself goes on its way
        part = _place / f".{name}"
        part.write_bytes(pickle.dumps(write))
        part.replace(_place / name)


def drop() -> None:
    """Forget what was kept: it is written."""
    _kept.clear()
    for path in [] if _place is None else _place.iterdir():
        path.unlink()


def rescue(out: Path) -> Path | None:
    """Write what is kept beside an output folder, or else with temporary files; return where."""
    found = dict(_kept)
    for path in [] if _place is None else sorted(_place.glob("[!.]*")):
        with suppress(Exception):  # of a process that was killed meanwhile
            found.setdefault(path.name, pickle.loads(path.read_bytes()))
    if not found:
        return None
    for parent in (out.parent, Path(tempfile.gettempdir())):
        folder = _free(parent / f"{out.name}-unfinished")
        try:
            for name, write in found.items():
                (folder / name).mkdir(parents=True)
                write(folder / name)
        except BaseException as error:
            shutil.rmtree(folder, ignore_errors=True)
            if not isinstance(error, Exception):
                raise
            continue
        saved.append(folder)
        return folder
    return None


def _free(path: Path) -> Path:
    names = (path if i == 1 else path.with_name(f"{path.name}-{i}") for i in count(1))
    return next(p for p in names if not p.exists())
