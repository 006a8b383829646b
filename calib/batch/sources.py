"""What a program is: its file, what that imports from its own folder, and a function's state."""

from __future__ import annotations

import ast
import dis
import functools
import hashlib
import os
import pickle
import re
import sys
import sysconfig
from collections.abc import Iterator
from importlib.machinery import all_suffixes
from pathlib import Path
from types import CodeType, FunctionType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np

_DOTTED = re.compile(r"[^\W\d]\w*(?:\.\w+)*")
_PATH = re.compile(r"[\w.+-]+(?:/[\w.+-]+)*")
# Beside what has no ending and may be executed.
_PROGRAMS = {
    ".exe", ".jl", ".js", ".lua", ".m", ".pl", ".py", ".r", ".rb", ".sh", ".so", ".tcl",
}  # fmt: skip
_PLAIN = (int, float, complex, str, bytes, type(None), np.ndarray, np.generic)
# Python, installed packages and this one: their files are taken alone, without what they import.
_INSTALLED = (
    *(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib")),
    Path(__file__).resolve().parents[1],
)


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
            imports += [(text, 0)] if _DOTTED.fullmatch(text) else []
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
    each = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    if len(each) == 1:
        return each[0]
    folder = _own_folder(files[0])
    named = [f"{f.relative_to(folder).as_posix()} {s}" for f, s in zip(files, each, strict=True)]
    return hashlib.sha256("\n".join(named).encode()).hexdigest()


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
    for path in set(_PATH.findall(text)):
        parts = path.split("/")
        for i in range(len(parts)):
            file = folder.joinpath(*parts[i:])
            written = file.suffix.lower() in _PROGRAMS
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
            name: body for name, body in bodies.items()
            if (_plain(body) and not name.startswith("__"))
            or (isinstance(body, FunctionType) and not in_file)
        }  # fmt: skip
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
            alone = hashlib.sha256(path.read_bytes()).hexdigest() if _installed(path) else ""
            self.files[path] = alone or content_of(path)
        return True


def _installed(path: Path) -> bool:
    return any(path.is_relative_to(folder) for folder in _INSTALLED)


def _plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(_plain, value))
    return isinstance(value, _PLAIN)


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
