"""Python files of a user's own, run once in every process: they register what they declare."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from hashlib import sha256
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from calib.batch.foreign import loading
from calib.batch.sources import content_of, own_files
from calib.errors import CalibError

# Entry points of packages that register several things.
PLUGINS = "terracalib.plugins"
# What the names of modules begin with that were loaded by their paths.
USER_MODULE = "calib_user_"
_LOADED: set[str] = set()
# What was in the files of these modules when they were run.
_CONTENT: dict[str, str] = {}
# Code that is not calib's own, which may leave threads and files open.
_OTHERS: set[str] = set()
# Worker processes find here what this one has loaded.
_VARIABLE = "CALIB_MODELS"
_ORDER = {".toml": 1, ".npz": 2}


def run_file(path: Path, what: str) -> ModuleType:
    """Run a Python file as a module of its own, once, and again when it has changed.

    What it imports from its own folder is of it.

    Raises
    ------
    CalibError
        If it cannot be read, naming `what` it holds, or does not run, with the line.
    """
    # `Path.resolve` fails where a link leads to itself.
    path = Path(os.path.realpath(path))
    # Files of one name in two folders are two modules.
    name = f"{USER_MODULE}{path.stem}_{sha256(str(path).encode()).hexdigest()[:8]}"
    known = sys.modules.get(name)
    if known is not None and known.__file__ == str(path):
        if _CONTENT.get(name) == content_of(path):
            return known
        _forget(path)
    spec = importlib.util.spec_from_file_location(name, path)
    # `Path.is_file` fails where a name is too long for one.
    if not os.path.isfile(path) or spec is None or spec.loader is None:  # noqa: PTH113
        raise CalibError(
            f"the {what} cannot be read", where=str(path), expected="a Python file ending in .py",
            hint="give the path of such a file",
        )  # fmt: skip
    module = importlib.util.module_from_spec(spec)
    # Known by its name, so that what it defines can be handed to other processes.
    sys.modules[name] = module
    _OTHERS.add(name)
    _CONTENT[name] = content_of(path)
    try:
        with loading(name, path):
            spec.loader.exec_module(module)
    except CalibError as error:
        sys.modules.pop(name)
        # An effect names its file itself.
        raise error.within(None if str(path) in (error.where or "") else str(path)) from None
    except (Exception, SystemExit) as error:
        # A file that ends the program would end this one, and with success.
        sys.modules.pop(name)
        frames = traceback.extract_tb(error.__traceback__)
        lines = [f.lineno for f in frames if Path(f.filename).resolve() == path]
        at = f"{path}, line {lines[-1]}" if lines else str(path)
        raise CalibError(
            f"the file does not run: {type(error).__name__}: {error}", where=at, hint="correct it"
        ) from error
    return module


def _forget(path: Path) -> None:
    """Have modules of a file's own folder run anew when they are imported next."""
    files = own_files(path)
    names = [str(file) for file in files]
    for name, module in list(sys.modules.items()):
        if getattr(module, "__file__", None) in names:
            del sys.modules[name]
    for file in files:
        # Compiled code is told from that of another text by the size and the second alone.
        Path(importlib.util.cache_from_source(str(file))).unlink(missing_ok=True)


def load_files(paths: Sequence[Path]) -> None:
    """Load files that register things, here and in processes to come.

    Python files of quantities, models or effects; simulator files (``.toml``); emulators
    (``.npz``). In this order, for each kind may name what those before it register.

    Raises
    ------
    CalibError
        If one cannot be run, or what it declares does not hold together.
    """
    ordered = sorted(map(Path, paths), key=lambda path: _ORDER.get(path.suffix, 0))
    new = [str(path.resolve()) for path in ordered]
    for path in ordered:
        _load(path)
    if new:
        known = map(str, loaded_files())
        os.environ[_VARIABLE] = os.pathsep.join(dict.fromkeys([*known, *new]))


def others_loaded() -> bool:
    """Whether this process has run code that is not calib's own."""
    return bool(_OTHERS)


def loaded_files() -> list[Path]:
    """Return the files that this process has loaded, or was started with."""
    return [Path(p) for p in os.environ.get(_VARIABLE, "").split(os.pathsep) if p]


def inherit() -> None:
    """Load what the process that started this one had loaded."""
    load_files(loaded_files())


def dask_setup(worker: object) -> None:
    """Prepare a worker process on this machine; Dask calls it there.

    Ctrl-C, which a terminal sends to all processes, is for the one that owns the workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    inherit()


def _load(path: Path) -> None:
    # The batch layer lies below what these register.
    if path.suffix == ".toml":
        import_module("calib.models.simulators.files").register_file(path)
    elif path.suffix == ".npz":
        import_module("calib.models.simulators.emulator").use_emulator(path)
    else:
        run_file(path, "models")


def declared_in(declared: object) -> str:
    """Return the file of a user's function or class, or its module where that has no file.

    Nothing for calib's own, and for what is neither function nor class, unless it says so itself.
    """
    own = getattr(declared, "declared_in", "")
    if isinstance(own, str) and own:
        return own
    module = str(getattr(declared, "__module__", ""))
    if module.startswith("calib.") or not hasattr(declared, "__qualname__"):
        return ""
    return str(getattr(sys.modules.get(module), "__file__", None) or module)


def load_installed(group: str) -> None:
    """Load what installed packages declare as entry points of a group, once.

    A CalibError names the package of one that cannot be loaded.
    """
    if group in _LOADED:
        return
    _LOADED.add(group)
    for point in entry_points(group=group):
        if not point.value.startswith("calib."):
            _OTHERS.add(point.value)
        try:
            found = point.load()
        except (Exception, SystemExit) as error:
            package = point.dist.name if point.dist else "an installed package"
            raise CalibError(
                f"{point.name} of {package} cannot be loaded: {type(error).__name__}: {error}",
                where=f"entry point {group}",
                hint="update or remove the package",
            ) from error
        if hasattr(found, "register") and not isinstance(found, ModuleType):
            found.register()
