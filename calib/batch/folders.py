"""Output folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from calib.batch import foreign
from calib.errors import CalibError

# Files by which a folder is known to be one of ours, and may be replaced.
_OURS = ("manifest.json", "run.json", "diagnosis.json", "score.txt", "audit.json",
         "comparison.json")  # fmt: skip
_WRITTEN = (
    *_OURS, "index.html", "summary.json", "figures", "data", "priors", "gaps", "case",
    "corrected.json", "fresh_prediction.csv", "priors.toml", "data.csv", "tables", "methods.txt",
    "methods.tex", "references.bib", "audit.csv", "inputs.json", "runs", "emulator.npz",
    "emulators", "compared", "held_out.csv",
)  # fmt: skip

# Scratch folders of results to be written by this process: of each its lock.
_claimed: dict[Path, tuple[Path, int | None]] = {}
# Where the work began for which a folder is claimed: code of a user's own may have gone elsewhere.
_began_in: list[Path] = []
_YOUNG_SECONDS = 60.0
# In a scratch folder: the result, what other processes finish of it, and room for it.
_WHOLE, _PARTS, _RESERVED = "whole", "parts", "reserved"
# A folder with posteriors is of some megabytes; with less than this left it is not begun.
_ROOM_BYTES = 16_000_000
# The disk is full, the quota used up, the file system read-only.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)


def _is_ours(name: str) -> bool:
    return name in _WRITTEN or name.endswith((".nc", ".png"))


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
    claim = _claimed.pop(out.absolute(), None)
    if claim is None:
        out = _replaceable(out, overwrite=overwrite)
    scratch, held = claim or _scratch(out)
    whole = scratch / _WHOLE
    try:
        (scratch / _RESERVED).unlink(missing_ok=True)
        whole.mkdir()
        yield whole
        if overwrite and out.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{out.name}-old-", dir=out.parent))
            out.replace(old / "old")
            whole.replace(out)
            shutil.rmtree(old)
        else:
            _put(whole, out)
        foreign.saved.append(out)
        if claim is not None:
            foreign.drop()
    except OSError as error:
        # NumPy says of a full disk itself what the system would, without its number.
        if error.errno not in (*NO_ROOM, None):
            raise
        raise _unwritable(out, error.strerror or str(error)) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        if held is not None:
            os.close(held)


@contextmanager
def claimed(out: Path, *, overwrite: bool = False) -> Iterator[None]:
    """Keep a folder, which will be written at the end of long work, from other processes.

    What can be known before the work is found here: that it may not be written or replaced, that
    the disk is full, or that another process is about to write it. Room on the disk is reserved.
    What the work has finished is rescued (`calib.batch.foreign`) if it is not written.

    Raises
    ------
    CalibError
        As `fresh_folder` does, or if the folder is claimed already.
    """
    out = _replaceable(Path(out), overwrite=overwrite)
    with writing(out):
        living = out.parent.is_dir() and any(_is_alive(path) for path, _ in _scratches(out))
    if living:
        raise CalibError(
            "another process is working on this output folder",
            where=str(out),
            hint="wait until it ends, stop it, or choose another --out",
        )
    scratch, held = _claimed[out.absolute()] = _scratch(out)
    try:
        with writing(out):
            _reserve(scratch / _RESERVED)
        with foreign.working(scratch / _PARTS):
            _began_in.append(Path.cwd())
            try:
                yield
            finally:
                os.chdir(_began_in.pop())
                foreign.rescue(out)
    finally:
        # Written or not, nothing of it is needed any more.
        shutil.rmtree(scratch, ignore_errors=True)
        if _claimed.pop(out.absolute(), None) is not None and held is not None:
            os.close(held)


def _reserve(path: Path) -> None:
    """Take the room that a result needs, where the system can."""
    with path.open("wb") as file, contextlib.suppress(AttributeError):
        try:
            os.posix_fallocate(file.fileno(), 0, _ROOM_BYTES)
        except OSError as error:
            if error.errno in NO_ROOM:
                raise


def _replaceable(out: Path, *, overwrite: bool) -> Path:
    """Check a folder that a result will take the place of; of a link the one that it names."""
    out = _real(out)
    check_folder(out, overwrite=overwrite)
    if os.path.ismount(out):
        raise CalibError(
            "the output folder is a mount point, which cannot be replaced",
            where=str(out),
            hint="choose a new folder inside it as --out",
        )
    return out


def _real(out: Path) -> Path:
    """Return the folder that a link names, which is replaced; the link stays."""
    with writing(out):  # a name that is too long, a folder that may not be searched
        return out.resolve() if out.is_symlink() else out


def _scratch(out: Path) -> tuple[Path, int | None]:
    """Make the scratch folder of a result, and lock it."""
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(out)
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
        held = lock(scratch)
    except BlockingIOError:
        return True
    except OSError:  # gone meanwhile
        return False
    if held is not None:
        os.close(held)
    return False


def _put(scratch: Path, out: Path) -> None:
    """Give a folder its name; where another process has taken it meanwhile, one beside it."""
    with contextlib.suppress(OSError):
        out.rmdir()  # an empty one
    try:
        scratch.replace(out)
    except OSError as error:
        if not out.exists():
            raise
        beside = next(p for i in count(2) if not (p := out.with_name(f"{out.name}-{i}")).exists())
        scratch.replace(beside)
        raise CalibError(
            "another process has written the output folder meanwhile",
            where=str(out),
            hint=f"look for the result of this one in {beside}",
        ) from error


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
    found = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(found, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(found)
        if isinstance(error, BlockingIOError):
            raise
        return None
    return found


def _remove_abandoned(out: Path) -> None:
    """Remove the scratch folders of runs into `out` that were killed.

    The lock of a killed process is gone. Folders younger than a minute are left: their process
    may be about to lock them. An earlier result that was being replaced stays if it is the only
    one there is.
    """
    for path, old in _scratches(out):
        if old and not out.exists():
            continue
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime < _YOUNG_SECONDS:
                continue
            held = lock(path)
            if held is not None:
                shutil.rmtree(path, ignore_errors=True)
                os.close(held)


def read_folder(folder: Path) -> dict[str, bytes]:
    """Return the content of every file below a folder, by its relative name."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def write_whole(path: Path, text: str) -> None:
    """Write a file that is there whole or not at all, or as it was, whenever it is killed."""
    # Of a name of its own, for another process may write the same.
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    finally:
        with contextlib.suppress(OSError):
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
        hint="choose another --out, change its permissions, or make room",
    )


