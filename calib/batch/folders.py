"""Output folders that appear whole or not at all, and what is finished before they do.

A command that is interrupted, or finds no room for its result at the end, has as a rule finished
something: posteriors of some of its models, say. Each is kept in memory as soon as it is there,
and other processes leave theirs in a folder.
"""

from __future__ import annotations

import errno
import json
import os
import pickle
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from calib.batch.constants import ROOM_BYTES, YOUNG_SECONDS
from calib.errors import CalibError

# The record of each kind of folder that may be replaced, and what it does not list of the rest.
_RECORDS: Mapping[str, tuple[str, ...]] = {
    "manifest.json": (),
    "run.json": (),
    "joint.json": (),
    "comparison.json": (),
    "diagnosis.json": (
        "document.json", "corrected.json", "fresh_prediction.csv", "inputs.json", "case",
        "emulators", "index.html", "figures",
    ),
    "review.json": ("index.html",),
    "audit.json": ("audit.csv", "index.html", "figures"),
    "score.txt": ("levels.png", "reliability_easy.png", "reliability_hard.png"),
}  # fmt: skip
# The disk is full, the quota used up, the file system read-only.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)

# Said to whom types commands, and to whom calls functions.
REPLACE = "choose another folder, or replace this one: --overwrite, in Python overwrite=True"

type Write = Callable[[Path], object]

# Folders that commands of this process have written, or what of theirs was rescued.
saved: list[Path] = []
# Scratch folders of results to be written by this process, and the lock of each.
_claims: dict[Path, tuple[Path, int | None]] = {}
# Where the work began for which a folder is claimed: code of a user's own may have gone elsewhere.
_began_in: list[Path] = []
# What is finished, by the name of the folder that it gets if its command does not write it.
_finished: dict[str, Write] = {}
# Where other processes leave what they finish, and whether this is one of them.
_parts: Path | None = None
_works_for_another = False


