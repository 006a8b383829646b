"""Files of the package beside the code: hooks before a commit, the container."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
HOOKS = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text("utf-8"))["repos"][0]["hooks"]
LINT = re.search(r"^lint:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text("utf-8"), re.M)
assert LINT is not None
COMMANDS = [line.split() for line in re.sub(r"\\\n\s*", "", LINT[1]).splitlines()]


@pytest.mark.parametrize("hook", HOOKS, ids=lambda hook: hook["id"])
def test_a_hook_does_what_make_lint_does(hook):
    called = [w for w in hook["entry"].split() if w != "--force-exclude"]
    called[0] = called[0].replace(".venv/bin", "$(BIN)")
    (paths,) = (c[len(called) :] for c in COMMANDS if c[: len(called)] == called)
    assert hook["language"] == "system"  # nothing is downloaded
    for path in paths:
        for found in ROOT.glob(path):
            ends = "md" if hook["id"] == "proselint" else "py"
            inside = [found] if found.is_file() else list(found.rglob(f"*.{ends}"))
            names = [p.relative_to(ROOT).as_posix() for p in inside]
            assert all(re.search(hook["files"], name) for name in names), names


def test_the_image_has_what_the_checkout_has():
    """Nothing that the tests read is left out of it, and its Python is one that is tested."""
    left_out = (ROOT / ".dockerignore").read_text("utf-8").split("\n")[1:]
    ignored = set((ROOT / ".gitignore").read_text("utf-8").split()) | {".git"}
    assert {p.removeprefix("**/").rstrip("/") for p in left_out if p} == {
        p.rstrip("/") for p in ignored
    }
    container = (ROOT / "Dockerfile").read_text("utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    (python,) = re.findall(r"^FROM python:([\d.]+)-slim$", container, re.M)
    assert f"Programming Language :: Python :: {python}" in project["classifiers"]
    assert 'CMD ["make", "report"]' in container
    assert container.index("USER calib") < container.index("RUN make .venv/.ready")