def check_room(out: Path) -> None:
    """Raise a CalibError, before long work, if a file or into a folder nothing can be written."""
    _check_place(out, out if out.is_dir() else _above(out))


def _above(out: Path) -> Path:
    return next(p for p in out.absolute().parents if p.exists())


def _check_place(out: Path, parent: Path) -> None:
    if not parent.is_dir():
        raise _unwritable(out, f"{parent} is a file")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise _unwritable(out, f"no permission to write in {parent}")
    left = shutil.disk_usage(parent).free
    if left < _ROOM_BYTES:
        raise _unwritable(out, f"only {left / 1e6:.1f} MB are left on its disk")


def check_folder(out: Path, *, overwrite: bool = False) -> None:
    """Raise a CalibError, before long work, if a folder may not be written, or not replaced."""
    out = _real(out)
    with writing(out):
        exists = out.exists()
    if not exists:
        _check_place(out, _above(out))
        return
    if not out.is_dir():
        raise CalibError(
            "the output folder is an existing file", where=str(out), hint="choose another --out"
        )
    if out.resolve() == Path.cwd():
        raise CalibError(
            "the output folder is the current folder, which cannot be replaced",
            where=str(out),
            hint="choose another --out, such as a new folder inside it",
        )
    _check_place(out, _above(out))
    if not any(out.iterdir()):
        return
    if not overwrite:
        raise CalibError(
            "the output folder exists and is not empty",
            where=str(out),
            hint="choose another --out, or pass --overwrite to replace it",
        )
    if not any((out / name).exists() for name in _OURS):
        raise CalibError(
            "the output folder was not written by calib, so it is not replaced",
            where=str(out),
            hint="choose another --out, or delete the folder yourself",
        )
    foreign = sorted(p.name for p in out.iterdir() if not _is_ours(p.name))
    if foreign:
        raise CalibError(
            f"the output folder holds files that calib did not write: {', '.join(foreign[:5])}",
            where=str(out),
            hint="move them elsewhere, or choose another --out",
        )
