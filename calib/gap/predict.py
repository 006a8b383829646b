"""Predict with a calibration, or with the corrected models of a diagnosis."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import TYPE_CHECKING, overload

from calib.data import as_table
from calib.data.checks import check_conditions
from calib.data.reader import Tabular, index_of
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.prior_files import PriorFile
from calib.inference.problem import problem_without_data
from calib.validation import prediction
from calib.validation.prediction import Prediction

if TYPE_CHECKING:
    from calib.gap.corrected import CorrectedPrediction
    from calib.gap.diagnose import Diagnosis


@overload
def predict(found: Calibration, at: Tabular) -> Prediction: ...
@overload
def predict(found: str, at: Tabular, *, priors: PriorFile | str | None = None) -> Prediction: ...
@overload
def predict(
    found: Diagnosis, at: Tabular, without: Collection[str] = ()
) -> CorrectedPrediction: ...


def predict(
    found: Calibration | Diagnosis | str, at: Tabular, without: Collection[str] = (),
    *, priors: PriorFile | str | None = None,
) -> Prediction | CorrectedPrediction:  # fmt: skip
    """Predict at the conditions of a table.

    Parameters
    ----------
    found : Calibration, Diagnosis or str
        The name of a model predicts what its priors expect, before there are data. Reference
        conditions are then those of the table.
    at : Table, mapping of str to array_like, or pandas.DataFrame
        With the conditions, under column names with units. For a diagnosis also the covariates
        that its causes depend on.
    without : collection of str, optional
        Causes of a diagnosis that no longer act, as of an instrument that was mended.
    priors : path or PriorFile, optional
        Of a model; the shipped ones by default.

    Returns
    -------
    Prediction or CorrectedPrediction

    Raises
    ------
    CalibError
        If a condition is missing or looks as if it were in another unit, a cause is unknown, or
        causes are left out of a calibration, which has none. If priors are given for what has
        been calibrated.

    Examples
    --------
    >>> import calib
    >>> plates = calib.load_he2019("rut_depth")
    >>> calibration = calib.calibrate(calib.build_problem("bekker", plates), seed=1)
    >>> bands = calib.predict(calibration, {"average_ground_pressure_kpa": [100.0, 150.0]})
    >>> bands.predictive.median.shape
    (2,)
    >>> before = calib.predict("bekker", {"average_ground_pressure_kpa": [100.0, 150.0]})
    >>> bool(before.predictive.upper[0.9][0] > bands.predictive.upper[0.9][0])
    True
    """
    table = as_table(at)
    if isinstance(found, str) and not without:
        expected = prediction.predict_prior(problem_without_data(found, table, priors), table)
        return replace(expected, index=index_of(at))
    if priors is not None:
        raise CalibError(
            "priors are for a model, before it is calibrated", where="calib.predict",
            expected="the name of a model", hint="leave `priors` out",
        )  # fmt: skip
    if isinstance(found, Calibration):
        if without:
            raise CalibError(
                "a calibration has no causes to leave out",
                expected="a diagnosis",
                hint="predict with the diagnosis, or leave `without` out",
            )
        known = found.problem.conditions
        check_conditions(table, {name: known[name] for name in known if name in table})
        return replace(prediction.predict(found, table), index=index_of(at))
    from calib.gap.corrected import (  # late: a calibration does without
        check_units_of,
        predict_corrected,
    )
    from calib.gap.diagnose import Diagnosis

    if not isinstance(found, Diagnosis):
        raise CalibError(
            f"{type(found).__name__} predicts nothing",
            where="calib.predict",
            expected="what calib.calibrate or calib.diagnose returns",
            hint="load a run folder with calib.load_calibration, or calibrate the problem first",
        )
    check_units_of(found.corrected, table)
    left_out = [without] if isinstance(without, str) else without
    return replace(predict_corrected(found.corrected, table, left_out), index=index_of(at))
