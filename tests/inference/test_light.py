"""Parts of packages, without what they import for others."""

import subprocess
import sys
from importlib import import_module

import pytest

from calib.inference.light import part_of

_AFTER = """
import sys
from calib.inference.light import part_of
light = part_of("arviz_stats.base", "xarray")
assert "xarray" not in sys.modules and "arviz_stats" not in sys.modules, sorted(sys.modules)
assert part_of("arviz_stats.base", "xarray") is light
import arviz_stats, numpy as np, xarray
assert arviz_stats.ess is not None  # whole
draws = np.random.default_rng(1).normal(size=(4, 500))
whole = arviz_stats.base.array_stats
for method in ("bulk", "mean"):
    one, other = (s.ess(draws, chain_axis=0, draw_axis=1, method=method)
                  for s in (light.array_stats, whole))
    assert np.isclose(one, other), (one, other)
"""


def test_a_part_leaves_its_package_whole_for_others():
    done = subprocess.run([sys.executable, "-c", _AFTER], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_where_the_package_is_there_already_its_part_is_taken():
    whole = import_module("json.decoder")
    assert part_of.__wrapped__("json.decoder", "no_such_package") is whole


def test_a_version_that_cannot_do_without_gets_what_it_needs(tmp_path, monkeypatch):
    (tmp_path / "needing.py").write_text("import needed\nvalue = needed.value\n")
    (tmp_path / "needed.py").write_text("value = 3\n")
    monkeypatch.syspath_prepend(tmp_path)
    try:
        assert part_of.__wrapped__("needing", "needed").value == 3
        assert sys.modules["needed"].value == 3
    finally:
        for name in ("needing", "needed"):
            sys.modules.pop(name, None)


def test_a_package_that_is_not_there_is_missed_as_ever():
    with pytest.raises(ImportError):
        part_of.__wrapped__("no_such_package", "neither")
