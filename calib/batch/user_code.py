"""Code of a user's own: files that register things, functions called in isolation, fingerprints.

A program is its file, what that imports from its own folder, and a function's state.
"""

from __future__ import annotations

import ast
import dis
import functools
import hashlib
import importlib.util
import os
import pickle
import re
import sys
import sysconfig
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from importlib.machinery import PathFinder, all_suffixes
from importlib.metadata import entry_points
from pathlib import Path
from types import CodeType, FunctionType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from calib.batch.environment import no_floating_point_errors, sha256
from calib.errors import CalibError

PLUGINS = "terracalib.plugins"  # entry points of packages that register several things
USER_MODULE = "calib_user_"  # what the names of modules begin with that were loaded by their paths

type Loader = Callable[[Path], object]

# Files that this process has loaded, and how; processes that it starts load them too.
_loaded: dict[Path, Loader] = {}
# What was in the files of these modules when they were run.
_content: dict[str, str] = {}
# Where a file, by the name of its module, went when it was loaded: it may look for its own files
# there.
_went: dict[str, str] = {}
# Groups of entry points that were loaded.
_groups: set[str] = set()


def load(files: Mapping[Path, Loader]) -> None:
    """Load files that register things, here and in processes to come."""
    for path, loader in files.items():
        loader(path)
        _loaded[Path(os.path.realpath(path))] = loader


def loaded() -> dict[Path, Loader]:
    """Return the files that this process has loaded, and how."""
    return dict(_loaded)


