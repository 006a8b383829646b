"""The audit of the published tables: every printed figure that can be tested, and its verdict."""

from calib.he2019.audit.convergence import Seeds
from calib.he2019.audit.finding import Basis, Finding, Quantity, Verdict
from calib.he2019.audit.run import Audit, audit_csv, audit_json, run_audit

__all__ = [
    "Audit", "Basis", "Finding", "Quantity", "Seeds", "Verdict", "audit_csv", "audit_json",
    "run_audit",
]  # fmt: skip