@contextmanager
def fresh_folder(out: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Yield a scratch folder that becomes `out` once the block succeeds.

    An existing folder is replaced if asked, and only one that was written by this package.

    Raises
    ------
    CalibError
        If `out` exists and may not be replaced, or cannot be written; or if another process wrote
        it while the block ran: then its name ends in a number.
    """
    if _began_in:
        os.chdir(_began_in[-1])
    out = _real(Path(out))
    claim = _claims.pop(out.absolute(), None)
    if claim is None:
        out = _replaceable(out, overwrite=overwrite)
    scratch, held = claim or _scratch(out)
    whole = scratch / "whole"
    try:
        (scratch / "reserved").unlink(missing_ok=True)
        whole.mkdir()
        yield whole
        if overwrite and out.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{out.name}-old-", dir=out.parent))
            out.replace(old / "old")
            whole.replace(out)
            shutil.rmtree(old)
        else:
            _put(whole, out)
        saved.append(out)
        if claim is not None:
            drop()
    except OSError as error:
        # NumPy says of a full disk itself what the system would, without its number.
        if error.errno not in (*NO_ROOM, None):
            raise
        raise _unwritable(out, error.strerror or str(error)) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        _release(held)


@contextmanager
def claimed(out: Path, *, overwrite: bool = False) -> Iterator[None]:
    """Keep a folder, which will be written at the end of long work, from other processes.

    What can be known before the work is found here: that the folder may not be written or replaced,
    that the disk is full, or that another process is about to write it. Room on the disk is
    reserved. What the work has finished (see `keep`) is rescued if the folder is not written.

    Raises
    ------
    CalibError
        As `fresh_folder` does, or if the folder is claimed already.
    """
    global _parts
    out = _replaceable(Path(out), overwrite=overwrite)
    with writing(out):
        living = out.parent.is_dir() and any(_is_alive(path) for path, _ in _scratches(out))
    if living:
        raise CalibError(
            "another process is working on this output folder",
            where=str(out),
            hint="wait until it ends, stop it, or choose another folder",
        )
    scratch, held = _claims[out.absolute()] = _scratch(out)
    try:
        with writing(out):
            _reserve(scratch / "reserved")
            _parts = scratch / "parts"
            _parts.mkdir()
        _began_in.append(Path.cwd())
        try:
            yield
        finally:
            os.chdir(_began_in.pop())
            _rescue(out)
    finally:
        # Written or not, nothing of it is needed any more.
        _parts = None
        _finished.clear()
        shutil.rmtree(scratch, ignore_errors=True)
        if _claims.pop(out.absolute(), None) is not None:
            _release(held)


def _reserve(path: Path) -> None:
    """Take the room that a result needs, where the system can."""
    with path.open("wb") as file, suppress(AttributeError):
        try:
            os.posix_fallocate(file.fileno(), 0, ROOM_BYTES)
        except OSError as error:
            if error.errno in NO_ROOM:
                raise


def _put(whole: Path, out: Path) -> None:
    """Give a folder its name; where another process has taken it meanwhile, one beside it."""
    with suppress(OSError):
        out.rmdir()  # an empty one
    try:
        whole.replace(out)
    except OSError as error:
        if not out.exists():
            raise
        beside = _free(out, first=2)
        whole.replace(beside)
        raise CalibError(
            "another process has written the output folder meanwhile",
            where=str(out),
            hint=f"look for the result of this one in {beside}",
        ) from error


def _free(path: Path, first: int = 1) -> Path:
    """Return the path, or with a number at its end the first that is not there."""
    names = (path if i == 1 else path.with_name(f"{path.name}-{i}") for i in count(first))
    return next(p for p in names if not p.exists())


def keep(name: str, write: Write) -> None:
    """Keep a result until its command has written it.

    Parameters
    ----------
    name : str
        Of the folder that it gets if the command does not.
    write : callable
        Writes it into an empty folder; can be pickled where other processes finish it.
    """
    if _parts is None:
        return
    if not _works_for_another:
        _finished[name] = write
        return
    with suppress(Exception):  # a copy in case of need: the result itself goes on its way
        part = _parts / f".{name}"
        part.write_bytes(pickle.dumps(write))
        part.replace(_parts / name)


def drop() -> None:
    """Forget what was kept: it is written."""
    _finished.clear()
    for path in [] if _parts is None else _parts.iterdir():
        path.unlink()


def parts() -> Path | None:
    """Return the folder for what other processes finish, if this one keeps it."""
    return _parts


def work_for(folder: Path | None) -> None:
    """Leave what is finished in this process for another in its folder, if it has one."""
    global _parts, _works_for_another
    _parts, _works_for_another = folder, True


def _rescue(out: Path) -> None:
    """Write what is kept beside an output folder, or else with temporary files."""
    found = dict(_finished)
    for path in [] if _parts is None else sorted(_parts.glob("[!.]*")):
        with suppress(Exception):  # of a process that was killed meanwhile
            found.setdefault(path.name, pickle.loads(path.read_bytes()))
    for parent in (out.parent, Path(tempfile.gettempdir())) if found else ():
        folder = _free(parent / f"{out.name}-unfinished")
        try:
            for name, write in found.items():
                (folder / name).mkdir(parents=True)
                write(folder / name)
        except BaseException as error:
            shutil.rmtree(folder, ignore_errors=True)
            if not isinstance(error, Exception):
                raise
        else:
            saved.append(folder)
            return


def _replaceable(out: Path, *, overwrite: bool) -> Path:
    """Check a folder that a result will take the place of; of a link the one that it names."""
    out = _real(out)
    check_folder(out, overwrite=overwrite)
    if os.path.ismount(out):
        raise CalibError(
            "the output folder is a mount point, which cannot be replaced",
            where=str(out),
            hint="choose a new folder inside it",
        )
    return out


def _real(out: Path) -> Path:
    """Return the folder that a link names, which is replaced; the link stays."""
    with writing(out):  # a name that is too long, a folder that may not be searched
        return out.resolve() if out.is_symlink() else out


def _scratch(out: Path) -> tuple[Path, int | None]:
    """Make the scratch folder of a result, and lock it; remove those of runs that were killed.

    The lock of a killed process is gone. Folders younger than a minute are left: their process may
    be about to lock them. An earlier result that was being replaced stays if it is the only one
    there is.
    """
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        for path, old in _scratches(out):
            if old and not out.exists():
                continue
            with suppress(OSError):
                if time.time() - path.stat().st_mtime < YOUNG_SECONDS:
                    continue
                held = lock(path)
                if held is not None:
                    shutil.rmtree(path, ignore_errors=True)
                    os.close(held)
        scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
        return scratch, lock(scratch)


def _scratches(out: Path) -> Iterator[tuple[Path, bool]]:
    """Yield the scratch folders of a result that are there, and whether each holds an old one."""
    pattern = re.compile(rf"\.{re.escape(out.name)}-(?P<old>old-)?[a-z0-9_]{{8}}")
    for path in out.parent.iterdir():
        match = pattern.fullmatch(path.name)
        if match is not None and path.is_dir():
            yield path, match["old"] is not None


def _is_alive(scratch: Path) -> bool:
    """Whether the process that made a scratch folder still runs."""
    try:
        _release(lock(scratch))
    except BlockingIOError:
        return True
    except OSError:  # gone meanwhile
        pass
    return False


def lock(folder: Path) -> int | None:
    """Lock a folder for as long as this process lives; None on a system or a disk that cannot.

    Raises
    ------
    BlockingIOError
        If another process holds the lock.
    """
    try:
        import fcntl
    except ImportError:
        return None
    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(held)
        if isinstance(error, BlockingIOError):
            raise
        return None
    return held


def _release(held: int | None) -> None:
    if held is not None:
        os.close(held)


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder that is there; the system releases it however the process ends.

    Raises
    ------
    CalibError
        If another process holds it.
    """
    with writing(folder):
        try:
            held = lock(folder)
        except BlockingIOError:
            raise CalibError(
                "another process is writing results to this folder",
                where=str(folder),
                hint="wait until it ends, or stop it",
            ) from None
    try:
        yield
    finally:
        _release(held)


def read_folder(folder: Path) -> dict[str, bytes]:
    """Return the content of every file below a folder, by its relative name."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file that is there whole or not at all, or as it was, whenever it is killed."""
    # Of a name of its own, for another process may write the same.
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content if isinstance(content, bytes) else content.encode())
        part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Say of an OSError within the block that a folder cannot be written."""
    try:
        yield
    except OSError as error:
        raise _unwritable(out, error.strerror or str(error)) from error


def _unwritable(out: Path, why: str) -> CalibError:
    return CalibError(
        f"the output cannot be written ({why})",
        where=str(out),
        hint="choose another folder, change its permissions, or make room",
    )


def check_room(out: Path, parent: Path | None = None) -> None:
    """Raise a CalibError, before long work, if a file or into a folder nothing can be written."""
    if parent is None:
        parent = out if out.is_dir() else _above(out)
    if not parent.is_dir():
        raise _unwritable(out, f"{parent} is a file")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise _unwritable(out, f"no permission to write in {parent}")
    left = shutil.disk_usage(parent).free
    if left < ROOM_BYTES:
        raise _unwritable(out, f"only {left / 1e6:.1f} MB are left on its disk")


def _above(out: Path) -> Path:
    return next(p for p in out.absolute().parents if p.exists())


def check_folder(out: Path, *, overwrite: bool = False) -> None:
    """Raise a CalibError, before long work, if a folder may not be written, or not replaced."""
    out = _real(out)
    with writing(out):
        exists = out.exists()

    def refuse(why: str, hint: str) -> CalibError:
        return CalibError(f"the output folder {why}", where=str(out), hint=hint)

    if exists and not out.is_dir():
        raise refuse("is an existing file", "choose another folder")
    if exists and out.resolve() == Path.cwd():
        raise refuse(
            "is the current folder, which cannot be replaced",
            "choose another folder, such as a new folder inside it",
        )
    check_room(out, _above(out))
    if not exists or not any(out.iterdir()):
        return
    if not overwrite:
        raise refuse("exists and is not empty", REPLACE)
    records = [name for name in _RECORDS if (out / name).exists()]
    if not records:
        raise refuse(
            "was not written by calib, so it is not replaced",
            "choose another folder, or delete the folder yourself",
        )
    written = {name for record in records for name in _written(out, record)}
    files = (p.relative_to(out) for p in sorted(out.rglob("*")) if not p.is_dir())
    others = [f.as_posix() for f in files if not {f.as_posix(), f.parts[0]} & written]
    if others:
        raise refuse(
            f"holds files that calib did not write: {', '.join(others[:5])}",
            "move them elsewhere, or choose another folder",
        )


def _written(out: Path, record: str) -> set[str]:
    """Return the files, and the folders, that a folder with a record was written with."""
    listed: set[str] = set()
    with suppress(OSError, ValueError, TypeError, AttributeError):  # damaged, it lists nothing
        content = json.loads((out / record).read_bytes())
        for key in ("files", "left_out", "sha256"):
            listed |= set(content.get(key, ()))
    return {record, *_RECORDS[record], *listed}
