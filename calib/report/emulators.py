"""The section of a report on emulators: how many runs, how good on runs not seen, which failed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from calib.batch.pool import Pool
from calib.report.numbers import format_number
from calib.report.sections import Written
from calib.report.study import Progress, Study

type Document = Mapping[str, Any]

# So many failed runs are shown; the manifest has all.
_SHOWN = 20
_HEADINGS = (
    "model", "runs", "conditions in each", "off on runs not seen (noise sds, rms)",
    "inside 90 % intervals", "PIT in quarters", "between conditions (noise sds)", "own noise (sd)",
    "verdict",
)  # fmt: skip
_WORDS = (
    "The simulator was run where the posterior needed it, and the sampler asked a Gaussian-process "
    "emulator of these runs. The emulator's own error is in the likelihood. The last runs were "
    "predicted before the emulator saw them: an emulator that knows its error has a quarter of "
    "their probability integral transforms (PIT) in each quarter."
)


@dataclass(frozen=True)
class EmulatorSection:
    """What became of the emulations, as their `Emulation.document`, by model."""

    documents: Mapping[str, Document]

    def begin(self, seed: int, pool: Pool) -> Callable[[Study, Progress], FoundEmulators]:
        """Return what hands them on: they were made before the study."""
        return lambda study, tell: FoundEmulators(self.documents)


@dataclass(frozen=True)
class FoundEmulators:
    """The emulations, ready to be written; see `EmulatorSection`."""

    documents: Mapping[str, Document]
    name: str = "emulators"

    def summary(self) -> None:
        """Add nothing to the summary: a check does not run the simulator again."""

    def record(self) -> dict[str, Any]:
        """Return all there is to know for the manifest."""
        return {model: dict(document) for model, document in self.documents.items()}

    def begin(
        self, folder: Path, *, versions: Mapping[str, str], pdf: bool, pool: Pool
    ) -> Callable[[Progress], Written]:
        """Return what writes the piece of the page."""
        html = _page(self.documents)
        return lambda tell: Written("emulators", "Emulators of slow simulators", "", html)


def _page(documents: Mapping[str, Document]) -> str:
    rows = [_cells(model, d) for model, d in documents.items()]
    failed = [_failures(model, d["failed"]) for model, d in documents.items() if d["failed"]]
    return f"<p>{_WORDS}</p>{_table(_HEADINGS, rows)}{''.join(failed)}"


def _cells(model: str, d: Document) -> list[str]:
    held: Document = d["held_out"] or {}
    pit = np.histogram(held.get("pit", []), bins=4, range=(0.0, 1.0))[0]
    shares = (
        ", ".join(f"{100 * part:.0f} %" for part in pit / max(int(pit.sum()), 1))
        if held
        else "none"
    )
    seen = f"{format_number(held['rmse_in_noise_sds'])} on {held['runs']}" if held else "none left"
    own = format_number(d["simulator_noise_sd"]) if d["simulator_noise_sd"] else "none"
    return [
        model, str(d["runs"]), str(d["nodes"]), seen,
        f"{100 * held['covered_90']:.0f} %" if held else "", shares,
        format_number(d["between_nodes_error_in_noise_sds"]), own,
        "good enough" if d["passed"] else "; ".join(d["reasons"]),
    ]  # fmt: skip


def _failures(model: str, failed: Sequence[Document]) -> str:
    rows = [
        [", ".join(f"{v:.4g}" for v in f["parameters"]), f["kind"], f["reason"],
         f["printed"].strip()[-200:]]
        for f in failed[:_SHOWN]
    ]  # fmt: skip
    more = f" The first {_SHOWN}:" if len(failed) > _SHOWN else ""
    words = (
        f"{len(failed)} runs of {model} failed; where runs fail the posterior is taken to be zero, "
        f"and nothing is filled in.{more}"
    )
    return f"<p>{escape(words)}</p>{_table(('parameters', 'kind', 'reason', 'it printed'), rows)}"


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(h)}</th>" for h in headings)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
