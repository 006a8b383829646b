"""One rival as a program: it reads a case folder and writes its answer into another."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from calib.models.simulators.files import load_files
from rivals import akaike, processes, sindy
from rivals.common import Answer, Prepared, prepare, write

METHODS: dict[str, Callable[[Prepared], Answer]] = {
    "koh": lambda p: processes.diagnose(p, "koh"),
    "sgasp": lambda p: processes.diagnose(p, "sgasp"),
    "ogp": lambda p: processes.diagnose(p, "ogp"),
    "sindy": sindy.by_polynomials,
    "sindy_effects": sindy.by_effects,
    "aic": akaike.diagnose,
}
LACKING = {name for name in METHODS if name.startswith("sindy") and not find_spec("pysindy")}


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m rivals", description=__doc__)
    parser.add_argument("method", choices=sorted(METHODS.keys() - LACKING))
    parser.add_argument("case", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--models", type=Path, nargs="*", default=[], metavar="FILE")
    given = parser.parse_args()
    load_files(given.models)
    p = prepare(given.case)
    write(p, METHODS[given.method](p), given.out)


if __name__ == "__main__":
    main()
