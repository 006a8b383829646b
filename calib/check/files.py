"""Compare the files of a report folder with those that were made again from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from calib.batch.environment import sha256
from calib.check.compare import RECORD, SUMMARY, Again, is_document, part_of
from calib.check.derived import derived_files
from calib.check.figures import compare_figure, compare_pictures, compare_prints, thumbnails
from calib.check.items import Item, Status
from calib.check.montecarlo import MONTE_CARLO
from calib.check.numbers import SAME_WORDS
from calib.check.posteriors import GROUP as POSTERIORS
from calib.check.posteriors import compare_posterior
from calib.check.text import GROUP as TEXT
from calib.check.text import compare_page, own_pictures
from calib.check.tolerances import ORDER_OF_MAGNITUDE

# Below this part of what is allowed, or of itself, a number has only been rounded otherwise.
_ROUNDED = 1e-3
_ROUNDED_PART = 1e-6
_INPUTS = ("data/", "priors/")


@dataclass(frozen=True)
class Moved:
    """Parts of a report with entries that moved by more than rounding.

    Those in which words may turn on what moved; and those with other numbers: these, and where the
    work merely took other steps.
    """

    readings: frozenset[str]
    numbers: frozenset[str]


def moved_parts(items: list[Item]) -> Moved:
    """Return the parts of a report with entries that moved by more than rounding."""
    moved = [item for item in items if _moved(item)]
    steps = [item for item in moved if item.note in (ORDER_OF_MAGNITUDE, SAME_WORDS)]
    return Moved(
        frozenset(part_of(item.group) for item in moved if item not in steps),
        frozenset(part_of(item.group) for item in moved),
    )


def _moved(item: Item) -> bool:
    if item.status is Status.IDENTICAL:
        return False
    if not isinstance(item.recorded, float) or not isinstance(item.found, float):
        return True
    if abs(item.recorded - item.found) <= _ROUNDED_PART * abs(item.found):
        return False
    drawn = item.note == MONTE_CARLO
    return not drawn or item.share is None or item.share > _ROUNDED


def compare_files(again: Again, moved: Moved) -> list[Item]:
    """Return an item for each file but the manifest, the summary and what follows from them."""
    made = {p.relative_to(again.made).as_posix() for p in again.made.rglob("*") if p.is_file()}
    own = {RECORD, SUMMARY, *derived_files(dict.fromkeys(made, ""))}
    made = {n for n in made - own if not is_document(n) and not n.endswith("corrected.json")}
    pictures, prints = thumbnails(again.made), sorted(n for n in made if n.endswith(".pdf"))
    items = []
    for name in sorted(made - set(prints)):
        if name in again.manifest.left_out:
            items.append(_left_out(again.manifest.left_out[name], again, name))
        elif not (again.folder / name).is_file():
            items.append(_absent(again, name, "missing"))
        elif name.endswith(".nc"):
            items += compare_posterior(name, again.folder / name, again.made / name)
        elif name.endswith(".png"):
            old, new = ((folder / name).read_bytes() for folder in (again.folder, again.made))
            items.append(compare_figure(name, old, new, pictures))
        else:
            items += _text(again, name, moved)
    items += [_absent(again, n, "missing") for n in prints if not (again.folder / n).is_file()]
    there = [name for name in prints if (again.folder / name).is_file()]
    items += compare_prints(
        *({n: (folder / n).read_bytes() for n in there} for folder in (again.folder, again.made))
    )
    listed = set(again.manifest.files) - {SUMMARY, *derived_files(again.manifest.files)}
    strangers = sorted(n for n in listed - made if not (again.made / n).is_file())
    return items + [_absent(again, n, "this version makes no such file") for n in strangers]


def _absent(again: Again, name: str, note: str) -> Item:
    status = Status.DIFFERENT if again.same_program else Status.UNJUDGED
    return Item(TEXT, name, status, note=note)


def _text(again: Again, name: str, moved: Moved) -> list[Item]:
    def judged(section: str) -> tuple[str | None, bool]:
        if name.startswith(_INPUTS) or "/case/" in name:
            return None, True
        if not again.same_program:
            return "another version wrote it", False
        about = _about(again, name, section)
        why = "its numbers moved within their tolerance" if about & moved.readings else None
        return why, not about & moved.numbers

    items = [compare_page(name, again.folder, again.made, judged)]
    if name.endswith(".html") and items[0].status is not Status.IDENTICAL:
        folders = (again.folder, again.made)
        texts = [(f / name).read_text(encoding="utf-8", errors="replace") for f in folders]
        items += compare_pictures(name, *map(own_pictures, texts, folders))
    return items


def _about(again: Again, name: str, section: str) -> set[str]:
    """Return the parts of a report that a section of a page is about."""
    if name.startswith("gaps/"):
        return {f"gap: {name.split('/')[1]}"}
    tasks = set(again.manifest.tasks)
    gaps = {f"gap: {gap}" for gap in _names(again.manifest.sections.get("paper_gaps"))}
    parts: Mapping[str, set[str]] = {"paper-gaps": gaps, "audit": {"audit"}}
    return parts.get(section, {section} & tasks or tasks)


def _left_out(recorded: str, again: Again, name: str) -> Item:
    if sha256((again.made / name).read_bytes()) == recorded:
        note = "left out on purpose; made again, it has the recorded hash"
        return Item(POSTERIORS, name, Status.IDENTICAL, note=note)
    note = "left out on purpose; its summary is compared"
    return Item(POSTERIORS, name, Status.UNJUDGED, note=note)


def _names(record: object) -> list[str]:
    return list(record) if isinstance(record, dict) else []
