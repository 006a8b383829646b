"""Probabilistic calibration of tyre-soil models, and diagnosis of their sim-to-real gap.

Two nouns, `Problem` and `Calibration`, and a few verbs. Names are imported when they are first
used, so that ``import calib`` and ``calib --help`` stay quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib.audit import Audit, run_audit
    from calib.calibration import Calibration, calibrate
    from calib.campaign import read_plan, run_campaign
    from calib.data import Table, hold_out, read_table, table_from_arrays
    from calib.datasets.he2019 import load_he2019
    from calib.errors import CalibError
    from calib.estimators import PointEstimate, estimate
    from calib.gap.case import Case, read_case
    from calib.gap.diagnose import Diagnosis, diagnose
    from calib.models import MODELS
    from calib.prediction import Prediction, predict
    from calib.problem import Problem, build_problem
    from calib.reproduce.check import check
    from calib.sampling.sampler import SamplerSettings
    from calib.store import load_calibration, save_calibration, to_datatree
    from calib.validate import Validation, leave_one_out, validate_held_out

_HOME = {
    "Audit": "calib.audit",
    "run_audit": "calib.audit",
    "Calibration": "calib.calibration",
    "calibrate": "calib.calibration",
    "read_plan": "calib.campaign",
    "run_campaign": "calib.campaign",
    "Table": "calib.data",
    "hold_out": "calib.data",
    "read_table": "calib.data",
    "table_from_arrays": "calib.data",
    "load_he2019": "calib.datasets.he2019",
    "CalibError": "calib.errors",
    "PointEstimate": "calib.estimators",
    "estimate": "calib.estimators",
    "Case": "calib.gap.case",
    "read_case": "calib.gap.case",
    "Diagnosis": "calib.gap.diagnose",
    "diagnose": "calib.gap.diagnose",
    "MODELS": "calib.models",
    "Prediction": "calib.prediction",
    "predict": "calib.prediction",
    "Problem": "calib.problem",
    "build_problem": "calib.problem",
    "check": "calib.reproduce.check",
    "SamplerSettings": "calib.sampling.sampler",
    "load_calibration": "calib.store",
    "save_calibration": "calib.store",
    "to_datatree": "calib.store",
    "Validation": "calib.validate",
    "leave_one_out": "calib.validate",
    "validate_held_out": "calib.validate",
}

__all__ = [
    "MODELS",
    "Audit",
    "CalibError",
    "Calibration",
    "Case",
    "Diagnosis",
    "PointEstimate",
    "Prediction",
    "Problem",
    "SamplerSettings",
    "Table",
    "Validation",
    "build_problem",
    "calibrate",
    "check",
    "diagnose",
    "estimate",
    "hold_out",
    "leave_one_out",
    "load_calibration",
    "load_he2019",
    "predict",
    "read_case",
    "read_plan",
    "read_table",
    "run_audit",
    "run_campaign",
    "save_calibration",
    "table_from_arrays",
    "to_datatree",
    "validate_held_out",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'calib' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
