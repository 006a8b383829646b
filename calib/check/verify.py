"""Check what a folder says of itself, and which kind it is, without computing anything again.

Files against their hashes; that data and priors are what they are called; that texts, pictures of a
page and what a summary says of gaps follow from other files; that a corrected model predicts what
the diagnosis says of it.
"""

from __future__ import annotations

import base64
import binascii
import difflib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from calib.batch.environment import differs_in_lines, sha256, unix_lines
from calib.check.outcome import LINE_ENDS, Item, Status, claim
from calib.data import Table
from calib.data import files as data_files
from calib.data.files import decoded, inside
from calib.data.quantities import OUTPUTS
from calib.data.reader import KNOWN_DATA, label_of
from calib.errors import FAULTS, CalibError
from calib.gap.files import mispredicted, misquoted
from calib.inference.io import (
    Entry,
    File,
    Hash,
    KnownModel,
    Name,
    Record,
    RunRecord,
    read_record,
)
from calib.inference.prior_files import default_priors
from calib.report.comparison import FOLDER as COMPARED
from calib.report.comparison import ComparisonRecord
from calib.report.sections import SECTIONS
from calib.report.study import HoldOut

MANIFEST, SUMMARY, AUDIT = "manifest.json", "summary.json", "audit.json"


class _Kept(Entry):
    file: File
    sha256: Hash


class _Data(_Kept):
    source: str
    source_sha256: Hash
    # Where it is not that of the file that is kept: messages and units of the page are by it.
    header: tuple[str, ...] = ()
    ignored: tuple[str, ...]


class _PriorFile(_Kept):
    source: Name
    shipped: bool


class TaskRecord(Entry):
    """One output of a report: model, rows held out, data and priors."""

    model: KnownModel
    held_out: HoldOut | None
    label: str
    data: _Data
    priors: _PriorFile


class Manifest(Record):
    """`manifest.json` of a report folder."""

    FILE, kind, WRITTEN_BY = MANIFEST, "report", "calib report"
    schema_: Literal["calib/manifest/2"] = Field(alias="schema")
    title: str
    command: tuple[str, ...]
    tasks: Annotated[dict[str, TaskRecord], Field(min_length=1)]
    pdf: bool = False
    views: bool = True
    files: dict[File, Hash]
    left_out: dict[File, Hash]

    @property
    def sections(self) -> dict[str, Any]:
        """What it says of the sections that are known here."""
        return {name: self.document[name] for name in SECTIONS if name in self.document}

    @model_validator(mode="after")
    def _check(self) -> Self:
        if unknown := self.tasks.keys() - OUTPUTS.keys():
            raise ValueError(f"tasks: there is no output {', '.join(unknown)}")
        for name, record in self.sections.items():
            try:
                SECTIONS[name].again(record)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return self


def read_folder(folder: Path) -> Record:
    """Read what a folder says of itself; a CalibError if it is none that can be checked."""
    kinds: tuple[type[Record], ...] = (Manifest, RunRecord, ComparisonRecord)
    why = f"no {', '.join(kind.FILE for kind in kinds)} in it"
    for kind in kinds:
        if (folder / kind.FILE).is_file():
            try:
                return read_record(kind, folder)
            except CalibError:
                # A folder of `calib sbc` has a run.json as well, which is no record of a run.
                why = "it is one of `calib sbc`"
                if not (folder / "sbc.json").is_file():
                    raise
    raise CalibError(
        f"this is no folder that can be checked ({why})", where=str(folder),
        expected="a folder written by `calib report`, `calib fit` or `calib compare`",
        hint="give such a folder; of a diagnosis `calib diagnose FOLDER/case` makes the same again",
    )  # fmt: skip


TEXT = "page and tables"
_IMAGE = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=]*)")
_SHOWN, _WIDTH = 6, 120


def read_text(path: Path) -> str:
    """Return a text, whatever somebody made of it."""
    return decoded(path.read_bytes(), "replace")


