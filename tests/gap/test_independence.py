"""What a diagnosis imports, opens and knows."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import calib
import calib.gap
from calib.inference.prior_files import default_priors
from tests.gap.cases import PULL_ONLY, make_case, write_case

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


GAP = Path(calib.gap.__file__).parent

_WATCH = """
import json, sys
opened = []
def hook(event, args):
    if event == "open" and isinstance(args[0], str):
        opened.append(args[0])
    if event in ("os.listdir", "os.scandir", "glob.glob"):
        opened.append(str(args[0]))
from calib.gap.batch import diagnose_cases
from pathlib import Path
import calib.gap.diagnose, calib.gap.files
sys.addaudithook(hook)
failed = diagnose_cases([Path(sys.argv[1])], Path(sys.argv[2]), 1)
print(json.dumps({"opened": opened, "failed": failed,
                  "challenge": [m for m in sys.modules if m.partition(".")[0] == "challenge"]}))
"""


def test_no_module_of_the_diagnosis_imports_the_challenge():
    files = sorted(GAP.rglob("*.py"))
    assert len(files) > 10
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, file
                names = [node.module or "", *(f"{node.module}.{a.name}" for a in node.names)]
            assert not any(n.partition(".")[0] == "challenge" for n in names), file


def test_only_the_case_and_the_priors_are_opened(tmp_path):
    root = tmp_path / "challenge"
    made = make_case("force_offset", models=PULL_ONLY, n_lab=15, n_field=12, n_fresh=3)
    case = write_case(made, root / "case-000")
    key = root / "key.json"
    key.write_text(json.dumps({"case-000": "force_offset"}))
    (case.parent / "case-000-key.json").write_text("{}")
    out = tmp_path / "out" / "case-000"
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    ran = subprocess.run(
        [sys.executable, "-c", _WATCH, str(case), str(out.parent)],
        capture_output=True, text=True, check=True, timeout=120,
        env={**os.environ, "TMPDIR": str(scratch)},
    )  # fmt: skip
    found = json.loads(ran.stdout.splitlines()[-1])
    assert found["failed"] == {}
    assert found["challenge"] == []
    assert (out / "diagnosis.json").exists()
    inside = [p for p in map(Path, found["opened"]) if p.is_relative_to(root)]
    # The hook sees what is opened: the case's own files are there, and nothing else of its root.
    assert {p.name for p in inside} == {"case.toml", "lab.csv", "field.csv", "fresh.csv"}
    assert all(p.parent == case for p in inside)
    priors = default_priors("magic_formula").parent
    package = Path(calib.__file__).parent
    allowed = (case, out.parent, scratch, priors, package, Path(sys.prefix), Path(sys.base_prefix))
    strange = [
        p for p in map(Path, found["opened"])
        if p.is_absolute() and not any(p.is_relative_to(a) for a in allowed)
        and not p.is_relative_to("/dev") and not p.is_relative_to("/proc")
        and not p.is_relative_to("/sys") and not p.is_relative_to("/usr")
    ]  # fmt: skip
    assert strange == []


def test_a_case_of_the_challenge_is_diagnosed(tmp_path):
    from calib.gap.case import read_case
    from calib.gap.diagnose import diagnose
    from calib.gap.effects import EFFECTS
    from challenge.make import make

    make(tmp_path / "cases", tmp_path / "answers", seed=3, n_cases=1)
    (folder,) = [p for p in (tmp_path / "cases").iterdir() if (p / "case.toml").exists()]
    found = diagnose(read_case(folder), effects={"force_offset": EFFECTS["force_offset"]})
    assert found.verdict in ("effect", "none", "unknown", "ambiguous")


def test_a_shared_null_case_has_no_gap(shared_cases):
    from calib.gap.case import read_case
    from calib.gap.diagnose import diagnose
    from tests.gap.cases import CHOICE

    found = diagnose(read_case(shared_cases / "case-003"), effects=CHOICE)
    assert found.verdict == "none"
