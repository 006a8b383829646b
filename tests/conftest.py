"""Calibrations that many tests read, sampled once."""

from __future__ import annotations

import gc

import numpy as np
import pytest
from hypothesis import settings

from calib.data import Table, hold_out, table_from_arrays
from calib.he2019 import embedded
from calib.he2019.audit import Audit, Seeds, run_audit
from calib.he2019.gaps import FoundGap, diagnose_gaps, paper_gaps
from calib.inference.calibration import Calibration, calibrate
from calib.inference.estimators import estimate
from calib.inference.problem import build_problem
from tests.blind import believed_test, blind_test  # noqa: F401
from tests.browser import browser  # noqa: F401
from tests.report.figures.fixtures import (  # noqa: F401
    all_plates,
    density,
    drawbar,
    plate,
    rut,
    unconverged,
)
from tests.together import pytest_collection_modifyitems, pytest_xdist_make_scheduler  # noqa: F401

SEED = 2019


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Look for no garbage among what is imported: it stays, and looking takes three seconds.

    Later, look for it seldom: results that many tests read stay as well.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000, 20)
        gc.enable()


# How long an example takes depends on the machine and on what else it does. Each run tries others:
# fifty find in two runs what a hundred find in one.
settings.register_profile("untimed", deadline=None, max_examples=50)
settings.load_profile("untimed")


def he2019_table(name: str) -> Table:
    columns = embedded.tables()[name]
    return table_from_arrays(columns, source=f"he2019 {name}", label=embedded.LABEL)


def _calibrated(model: str, table: Table) -> Calibration:
    problem = build_problem(model, table)
    point = estimate(problem, "least_squares", np.random.default_rng(SEED))
    return calibrate(problem, SEED, estimates=(point,))


@pytest.fixture(scope="session")
def rut_tables() -> tuple[Table, Table]:
    """Rows of 18 and 42 psi, and those of 30 psi."""
    return hold_out(he2019_table("rut_depth"), "inflation_pressure_psi", 30.0)


@pytest.fixture(scope="session")
def pull_tables() -> tuple[Table, Table]:
    return hold_out(he2019_table("drawbar_pull"), "inflation_pressure_psi", 30.0)


@pytest.fixture(scope="session")
def rut_calibration(rut_tables: tuple[Table, Table]) -> Calibration:
    return _calibrated("modified_bekker", rut_tables[0])


@pytest.fixture(scope="session")
def pull_calibration(pull_tables: tuple[Table, Table]) -> Calibration:
    return _calibrated("magic_formula_pressure", pull_tables[0])


@pytest.fixture(scope="session")
def density_calibration() -> Calibration:
    return _calibrated("ayers_perumpral", he2019_table("bulk_density"))


@pytest.fixture(scope="session")
def found_gaps() -> dict[str, FoundGap]:
    """Those of the source's own gaps in which an effect is withheld, diagnosed."""
    found = diagnose_gaps(SEED, [gap for gap in paper_gaps() if gap.withheld])
    return {result.gap.name: result for result in found}


@pytest.fixture(scope="session")
def audit(rut_calibration: Calibration) -> Audit:
    """The audit of the published tables, the genetic algorithm over few seeds."""
    return run_audit(SEED, seeds=Seeds(3, 2, 4), rut_calibration=rut_calibration)