def differing_lines(old: Sequence[str], new: Sequence[str]) -> str:
    """Return how many lines two texts do not share, and the first of them."""
    diff = list(difflib.unified_diff(old, new, n=0, lineterm=""))[2:]  # below the two names
    changed = [line for line in diff if not line.startswith("@@")]
    shown = "; ".join(f"{line[0]} {line[1:].strip()[:_WIDTH]}" for line in changed[:_SHOWN])
    return f"{len(changed)} lines differ: {shown}"


INPUTS, FILES = "data and priors", "files and their hashes"


def files(
    folder: Path, own: str, listed: Mapping[str, str], *, more: Iterable[tuple[str, str]] = (),
    left_out: Iterable[str] = (),
) -> list[Item]:  # fmt: skip
    """Return an item for each file that is listed, by its SHA-256, or there.

    `own` lists them, and so has no hash; `more` hashes are said elsewhere in it, none where one is
    missed; what was left out is not there on purpose.
    """
    pairs = dict.fromkeys([*listed.items(), *more])
    wrong = "missing: only posteriors may be left out"
    return [
        *(_listed(folder / name, own, name, expected) for name, expected in pairs),
        *(claim(FILES, n, wrong) for n in left_out if not n.endswith(".nc") or "/" in n),
        *(claim(FILES, n, "not listed") for n in sorted(files_in(folder) - {own, *listed})),
    ]


def files_in(folder: Path) -> set[str]:
    """Return the names of all files below a folder."""
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def _listed(path: Path, own: str, name: str, expected: str) -> Item:
    if not expected:
        return claim(INPUTS, name, f"{own} has no hash of it")
    if not path.is_file():
        return claim(FILES, name, "missing")
    try:
        content = path.read_bytes()
    except OSError as error:
        return claim(FILES, name, f"cannot be read ({error.strerror})")
    if (found := sha256(content)) != expected:
        if differs_in_lines(content, expected):
            return Item(FILES, name, Status.WITHIN, note=LINE_ENDS)
        return Item(FILES, name, Status.DIFFERENT, expected, found, note="changed")
    return Item(FILES, name, Status.IDENTICAL)


def verify_images(page: str, folder: Path) -> list[Item]:
    """Check that every picture in a page is one of the folder's figures, and the other way."""
    figures = _figures(folder)
    shown = {sha256(_decoded(text)) for text in _IMAGE.findall(page)}
    wrong = "it is not the picture that index.html shows"
    items = [claim(TEXT, n, wrong) for key, n in figures.items() if key not in shown]
    if strangers := len(shown - set(figures)):
        wrong = f"{strangers} of its pictures are none of the figures"
        items.append(claim(TEXT, "index.html", wrong))
    return items or [claim(TEXT, "pictures in index.html", "", "they are the figures")]


