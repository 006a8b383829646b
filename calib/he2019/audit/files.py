"""An audit as JSON and CSV."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields
from typing import Any

from calib.he2019.audit.finding import Basis, Finding, Quantity, Verdict
from calib.he2019.audit.run import Audit
from calib.he2019.datasets.published import DOI
from calib.report.numbers import finite

SCHEMA = "calib/audit/1"
_COLUMNS = (
    "key", "verdict", "where", "claim", "test", "found", "evidence", "stays_open", "basis",
    "depends_on_reconstruction",
)  # fmt: skip


def audit_json(audit: Audit) -> str:
    """Return an audit as JSON; intervals that do not exist are null."""
    content = {
        "schema": SCHEMA,
        "source": f"doi:{DOI}",
        "seed": audit.seed,
        "verdicts": {verdict.value: verdict.meaning for verdict in Verdict},
        "counts": {verdict.value: n for verdict, n in audit.counts.items()},
        "findings": [_finding(f) for f in audit.findings],
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _finding(finding: Finding) -> dict[str, Any]:
    shown = asdict(finding)
    shown["found"] = [finite(asdict(q)) for q in finding.found]
    shown["depends_on_reconstruction"] = finding.reconstructed
    shown["caveat"] = finding.basis.caveat
    return shown


def read_findings(content: Mapping[str, Any]) -> tuple[Finding, ...]:
    """Return the findings in what `audit_json` writes; else a KeyError, TypeError or ValueError."""
    return tuple(_read(entry) for entry in content["findings"])


def _read(entry: Mapping[str, Any]) -> Finding:
    known = {f.name: entry[f.name] for f in fields(Finding)}
    found = tuple(Quantity(**_with_nan(q)) for q in known["found"])
    return Finding(
        **{
            **known,
            "figures": tuple(known["figures"]),
            "found": found,
            "verdict": Verdict(known["verdict"]),
            "basis": Basis(known["basis"]),
        }
    )


def _with_nan(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {key: math.nan if value is None else value for key, value in entry.items()}


def audit_csv(findings: Iterable[Finding]) -> str:
    """Return findings as CSV, one row for each."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for f in findings:
        writer.writerow([
            f.key, f.verdict.value, f.where, f.claim, f.test, "; ".join(map(str, f.found)),
            f.evidence, f.stays_open, f.basis.value, "yes" if f.reconstructed else "no",
        ])  # fmt: skip
    return out.getvalue()
