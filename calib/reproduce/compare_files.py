"""Compare the files of a report folder with those that were made again from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from calib.environment import Environment
from calib.manifest import sha256
from calib.models.base import Array
from calib.reproduce.figures import compare_figure, thumbnails
from calib.reproduce.items import Item, Status
from calib.reproduce.posteriors import GROUP as POSTERIORS
from calib.reproduce.posteriors import compare_posterior
from calib.reproduce.schema import Manifest
from calib.reproduce.text import GROUP as TEXT
from calib.reproduce.text import compare_text, readable
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


def compare_files(again: Again, exact: Mapping[str, bool]) -> list[Item]:
    """Return an item for each file but the manifest and the summary.

    Parameters
    ----------
    again : Again
    exact : mapping of str to bool
        Whether the numbers of an output, or of another part of the summary, are the same to the
        last bit.
    """
    made = {p.relative_to(again.made).as_posix() for p in again.made.rglob("*") if p.is_file()}
    made -= {RECORD, SUMMARY}
    pictures = thumbnails(again.made)
    items = [_file(again, name, exact, pictures) for name in sorted(made)]
    status = Status.DIFFERENT if again.same_program else Status.UNJUDGED
    listed = set(again.manifest.files) - {SUMMARY}
    return items + [
        Item(TEXT, name, status, note="this version makes no such file")
        for name in sorted(listed - made)
    ]


def _file(
    again: Again, name: str, exact: Mapping[str, bool], pictures: Mapping[str, Array]
) -> Item:
    recorded, made = again.folder / name, again.made / name
    output = next((key for key in again.study.results if _belongs(name, key)), None)
    same_numbers = all(exact.values()) if output is None else exact[output]
    strict = same_numbers and again.same_program
    if name in again.manifest.left_out:
        return _left_out(again.manifest.left_out[name], made, name, strict=strict)
    if not recorded.is_file():
        status = Status.DIFFERENT if again.same_program else Status.UNJUDGED
        return Item(TEXT, name, status, note="missing")
    if name.endswith(".nc"):
        return compare_posterior(name, recorded, made, exact=strict)
    if name.endswith(".png"):
        return compare_figure(
            name, recorded.read_bytes(), made.read_bytes(), pictures, exact=strict
        )
    if name.startswith(("data/", "priors/")):
        strict = True
    why = "other draws" if not same_numbers else "another version wrote it"
    old, new = (
        readable(path.read_bytes(), folder)
        for path, folder in ((recorded, again.folder), (made, again.made))
    )
    same = recorded.read_bytes() == made.read_bytes()
    return compare_text(name, old, new, same=same, exact=strict, why_not=why)


def _belongs(name: str, key: str) -> bool:
    stem = name.rpartition("/")[2]
    return stem.startswith((f"{key}.", f"{key}_"))


def _left_out(recorded: str, made: Path, name: str, *, strict: bool) -> Item:
    found = sha256(made.read_bytes())
    if found == recorded:
        note = "left out on purpose; made again, it has the recorded hash"
        return Item(POSTERIORS, name, Status.IDENTICAL, note=note)
    if strict:
        note = "left out; made again, it has another hash"
        return Item(POSTERIORS, name, Status.DIFFERENT, recorded, found, note=note)
    return Item(POSTERIORS, name, Status.UNJUDGED, note="left out on purpose; other draws")
