"""Check files against their hashes, and that data and priors are what they are called."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from calib.batch.environment import sha256
from calib.check.outcome import Item, Status
from calib.check.schema import TaskRecord
from calib.data import Table
from calib.data.labels import KNOWN_DATA, label_of
from calib.inference.prior_files import default_priors

GROUP, FILES = "data and priors", "files and their hashes"


def verify_files(
    folder: Path, hashes: Mapping[str, str], own: str, left_out: Mapping[str, str]
) -> list[Item]:
    """Return one item for each file that is listed, by its SHA-256, or there.

    `own` holds the hashes, and so has none; what was left out is not there on purpose.
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
        return Item(FILES, name, Status.DIFFERENT, expected, found, note="changed")
    return Item(FILES, name, Status.IDENTICAL)


def _different(name: str, note: str) -> Item:
    return Item(FILES, name, Status.DIFFERENT, note=note)


def verify_hashes(key: str, entry: TaskRecord, folder: Path) -> list[Item]:
    """Check that an output's data and priors are the ones it says it was computed from."""
    return [
        Item(GROUP, file.file, Status.DIFFERENT, note=f"not what {key} was computed from")
        for file in (entry.data, entry.priors)
        if (folder / file.file).is_file()
        and sha256((folder / file.file).read_bytes()) != file.sha256
    ]


def verify_label(file: str, table: Table, label: str) -> Item:
    """Check that rows which are known are called what they are, and no others are."""
    known = label_of(table)
    if label == known:
        note = KNOWN_DATA[known].words if known else "data of the user"
        return Item(GROUP, file, Status.IDENTICAL, note=note)
    note = f"called {label}, but not {KNOWN_DATA[label].words if label in KNOWN_DATA else 'that'}"
    if known:
        note = f"these are {KNOWN_DATA[known].words}, {known} and not measured, but not called so"
    return Item(GROUP, file, Status.DIFFERENT, note=note)


def verify_priors(key: str, entry: TaskRecord, folder: Path, *, same_code: bool) -> Item:
    """Check that priors which are called the shipped ones are."""
    file = entry.priors.file
    if not entry.priors.shipped:
        return Item(GROUP, file, Status.IDENTICAL, note=f"priors of the user for {key}")
    shipped = default_priors(entry.model)
    if (folder / file).read_bytes() == shipped.read_bytes():
        return Item(GROUP, file, Status.IDENTICAL, note=f"the shipped {shipped.name}")
    status = Status.DIFFERENT if same_code else Status.UNJUDGED
    return Item(GROUP, file, status, note=f"not the {shipped.name} of this version")
