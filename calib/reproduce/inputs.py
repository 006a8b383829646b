"""Check the data and the priors of a folder: what they are called, and whether they are that."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from calib.data import Table
from calib.datasets import he2019
from calib.manifest import sha256
from calib.prior_files import default_prior_path
from calib.reproduce.items import Item, Status
from calib.reproduce.schema import TaskRecord

__all__ = ["GROUP", "verify_hashes", "verify_label", "verify_priors"]

GROUP = "data and priors"


def verify_hashes(key: str, entry: TaskRecord, folder: Path) -> list[Item]:
    """Check that an output's data and priors are the ones it says it was computed from."""
    return [
        Item(GROUP, file.file, Status.DIFFERENT, note=f"not what {key} was computed from")
        for file in (entry.data, entry.priors)
        if (folder / file.file).is_file()
        and sha256((folder / file.file).read_bytes()) != file.sha256
    ]


def verify_label(file: str, table: Table, label: str) -> Item:
    """Check that the embedded, reconstructed data are called so, and nothing else is.

    Parameters
    ----------
    file : str
        Where the rows are.
    table : Table
    label : str
        What they are said to be.
    """
    embedded = he2019.labelled(replace(table, label="")).label == he2019.LABEL
    if label == he2019.LABEL and not embedded:
        note = "called reconstructed, but not the embedded data"
        return Item(GROUP, file, Status.DIFFERENT, note=note)
    if label != he2019.LABEL and embedded:
        note = "these are the embedded data, reconstructed and not measured, but not called so"
        return Item(GROUP, file, Status.DIFFERENT, note=note)
    note = "the embedded data" if embedded else "data of the user"
    return Item(GROUP, file, Status.IDENTICAL, note=note)


def verify_priors(key: str, entry: TaskRecord, folder: Path, *, same_code: bool) -> Item:
    """Check that priors which are called the shipped ones are."""
    file = entry.priors.file
    if not entry.priors.shipped:
        return Item(GROUP, file, Status.IDENTICAL, note=f"priors of the user for {key}")
    shipped = default_prior_path(entry.model)
    if (folder / file).read_bytes() == shipped.read_bytes():
        return Item(GROUP, file, Status.IDENTICAL, note=f"the shipped {shipped.name}")
    status = Status.DIFFERENT if same_code else Status.UNJUDGED
    return Item(GROUP, file, status, note=f"not the {shipped.name} of this version")
