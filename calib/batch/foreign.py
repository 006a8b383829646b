"""Code of a user's own: run so that the program around it stays as it is."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from calib.batch.sources import own_files
from calib.batch.threads import no_floating_point_errors
from calib.errors import CalibError

__all__ = ["beside", "call", "loading", "set_apart"]

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
                where=str(path), allowed="names of modules that there are once",
                mend="give the file beside it another name",
            )  # fmt: skip
