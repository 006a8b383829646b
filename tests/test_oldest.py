"""The oldest dependencies that are tested are the oldest that are allowed."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_the_pins_are_the_lower_bounds() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    bounds = dict(re.match(r"([\w-]+).*?>=([\d.]+)", line).groups() for line in declared)
    pins = dict(line.split("==") for line in (ROOT / "constraints-oldest.txt").read_text().split())
    assert {name.lower() for name in pins} == set(bounds)
    for name, pin in pins.items():
        assert re.fullmatch(rf"{re.escape(bounds[name.lower()])}(\.0)*", pin), name
