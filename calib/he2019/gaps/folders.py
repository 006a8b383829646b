"""The four cases as folders for `calib diagnose`: worked examples of the contract."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

from calib.data import write_table
from calib.errors import CalibError
from calib.he2019.gaps.cases import RECONSTRUCTED, PaperGap


def write_cases(gaps: Sequence[PaperGap], out: Path, *, overwrite: bool = False) -> list[Path]:
    """Write each gap as a case folder, and return the folders.

    With ``case.toml``, ``lab.csv``, ``field.csv`` and, where rows were kept out, ``fresh.csv`` with
    their conditions and ``fresh_measured.csv`` with their outcomes, which no diagnosis reads.

    Raises
    ------
    CalibError, OSError
        If a folder exists and may not be replaced; if one cannot be made or written to.
    """
    folders = [Path(out) / gap.name for gap in gaps]
    existing = [folder.name for folder in folders if folder.exists()]
    if existing and not overwrite:
        raise CalibError(
            f"{', '.join(existing)} exist there already", where=str(out),
            mend="choose another --out, or pass --overwrite",
        )  # fmt: skip
    for gap, folder in zip(gaps, folders, strict=True):
        folder.mkdir(parents=True, exist_ok=True)
        write_table(folder / "lab.csv", gap.case.lab.columns)
        write_table(folder / "field.csv", gap.case.field.columns)
        if gap.case.new_conditions is not None and gap.unfitted is not None:
            write_table(folder / "fresh.csv", gap.case.new_conditions.columns)
            write_table(folder / "fresh_measured.csv", gap.unfitted.columns)
        (folder / "case.toml").write_text(_case_toml(gap), encoding="utf-8")
    return folders


def _case_toml(gap: PaperGap) -> str:
    remarks = (
        f"{gap.title}. {gap.question}",
        f"Calibration: {gap.lab_rows}.",
        f"Field: {gap.field_rows}.",
        f"{RECONSTRUCTED.capitalize()}. {gap.limits}",
    )
    lines = [f"# {line}" for text in remarks for line in textwrap.wrap(text, 96)]
    lines += ['calibration = "lab.csv"', 'field = "field.csv"']
    if gap.case.new_conditions is not None:
        lines.append('predict = "fresh.csv"')
    lines += ["", "[models]", *(f'{o} = "{m}"' for o, m in gap.case.models.items())]
    return "\n".join(lines) + "\n"