def run_file(path: Path, what: str = "models") -> ModuleType:
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
    name = f"{USER_MODULE}{path.stem}_{sha256(str(path).encode())[:8]}"
    known = sys.modules.get(name)
    if known is not None and known.__file__ == str(path):
        if _content.get(name) == content_of(path):
            return known
        _forget(path)
    spec = importlib.util.spec_from_file_location(name, path)
    # `Path.is_file` fails where a name is too long for one.
    if not os.path.isfile(path) or spec is None or spec.loader is None:  # noqa: PTH113
        raise CalibError(
            f"the {what} cannot be read",
            where=str(path),
            expected="a Python file ending in .py",
            hint="give the path of such a file",
        )
    _check_beside(path)
    module = importlib.util.module_from_spec(spec)
    # Known by its name, so that what it defines can be handed to other processes.
    sys.modules[name] = module
    _content[name] = content_of(path)
    before = _working_directory()
    try:
        with set_apart(keep_environment=True):
            # What lies beside it can be imported from now on.
            if str(path.parent) not in sys.path:
                sys.path.append(str(path.parent))
            spec.loader.exec_module(module)
            if (went := _working_directory()) != before:
                _went[name] = went
    except CalibError as error:
        sys.modules.pop(name)
        # An effect names its file itself.
        raise error.within(None if str(path) in (error.where or "") else str(path)) from None
    except (Exception, SystemExit) as error:
        # A file that ends the program would end this one, and with success.
        sys.modules.pop(name)
        frames = traceback.extract_tb(error.__traceback__)
        lines = [f.lineno for f in frames if Path(f.filename).resolve() == path]
        raise CalibError(
            f"the file does not run: {type(error).__name__}: {error}",
            where=f"{path}, line {lines[-1]}" if lines else str(path),
            hint="correct it",
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


def _check_beside(path: Path) -> None:
    """Refuse modules beside a file that it imports, whose names something else has too."""
    folder = path.parent
    beside = own_files(path, named=False)[1:]
    modules = {f.stem: f for f in beside if f.parent == folder and f.suffix == ".py"} | {
        f.parent.name: f
        for f in beside
        if f.name == "__init__.py" and folder in (f.parent, f.parent.parent)
    }
    elsewhere = [one for one in sys.path if os.path.realpath(one) != str(folder)]
    for name, file in modules.items():
        known = sys.modules.get(name)
        spec = None if known is not None else PathFinder.find_spec(name, elsewhere)
        other = getattr(known or spec, "__file__" if known else "origin", None)
        if name in sys.builtin_module_names:
            other = "built into Python"
        if other is not None and os.path.realpath(other) != str(file):
            raise CalibError(
                f"it imports {name}, which is {file.relative_to(folder)} beside it, and elsewhere "
                f"too ({other})",
                where=str(path),
                expected="names of modules that there are once",
                hint="give the file beside it another name",
            )


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
    if group in _groups:
        return
    _groups.add(group)
    for point in entry_points(group=group):
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


def call[**P, R](function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Call a function of a user's own, set apart."""
    with set_apart():
        went = _went.get(getattr(function, "__module__", None) or "")
        if went is not None:
            os.chdir(went)
        return function(*args, **kwargs)


@contextmanager
def set_apart(*, keep_environment: bool = False) -> Iterator[None]:
    """Put back what the block changes of this process, and keep the caller's errors from it.

    That is the working directory, the search path for modules (what is new goes to its end, where
    it hides nothing), NumPy's handling of floating-point errors, the filters of warnings, and the
    environment unless it is to be kept. Where floating-point errors or warnings would raise, they
    only warn or are ignored. What is printed goes to the error output, for the other may be a
    file's content. Random numbers are left alone: a simulator may scatter, and calib's own come
    from streams of their own.
    """
    folder, searched, filters = _working_directory(), sys.path[:], list(warnings.filters)
    environment = os.environ.copy()
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
        if not keep_environment and os.environ != environment:
            os.environ.clear()
            os.environ.update(environment)


def _set_filters(filters: Sequence[Any]) -> None:
    # Not by `catch_warnings` around every call, after which a warning would be shown each time.
    shown: Any = warnings.filters
    shown[:] = filters
    with warnings.catch_warnings():
        pass  # what was decided by others is forgotten


def _working_directory() -> str:
    try:
        return os.getcwd()  # noqa: PTH109
    except FileNotFoundError:
        return os.devnull


def own_files(path: Path, *, named: bool = True) -> tuple[Path, ...]:
    """Return a program's file and what it imports from its own folder or package, and so on.

    Of Python files that is what they import, wherever it stands in them. What is only `named` in
    these and in scripts of a shell counts as well: modules, and programs beside them.
    """
    path = path.resolve()
    folder = _own_folder(path)
    found, left = {path}, [path]
    while left:
        this = left.pop()
        imports, texts = _read(this)
        new: set[Path] = set()
        for text in texts if named else ():
            new.update(_programs(this.parent, text))
            imports += [(text, 0)] if re.fullmatch(r"[^\W\d]\w*(?:\.\w+)*", text) else []
        for name, up in imports:
            around = {path.parent, this.parent, folder.parent}
            for root in {this.parents[up - 1]} if up else around:
                new.update(_modules(root, name.split(".")))
        new = {file for file in new - found if file.is_relative_to(folder)}
        found |= new
        left += new
    return (path, *sorted(found - {path}))


def content_of(path: Path) -> str:
    """Return a SHA-256 of a program's file and all that it imports from its own folder."""
    files = own_files(path)
    each = [sha256(file.read_bytes()) for file in files]
    if len(each) == 1:
        return each[0]
    folder = _own_folder(files[0])
    named = [f"{f.relative_to(folder).as_posix()} {s}" for f, s in zip(files, each, strict=True)]
    return sha256("\n".join(named).encode())


def fingerprint(value: Any) -> str:
    """Return a SHA-256 of what a function or object does, as far as its code and state tell.

    Of a function: its code and the whole file, what that imports from its own folder, what it
    closes over, its defaults, and the names it uses where these are in no file; of an object its
    class and its state. Equal in every process.

    Raises
    ------
    ValueError
        If something of it cannot be pickled, naming what.
    """
    pickler = _Fingerprint()
    try:
        pickler.dump(value)
    except Exception as error:  # whatever a user's own class raises as it is pickled
        raise ValueError(f"{type(error).__name__}: {error}") from None
    for content in sorted(pickler.files.values()):
        pickler.sha.update(content.encode())
    return pickler.sha.hexdigest()


def _own_folder(path: Path) -> Path:
    """Return the folder of a file, or that of the whole package it is in."""
    folder = path.parent
    while all((f / "__init__.py").is_file() for f in (folder, folder.parent)):
        folder = folder.parent
    return folder


def _read(path: Path) -> tuple[list[tuple[str, int]], list[str]]:
    """Return what a file may import, as names and how many folders up they begin, and its texts."""
    try:
        content = path.read_bytes()
        shebang = content.split(b"\n", 1)[0] if content[:2] == b"#!" else b""
        if path.suffix not in (".py", ".pyw") and b"python" not in shebang:
            return [], [content.decode(errors="replace")] if shebang or path.suffix == ".sh" else []
        nodes = list(ast.walk(ast.parse(content)))
    except (OSError, SyntaxError, ValueError, RecursionError):
        return [], []
    imports, texts = [], []
    for node in nodes:
        if isinstance(node, ast.Import):
            imports += [(alias.name, 0) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = f"{node.module}." if node.module else ""
            imports += [(f"{base}{alias.name}", node.level) for alias in node.names]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts.append(node.value)
    return imports, texts


def _modules(root: Path, parts: list[str]) -> Iterator[Path]:
    """Yield the files of a dotted name below a folder, those of the packages on the way too."""
    for i, part in enumerate(parts):
        at = root.joinpath(*parts[:i])
        there = (*(at / f"{part}{suffix}" for suffix in all_suffixes()), at / part / "__init__.py")
        yield from (file.resolve() for file in there if file.is_file())


def _programs(folder: Path, text: str) -> Iterator[Path]:
    """Yield the programs below a folder that a text names, as a path or the end of one."""
    for path in set(re.findall(r"[\w.+-]+(?:/[\w.+-]+)*", text)):
        parts = path.split("/")
        for i in range(len(parts)):
            file = folder.joinpath(*parts[i:])
            written = re.fullmatch(r"\.(exe|jl|js|lua|m|pl|py|r|rb|sh|so|tcl)", file.suffix.lower())
            built = not file.suffix and os.access(file, os.X_OK)
            if (written or built) and file.is_file():
                yield file.resolve()


class _Fingerprint(pickle._Pickler):
    """Pickles into a hash: functions and classes by what they are, not by their names.

    It is the pickler in Python, as that in C asks nobody about sets, whose order is the process's.
    """

    def __init__(self) -> None:
        self.sha = hashlib.sha256()
        self.files: dict[Path, str] = {}
        self._met: dict[int, tuple[int, Any]] = {}
        super().__init__(SimpleNamespace(write=self.sha.update), protocol=4)
        # Without a memo equal values give equal bytes, whether or not they are the same object.
        self.fast = True

    def reducer_override(self, value: Any) -> Any:
        """Describe what would be pickled by its name, or in no order."""
        if isinstance(value, set | frozenset):
            return repr, (sorted(map(fingerprint, value)),)
        if isinstance(value, functools._lru_cache_wrapper):
            return repr, (value.__wrapped__,)
        if not isinstance(value, FunctionType | type | ModuleType):
            return NotImplemented
        if id(value) in self._met:
            return repr, (self._met[id(value)][0],)
        self._met[id(value)] = len(self._met), value
        if isinstance(value, ModuleType):
            self._note(getattr(value, "__file__", None))
            return repr, (value.__name__,)
        if isinstance(value, type):
            return repr, (self._of_class(value),)
        return repr, (self._of_function(value),)

    def _of_class(self, value: type) -> tuple[Any, ...]:
        file = getattr(sys.modules.get(value.__module__), "__file__", None)
        in_file = self._note(file)
        if in_file and _installed(Path(str(file)).resolve()):
            return value.__module__, value.__qualname__
        bodies = {k: getattr(v, "__func__", getattr(v, "fget", v)) for k, v in vars(value).items()}
        own = {
            name: body
            for name, body in bodies.items()
            if (_plain(body) and not name.startswith("__"))
            or (isinstance(body, FunctionType) and not in_file)
        }
        return value.__qualname__, value.__bases__, own

    def _of_function(self, value: FunctionType) -> tuple[Any, ...]:
        code = value.__code__
        state = [value.__qualname__, value.__defaults__, value.__kwdefaults__, vars(value)]
        for cell in value.__closure__ or ():
            try:
                state.append(cell.cell_contents)
            except ValueError:  # not yet set
                state.append(None)
        in_file = self._note(code.co_filename)
        if in_file and _installed(Path(code.co_filename).resolve()):
            return (*state, value.__module__)
        used = {name: value.__globals__.get(name) for name in sorted(set(_globals_of(code)))}
        if in_file:
            # The file has them; those that were changed from elsewhere count as they are now.
            used = {n: v for n, v in used.items() if _plain(v) or isinstance(v, FunctionType)}
        return (*state, _code(code), used)

    def _note(self, name: str | None) -> bool:
        """Note the content of a file; return whether there is one."""
        path = Path(name or "").resolve()
        if not path.is_file():
            return False
        if path not in self.files:
            alone = sha256(path.read_bytes()) if _installed(path) else ""
            self.files[path] = alone or content_of(path)
        return True


@functools.cache
def _installed(path: Path) -> bool:
    """Whether a file belongs to Python, an installed package or this one: not the user's."""
    places = map(sysconfig.get_path, ("stdlib", "platstdlib", "purelib"))
    own = Path(__file__).resolve().parents[1]
    return any(path.is_relative_to(f) for f in (*(Path(p).resolve() for p in places), own))


def _plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(_plain, value))
    return isinstance(value, int | float | complex | str | bytes | None | np.ndarray | np.generic)


def _code(code: CodeType) -> tuple[Any, ...]:
    inner = [_code(c) if isinstance(c, CodeType) else c for c in code.co_consts]
    return code.co_code, code.co_names, code.co_varnames, code.co_freevars, inner


def _globals_of(code: CodeType) -> Iterator[str]:
    for step in dis.get_instructions(code):
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            yield step.argval
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _globals_of(inner)
