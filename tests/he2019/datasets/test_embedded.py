"""The files: their names, headers, rows and bytes."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.he2019 import embedded, reconstruction

type Columns = dict[str, NDArray[np.float64]]

HEADERS = {
    "bulk_density": ["cone_index_kpa", "gravimetric_water_content", "bulk_density_g_cm3"],
    "drawbar_pull": [
        "inflation_pressure_psi", "nominal_slip_ratio", "slip_ratio", "drawbar_pull_kn",
    ],
    "rut_depth": [
        "inflation_pressure_psi", "average_ground_pressure_kpa", "slip_ratio", "rut_depth_mm",
    ],
}  # fmt: skip


def test_files_headers_and_counts(tmp_path: Path) -> None:
    paths = embedded.write(tmp_path)
    assert [path.name for path in paths] == [f"{name}.csv" for name in HEADERS]
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    for path, rows in zip(paths, (36, 42, 27), strict=True):
        lines = path.read_bytes().decode("ascii").split("\n")
        assert lines[0].split(",") == HEADERS[path.stem]
        assert len(lines) == rows + 2
        assert lines[-1] == ""


def test_same_bytes_every_time(tmp_path: Path) -> None:
    first = [path.read_bytes() for path in embedded.write(tmp_path / "a")]
    again = [
        reconstruction.bulk_density(),
        reconstruction.drawbar_pull(),
        reconstruction.rut_depth(),
    ]
    for fresh, kept in zip(again, embedded.tables().values(), strict=True):
        for name in kept:
            assert np.array_equal(fresh[name], kept[name])
    assert [path.read_bytes() for path in embedded.write(tmp_path / "b")] == first
    assert [path.read_bytes() for path in embedded.write(tmp_path / "b")] == first


def test_files_hold_what_the_functions_return(files: dict[str, Columns]) -> None:
    for name, table in embedded.tables().items():
        assert list(files[name]) == list(table)
        for column, values in table.items():
            assert np.array_equal(files[name][column], values), column


def test_labelled_and_read_only() -> None:
    assert embedded.LABEL == "reconstructed"
    with pytest.raises(ValueError, match="read-only"):
        embedded.columns("rut_depth")["rut_depth_mm"][0] = 1.0


def test_reconstruction_is_quick() -> None:
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        reconstruction.bulk_density(), reconstruction.drawbar_pull(), reconstruction.rut_depth()
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 1.0
