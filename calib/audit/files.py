"""An audit as JSON and CSV."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import asdict
from typing import Any

from calib.audit.finding import Finding, Verdict
from calib.audit.run import Audit
from calib.datasets.published import DOI

__all__ = ["SCHEMA", "audit_csv", "audit_json"]

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
    shown["found"] = [{k: _finite(v) for k, v in asdict(q).items()} for q in finding.found]
    shown["depends_on_reconstruction"] = finding.reconstructed
    shown["caveat"] = finding.basis.caveat
    return shown


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def audit_csv(audit: Audit) -> str:
    """Return an audit as CSV, one row for each finding."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for f in audit.findings:
        writer.writerow([
            f.key, f.verdict.value, f.where, f.claim, f.test, "; ".join(map(str, f.found)),
            f.evidence, f.stays_open, f.basis.value, "yes" if f.reconstructed else "no",
        ])  # fmt: skip
    return out.getvalue()
