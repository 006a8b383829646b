"""Independent fits shared by the tests of the data set.

Nothing of the reconstruction is used but its files: equations, derivatives and fits are written
anew, and the published figures are typed in again from the source.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calib.he2019 import embedded

type Array = NDArray[np.float64]
type Columns = dict[str, Array]
type Curve = Callable[[Any], Array]


class Fit(Protocol):
    """A least-squares fit: model, observed values, start -> estimates and sum of squares."""

    def __call__(self, model: Curve, observed: Array, start: Array) -> tuple[Array, float]: ...


def read(path: Path) -> Columns:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Columns]:
    paths = embedded.write(tmp_path_factory.mktemp("data") / "made" / "on the way")
    return {path.stem: read(path) for path in paths}


@pytest.fixture(scope="session")
def exact_fit() -> Fit:
    """Levenberg-Marquardt with exact derivatives: differences would blur printed digits."""

    def fit(model: Curve, observed: Array, start: Array) -> tuple[Array, float]:
        def jacobian(t: Array) -> Array:
            steps = t + 1e-30j * np.eye(t.size)
            return np.column_stack([np.asarray(model(step)).imag / 1e-30 for step in steps])

        def residuals(t: Array) -> Array:
            return model(t) - observed

        found = least_squares(
            residuals, start, jac=jacobian, method="lm", x_scale="jac",
            xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=400,
        )  # fmt: skip
        return np.asarray(found.x), 2.0 * float(found.cost)

    return fit