def _figures(folder: Path) -> dict[str, str]:
    """Names of the PNG files of a folder by their hashes; a comparison in it has its own page."""
    names = (path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*.png")))
    return {sha256((folder / n).read_bytes()): n for n in names if not n.startswith(f"{COMPARED}/")}


def _decoded(encoded: str) -> bytes:
    try:
        return base64.b64decode(encoded, validate=True)
    except binascii.Error:
        return b""


def own_pictures(content: str, folder: Path) -> list[bytes]:
    """Return the pictures of a page that are none of the folder's figures, in their order."""
    pictures = [_decoded(encoded) for encoded in _IMAGE.findall(content)]
    known = _figures(folder) if pictures else {}
    return [picture for picture in pictures if sha256(picture) not in known]


def named_pictures(folder: Path, name: str) -> str:
    """Return a page with the names of the folder's figures in the place of the pictures."""
    text = read_text(folder / name)
    names = _figures(folder) if _IMAGE.search(text) else {}

    def named(match: re.Match[str]) -> str:
        return f"[picture {names.get(sha256(_decoded(match[1])), 'of its own')}]"

    return _IMAGE.sub(named, text)


def label(file: str, table: Table, label: str) -> Item:
    """Check that rows which are known are called what they are, and no others are."""
    known = label_of(table)
    right = KNOWN_DATA[known].words if known else "data of the user"
    wrong = f"called {label}, but not {KNOWN_DATA[label].words if label in KNOWN_DATA else 'that'}"
    if known:
        wrong = f"these are {right}, {known} and not measured, but not called so"
    return claim(INPUTS, file, wrong if label != known else "", right)


def priors(key: str, entry: TaskRecord, folder: Path, *, same_code: bool) -> Item:
    """Check that priors which are called the shipped ones are."""
    file, shipped = entry.priors.file, default_priors(entry.model)
    if not entry.priors.shipped:
        return claim(INPUTS, file, "", f"priors of the user for {key}")
    same = unix_lines((folder / file).read_bytes()) == unix_lines(shipped.read_bytes())
    wrong = "" if same else f"not the {shipped.name} of this version"
    return claim(INPUTS, file, wrong, f"the shipped {shipped.name}", sure=same_code)


def blame(items: Iterable[Item], file: str, wrong: str) -> list[Item]:
    """Name the input that some numbers cannot have been computed from, if most are different."""
    different = [i.status is Status.DIFFERENT for i in items if isinstance(i.recorded, float)]
    return [claim(INPUTS, file, wrong)] if sum(different) > 0.5 * len(different) else []


def derived_files(names: Iterable[str]) -> set[str]:
    """Return those of a report's files that are made from others."""
    others = {"references.bib", "audit.csv"}
    return {n for n in names if n.startswith(("tables/", "methods.")) or n in others}


def derived(
    folder: Path, files: Iterable[str], writers: Mapping[str, Callable[[], Mapping[str, str]]], *,
    sure: bool,
) -> list[Item]:  # fmt: skip
    """Write texts again from what they follow from, by the name of that, and compare the bytes.

    Another version than the one that wrote them may word them otherwise: then it is not `sure`.
    """
    failed, found = [], dict[str, Item]()
    for source, write in writers.items():
        try:
            for name, text in write().items():
                wrong, path = "", folder / name
                if not path.is_file():
                    wrong = f"missing, though {source} gives it"
                elif unix_lines(path.read_bytes()) != text.encode():
                    lines = differing_lines(read_text(path).splitlines(), text.splitlines())
                    wrong = f"it does not follow from {source}: {lines}"
                found[name] = claim(TEXT, name, wrong, f"it follows from {source}", sure=sure)
        except Exception as error:  # whatever somebody else's record makes the writer raise
            wrong = f"what follows from it cannot be written ({type(error).__name__}: {error})"
            failed.append(claim(TEXT, source, wrong, sure=sure))
    for name in derived_files(files) - set(found) if not failed else ():
        found[name] = claim(TEXT, name, "it follows from nothing here", sure=sure)
    return failed + [found[name] for name in sorted(found)]


def form(folder: Path) -> list[Item]:
    """Check that documents are in the form they are written in.

    Of two equal keys a machine reads the last, and a person may see the first.
    """
    wrong = "not in the form it is written in: repeated keys, or edited by hand"
    found = []
    for path in sorted(folder.rglob("*.json")):
        # What cannot be read is said where its entries are compared.
        with suppress(*FAULTS):
            text = data_files.read_text(path)
            indent = 1 if text.startswith("{\n") else None
            if text != f"{json.dumps(json.loads(text), indent=indent)}\n":
                found.append(claim(TEXT, path.relative_to(folder).as_posix(), wrong))
    return found


def gaps(folder: Path, summary: Mapping[str, Any], *, same_code: bool) -> list[Item]:
    """Hold what a summary says of the source's gaps, and their corrected models, against diagnoses.

    Another version than the one that wrote the report may predict otherwise.
    """
    items = []
    for name, said in inside(summary, "paper_gaps").items():
        place, both = folder / "gaps" / name, f"summary.json and gaps/{name}/diagnosis.json"
        if (place / "diagnosis.json").is_file():
            wrong, right = misquoted(said, place), "it predicts the gaps of diagnosis.json"
            items.append(claim(TEXT, both, wrong, "they say the same"))
            wrong = mispredicted(place)
            items.append(claim(TEXT, f"gaps/{name}/corrected.json", wrong, right, sure=same_code))
    return items
