"""Probabilistic calibration of tyre-soil models, and diagnosis of their sim-to-real gap.

Two nouns, `Problem` and `Calibration`, and a few verbs. Names are imported when they are first
used, so that ``import calib`` and ``calib --help`` stay quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib.batch.campaign import read_plan, run_campaign
    from calib.checking.check import check
    from calib.data import Table, hold_out, read_table, table_from_arrays
    from calib.data.quantities import Quantity, Range
    from calib.data.registry import register
    from calib.errors import CalibError
    from calib.gap.case import Case, read_case
    from calib.gap.diagnose import Diagnosis, diagnose
    from calib.gap.effects import Effect
    from calib.gap.plan import plan_tests
    from calib.gap.predict import predict
    from calib.he2019.audit import Audit, run_audit
    from calib.he2019.embedded import load_he2019
    from calib.imports import Imported, read_log, suggest_mapping
    from calib.inference.calibration import Calibration, calibrate
    from calib.inference.emulation import Emulation
    from calib.inference.emulation.prepared import emulated
    from calib.inference.estimators import PointEstimate, estimate
    from calib.inference.io import load_calibration, save_calibration, to_datatree
    from calib.inference.problem import Problem, build_problem
    from calib.inference.sampler import SamplerSettings
    from calib.inference.tyre import to_tir
    from calib.models import MODELS, Model
    from calib.models.simulators.declaration import from_callable
    from calib.models.simulators.files import read_simulator
    from calib.models.tir import TyreFile, read_tir
    from calib.report.gap_words import gap_verdict
    from calib.report.verdict import Verdict, verdict
    from calib.validation.consistency import Consistency, consistency
    from calib.validation.prediction import Prediction
    from calib.validation.validate import Validation, leave_one_out, validate_held_out

_HOME = {
    "calib.batch.campaign": "read_plan run_campaign",
    "calib.checking.check": "check",
    "calib.data": "Table hold_out read_table table_from_arrays",
    "calib.data.quantities": "Quantity Range",
    "calib.data.registry": "register",
    "calib.errors": "CalibError",
    "calib.gap.case": "Case read_case",
    "calib.gap.diagnose": "Diagnosis diagnose",
    "calib.gap.effects": "Effect",
    "calib.gap.plan": "plan_tests",
    "calib.gap.predict": "predict",
    "calib.he2019.audit": "Audit run_audit",
    "calib.he2019.embedded": "load_he2019",
    "calib.imports": "Imported read_log suggest_mapping",
    "calib.inference.calibration": "Calibration calibrate",
    "calib.inference.emulation": "Emulation",
    "calib.inference.emulation.prepared": "emulated",
    "calib.inference.estimators": "PointEstimate estimate",
    "calib.inference.io": "load_calibration save_calibration to_datatree",
    "calib.inference.problem": "Problem build_problem",
    "calib.inference.sampler": "SamplerSettings",
    "calib.inference.tyre": "to_tir",
    "calib.models": "MODELS Model",
    "calib.models.simulators.declaration": "from_callable",
    "calib.models.simulators.files": "read_simulator",
    "calib.models.tir": "TyreFile read_tir",
    "calib.report.gap_words": "gap_verdict",
    "calib.report.verdict": "Verdict verdict",
    "calib.validation.comparison": "Comparison compare",
    "calib.validation.consistency": "Consistency consistency",
    "calib.validation.prediction": "Prediction",
    "calib.validation.validate": "Validation leave_one_out validate_held_out",
}

__all__ = [
    "MODELS",
    "Audit",
    "CalibError",
    "Calibration",
    "Case",
    "Comparison",
    "Consistency",
    "Diagnosis",
    "Effect",
    "Emulation",
    "Imported",
    "Model",
    "PointEstimate",
    "Prediction",
    "Problem",
    "Quantity",
    "Range",
    "SamplerSettings",
    "Table",
    "TyreFile",
    "Validation",
    "Verdict",
    "build_problem",
    "calibrate",
    "check",
    "compare",
    "consistency",
    "diagnose",
    "emulated",
    "estimate",
    "from_callable",
    "gap_verdict",
    "hold_out",
    "leave_one_out",
    "load_calibration",
    "load_he2019",
    "plan_tests",
    "predict",
    "read_case",
    "read_log",
    "read_plan",
    "read_simulator",
    "read_table",
    "read_tir",
    "register",
    "run_audit",
    "run_campaign",
    "save_calibration",
    "suggest_mapping",
    "table_from_arrays",
    "to_datatree",
    "to_tir",
    "validate_held_out",
    "verdict",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("terracalib")
    for home, names in _HOME.items():
        if name in names.split():
            return getattr(import_module(home), name)
    raise AttributeError(f"module 'calib' has no attribute {name!r}")


# What verbs return, and what few people type: there, but not among the names that are listed.
_UNLISTED = [
    "Audit",
    "Calibration",
    "Case",
    "Comparison",
    "Consistency",
    "Diagnosis",
    "Emulation",
    "Imported",
    "PointEstimate",
    "Prediction",
    "Problem",
    "Table",
    "TyreFile",
    "Validation",
    "Verdict",
    "consistency",
    "estimate",
    "plan_tests",
    "read_plan",
    "read_tir",
    "run_audit",
    "run_campaign",
    "suggest_mapping",
    "table_from_arrays",
    "to_tir",
]


def __dir__() -> list[str]:
    return sorted(set(__all__) - set(_UNLISTED))
