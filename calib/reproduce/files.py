"""Hold the files of a folder against their recorded hashes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from calib.manifest import sha256
from calib.reproduce.items import Item, Status

__all__ = ["GROUP", "verify_files"]

GROUP = "files and their hashes"


def verify_files(
    folder: Path, hashes: Mapping[str, str], own: str, left_out: Mapping[str, str]
) -> list[Item]:
    """Return one item for each file that is listed or there.

    Parameters
    ----------
    folder : Path
    hashes : mapping of str to str
        Relative path to SHA-256.
    own : str
        The file that holds the hashes, and so has none.
    left_out : mapping of str to str
        Files that are not there on purpose.
    """
    there = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} - {own}
    items = [_listed(folder, name, expected) for name, expected in hashes.items()]
    for name in left_out:
        if not name.endswith(".nc") or "/" in name:
            items.append(_different(name, "missing: only posteriors may be left out"))
    extra = sorted(there - set(hashes))
    return items + [_different(name, "not listed") for name in extra]


def _listed(folder: Path, name: str, expected: str) -> Item:
    path = folder / name
    if not path.is_file():
        return _different(name, "missing")
    try:
        found = sha256(path.read_bytes())
    except OSError as error:
        return _different(name, f"cannot be read ({error.strerror})")
    if found != expected:
        return Item(GROUP, name, Status.DIFFERENT, expected, found, note="changed")
    return Item(GROUP, name, Status.IDENTICAL)


def _different(name: str, note: str) -> Item:
    return Item(GROUP, name, Status.DIFFERENT, note=note)
