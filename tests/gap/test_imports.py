"""What a diagnosis imports: nothing that it does not need, for it is waited for."""

from __future__ import annotations

import json
import subprocess
import sys

_HEAVY = (
    "arviz", "corner", "dask", "distributed", "emcee", "jinja2", "matplotlib", "pandas", "pint",
    "scipy.stats", "xarray",
)  # fmt: skip


def _imported(statement: str) -> list[str]:
    code = f"import json, sys\n{statement}\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return list(json.loads(done.stdout))


def test_a_diagnosis_needs_no_sampler_no_figures_and_no_data_frames():
    # Whether a simulator has to be emulated is looked at first.
    found = _imported("import calib.inference.emulation.prepared, calib.gap.diagnose")
    assert "calib.gap.ranking" in found
    assert [name for name in _HEAVY if name in found] == []


def test_to_look_at_the_units_of_data_needs_no_package_of_units():
    found = _imported(
        "from calib import build_problem, load_he2019\n"
        "build_problem('magic_formula_pressure', load_he2019('drawbar_pull'))"
    )
    assert "calib.data.checks" in found
    assert "pint" not in found


def test_the_package_by_itself_needs_nothing():
    assert [name for name in ("numpy", "scipy", *_HEAVY) if name in _imported("import calib")] == []
