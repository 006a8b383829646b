"""User code run in isolation, and finished results kept until they are written.

A command that is interrupted, or finds no room for its result at the end, has as a rule finished
something: posteriors of some of its models, say. Each is kept here, in memory, as soon as it is
there; other processes leave theirs in a folder.
"""

from __future__ import annotations

import os
import pickle
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from importlib.machinery import PathFinder
from itertools import count
from pathlib import Path
from typing import Any

from calib.batch.threads import no_floating_point_errors
from calib.errors import CalibError

# Where a file, by the name of its module, was left by what runs when it is loaded: it may look for
# its own files there.
_left: dict[str, str] = {}


@contextmanager
def set_apart(*, keep_environment: bool = False) -> Iterator[None]:
    """Put back what the block changes of this process, and have it meet no errors of the caller's.

    That is the working directory, the search path for modules (what is new goes to its end, where
    it hides nothing), NumPy's handling of floating-point errors, the filters of warnings, and the
    environment unless it is to be kept. What would raise floating-point errors or warnings only
    warns, or is ignored; what is printed goes to the error output, for the other may be a file's
    content. Random numbers are left alone: a simulator may scatter, and calib's own
    come from streams of their own.
    """
    folder, searched, filters = _working_directory(), sys.path[:], list(warnings.filters)
    # As the system has it: to decode it would take longer than many a function.
    environment: Any = os.environ._data.copy()  # type: ignore[attr-defined]
    try:
        with ExitStack() as stack:
            stack.enter_context(no_floating_point_errors())
            stack.enter_context(redirect_stdout(sys.stderr))
            if any(one[0] == "error" for one in filters):
                stack.enter_context(warnings.catch_warnings())
                _set_filters([one for one in filters if one[0] != "error"])
                warnings.simplefilter("ignore", append=True)
            yield
    finally:
        with suppress(OSError):  # it is gone
            os.chdir(folder)
        sys.path[:] = searched + [path for path in sys.path if path not in searched]
        if warnings.filters != filters:
            _set_filters(filters)
        if not keep_environment and os.environ._data != environment:  # type: ignore[attr-defined]
            os.environ.clear()
            os.environ.update({os.fsdecode(k): os.fsdecode(v) for k, v in environment.items()})


def _set_filters(filters: Sequence[Any]) -> None:
    shown: Any = warnings.filters
    shown[:] = filters
    with warnings.catch_warnings():
        pass  # what was decided by others is forgotten


def _working_directory() -> str:
    try:
        return os.getcwd()  # noqa: PTH109
    except FileNotFoundError:
        return os.devnull


def call[**P, R](function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Call a function of a user's own, set apart."""
    with set_apart():
        left = _left.get(getattr(function, "__module__", None) or "")
        if left is not None:
            os.chdir(left)
        return function(*args, **kwargs)


@contextmanager
def loading(module: str, path: Path) -> Iterator[None]:
    """Load a file as a module, set apart; what lies beside it can be imported from now on."""
    _check_beside(path)
    before = _working_directory()
    with set_apart(keep_environment=True):
        if str(path.parent) not in sys.path:
            sys.path.append(str(path.parent))
        yield
        if (left := _working_directory()) != before:
            _left[module] = left


def beside(path: Path) -> dict[str, Path]:
    """Return the modules in a file's folder that it imports, or that these import, by name."""
    from calib.batch.sources import own_files

    files = own_files(path, named=False)[1:]
    packages = {f.parent.name: f for f in files if f.name == "__init__.py"}
    found = {f.stem: f for f in files if f.parent == path.parent and f.suffix == ".py"} | packages
    return {n: f for n, f in found.items() if path.parent in (f.parent, f.parent.parent)}


def _check_beside(path: Path) -> None:
    """Check that what a file imports from its folder is not hidden by something else.

    Raises
    ------
    CalibError
        If another module has the name, so that either would be taken for the other.
    """
    elsewhere = [one for one in sys.path if os.path.realpath(one) != str(path.parent)]
    for name, file in beside(path).items():
        known = sys.modules.get(name)
        spec = None if known is not None else PathFinder.find_spec(name, elsewhere)
        other = getattr(known or spec, "__file__" if known else "origin", None)
        if name in sys.builtin_module_names:
            other = "built into Python"
        if other is not None and os.path.realpath(other) != str(file):
            raise CalibError(
                f"it imports {name}, which is {file.relative_to(path.parent)} beside it, and "
                f"elsewhere too ({other})",
                where=str(path), expected="names of modules that there are once",
                hint="give the file beside it another name",
            )  # fmt: skip


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
