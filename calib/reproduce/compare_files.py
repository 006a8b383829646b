"""Compare the files of a report folder with those that were made again from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from calib.environment import Environment
from calib.manifest import sha256
from calib.models.base import Array
from calib.reproduce.compare_documents import AUDIT, compare_document, gap_group, is_document
from calib.reproduce.derived import derived_files
from calib.reproduce.figures import compare_figure, compare_pictures, compare_print, thumbnails
from calib.reproduce.items import Item, Status
from calib.reproduce.posteriors import GROUP as POSTERIORS
from calib.reproduce.posteriors import compare_posterior
from calib.reproduce.schema import Manifest
from calib.reproduce.text import GROUP as TEXT
from calib.reproduce.text import compare_text, own_pictures, readable
from calib.study import Study

__all__ = ["PAGE", "RECORD", "SUMMARY", "Again", "compare_files"]

RECORD, SUMMARY, PAGE = "manifest.json", "summary.json", "index.html"


@dataclass(frozen=True)
class Again:
    """A report folder and the same made again.

    Parameters
    ----------
    manifest : Manifest
    folder, made : Path
        The report, and the one made again.
    study : Study
        What the second shows.
    here : Environment
    """

    manifest: Manifest
    folder: Path
    made: Path
    study: Study
    here: Environment

    @cached_property
    def same_program(self) -> bool:
        """Whether equal numbers must give equal files."""
        return self.manifest.environment.same_program(self.here)


def compare_files(again: Again, exact: Mapping[str, bool], best: Mapping[str, str]) -> list[Item]:
    """Return an item for each file but the manifest and the summary.

    Parameters
    ----------
    again : Again
    exact : mapping of str to bool
        Whether the numbers of an output, or of another part of the summary, are the same to the
        last bit.
    best : mapping of str to str
        The most probable hypothesis of each of the source's gaps.
    """
    made = {p.relative_to(again.made).as_posix() for p in again.made.rglob("*") if p.is_file()}
    made -= {RECORD, SUMMARY, *derived_files(dict.fromkeys(made, ""))}
    items, exact = _documents(again, made, exact, best)
    pictures = thumbnails(again.made)
    for name in sorted(name for name in made if not is_document(name)):
        items += _file(again, name, exact, pictures)
    status = Status.DIFFERENT if again.same_program else Status.UNJUDGED
    listed = set(again.manifest.files) - {SUMMARY, *derived_files(again.manifest.files)}
    return items + [
        Item(TEXT, name, status, note="this version makes no such file")
        for name in sorted(listed - made)
    ]


def _documents(
    again: Again, made: set[str], exact: Mapping[str, bool], best: Mapping[str, str]
) -> tuple[list[Item], dict[str, bool]]:
    """Compare the documents, and add to what is the same to the last bit."""
    found: list[Item] = []
    whole = dict(exact)
    for name in sorted(filter(is_document, made)):
        recorded = again.folder / name
        if not recorded.is_file():
            found.append(_missing(again, name))
            continue
        hypothesis = best[name.split("/")[1]] if name.startswith("gaps/") else ""
        items, same = compare_document(
            name, recorded, again.made / name, hypothesis, same_program=again.same_program
        )
        found += items
        key = _part(again, name) or name
        whole[key] = whole.get(key, True) and same
    return found, whole


def _missing(again: Again, name: str) -> Item:
    status = Status.DIFFERENT if again.same_program else Status.UNJUDGED
    return Item(TEXT, name, status, note="missing")


def _file(
    again: Again, name: str, exact: Mapping[str, bool], pictures: Mapping[str, Array]
) -> list[Item]:
    recorded, made = again.folder / name, again.made / name
    part = _part(again, name)
    same_numbers = all(exact.values()) if part is None else exact.get(part, False)
    strict = same_numbers and again.same_program
    if name in again.manifest.left_out:
        return [_left_out(again.manifest.left_out[name], made, name, strict=strict)]
    if not recorded.is_file():
        return [_missing(again, name)]
    if name.endswith(".nc"):
        return [compare_posterior(name, recorded, made, exact=strict)]
    old, new = recorded.read_bytes(), made.read_bytes()
    if name.endswith(".png"):
        return [compare_figure(name, old, new, pictures, exact=strict)]
    if name.endswith(".pdf"):
        return [compare_print(name, old, new, exact=strict)]
    if name.startswith(("data/", "priors/")) or "/case/" in name:
        strict = True
    why = "other draws" if not same_numbers else "another version wrote it"
    texts = [readable(old, again.folder), readable(new, again.made)]
    items = [compare_text(name, *texts, same=old == new, exact=strict, why_not=why)]
    if name.endswith(".html") and old != new:
        own = (own_pictures(old, again.folder), own_pictures(new, again.made))
        items += compare_pictures(name, *own, exact=strict)
    return items


def _part(again: Again, name: str) -> str | None:
    """Return whose numbers a file shows; None for those of all."""
    stem = name.removeprefix("figures/")
    if stem.startswith(("audit_", "audit.")):
        return AUDIT
    for gap in again.manifest.paper_gaps:
        if stem.startswith((f"gap_{gap}.", f"gaps/{gap}/")):
            return gap_group(gap)
    stem = name.rpartition("/")[2]
    found = (k for k in again.study.results if stem.startswith((f"{k}.", f"{k}_")))
    return next(found, None)


def _left_out(recorded: str, made: Path, name: str, *, strict: bool) -> Item:
    found = sha256(made.read_bytes())
    if found == recorded:
        note = "left out on purpose; made again, it has the recorded hash"
        return Item(POSTERIORS, name, Status.IDENTICAL, note=note)
    if strict:
        note = "left out; made again, it has another hash"
        return Item(POSTERIORS, name, Status.DIFFERENT, recorded, found, note=note)
    return Item(POSTERIORS, name, Status.UNJUDGED, note="left out on purpose; other draws")
