"""Files of posteriors are what ArviZ and xarray take them for."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import numpy as np
import pytest

from calib.inference.calibration import Calibration
from calib.inference.io import Groups, groups_of, read_netcdf, to_datatree, write_netcdf


def test_a_file_holds_what_the_tree_holds(rut_calibration: Calibration, tmp_path: Path) -> None:
    # Not at the top: to import it takes every process of the tests half a second.
    import xarray as xr

    write_netcdf(groups_of(rut_calibration), tmp_path / "posterior.nc")
    tree = to_datatree(rut_calibration)
    with xr.open_datatree(tmp_path / "posterior.nc", engine="h5netcdf") as file:
        assert file.attrs["run"] == tree.attrs["run"]
        assert set(file.children) == set(tree.children)
        for name, node in tree.children.items():
            xr.testing.assert_equal(file[name].to_dataset(), node.to_dataset())


def test_what_is_written_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(20)
    groups = Groups(
        {
            "posterior": {"a": rng.normal(size=(2, 3)), "b": rng.normal(size=(2, 3, 4))},
            "observed_data": {"y": np.arange(4)},
        },
        dims={"b": ("row",), "y": ("row",)},
        attrs={"said": "so"},
    )
    write_netcdf(groups, tmp_path / "a.nc")
    read = read_netcdf(tmp_path / "a.nc")
    assert dict(read.attrs) == {"said": "so"}
    assert set(read.values) == {"posterior", "observed_data"}
    for group, variables in groups.values.items():
        assert set(read.values[group]) == set(variables)
        for name, values in variables.items():
            np.testing.assert_array_equal(read.values[group][name], values)
            assert read.dims_of(group, name) == groups.dims_of(group, name)
    assert set(read_netcdf(tmp_path / "a.nc", "posterior").values) == {"posterior"}
    with pytest.raises(KeyError):
        read_netcdf(tmp_path / "a.nc", "prior")


def test_a_disk_too_small_is_seen_before_it_is_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    groups = Groups({"posterior": {"a": np.zeros((1, 100))}})
    for free, fits in ((799, False), (800, True)):
        usage = shutil._ntuple_diskusage(1000, 1000 - free, free)  # type: ignore[attr-defined]
        monkeypatch.setattr(shutil, "disk_usage", lambda _, usage=usage: usage)
        path = tmp_path / f"{free}.nc"
        if fits:
            write_netcdf(groups, path)
        else:
            with pytest.raises(OSError, match="No space left") as told:
                write_netcdf(groups, path)
            assert told.value.errno == errno.ENOSPC
        assert path.exists() == fits
