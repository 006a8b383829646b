"""Check files against their hashes, and that data and priors are what they are called."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from calib.batch.environment import sha256
from calib.check.outcome import Item, Status, claim
from calib.check.schema import TaskRecord
from calib.data import Table
from calib.data.labels import KNOWN_DATA, label_of
from calib.inference.prior_files import default_priors

GROUP, FILES = "data and priors", "files and their hashes"


def verify_files(
    folder: Path, own: str, listed: Mapping[str, str], *, more: Iterable[tuple[str, str]] = (),
    left_out: Iterable[str] = (),
) -> list[Item]:  # fmt: skip
    """Return an item for each file that is listed, by its SHA-256, or there.

    `own` lists them, and so has no hash; `more` hashes are said elsewhere in it, none where one is
    missed; what was left out is not there on purpose.
    """
    pairs = dict.fromkeys([*listed.items(), *more])
    items = [_listed(folder / name, own, name, expected) for name, expected in pairs]
    for name in left_out:
        if not name.endswith(".nc") or "/" in name:
            items.append(claim(FILES, name, "missing: only posteriors may be left out"))
    strangers = files_in(folder) - {own, *listed}
    return items + [claim(FILES, name, "not listed") for name in sorted(strangers)]


def files_in(folder: Path) -> set[str]:
    """Return the names of all files below a folder."""
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def _listed(path: Path, own: str, name: str, expected: str) -> Item:
    if not expected:
        return claim(GROUP, name, f"{own} has no hash of it")
    if not path.is_file():
        return claim(FILES, name, "missing")
    try:
        found = sha256(path.read_bytes())
    except OSError as error:
        return claim(FILES, name, f"cannot be read ({error.strerror})")
    if found != expected:
        return Item(FILES, name, Status.DIFFERENT, expected, found, note="changed")
    return Item(FILES, name, Status.IDENTICAL)


def verify_label(file: str, table: Table, label: str) -> Item:
    """Check that rows which are known are called what they are, and no others are."""
    known = label_of(table)
    right = KNOWN_DATA[known].words if known else "data of the user"
    wrong = f"called {label}, but not {KNOWN_DATA[label].words if label in KNOWN_DATA else 'that'}"
    if known:
        wrong = f"these are {right}, {known} and not measured, but not called so"
    return claim(GROUP, file, wrong if label != known else "", right)


def verify_priors(key: str, entry: TaskRecord, folder: Path, *, same_code: bool) -> Item:
    """Check that priors which are called the shipped ones are."""
    file, shipped = entry.priors.file, default_priors(entry.model)
    if not entry.priors.shipped:
        return claim(GROUP, file, "", f"priors of the user for {key}")
    same = (folder / file).read_bytes() == shipped.read_bytes()
    wrong = "" if same else f"not the {shipped.name} of this version"
    return claim(GROUP, file, wrong, f"the shipped {shipped.name}", sure=same_code)


def blame(items: Iterable[Item], file: str, wrong: str) -> list[Item]:
    """Name the input that some numbers cannot have been computed from, if most are different."""
    different = [i.status is Status.DIFFERENT for i in items if isinstance(i.recorded, float)]
    return [claim(GROUP, file, wrong)] if sum(different) > 0.5 * len(different) else []
