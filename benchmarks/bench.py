"""Run the benchmarks and write out/benchmarks: tables, a figure, and what they say.

    python benchmarks/bench.py                       # all parts, an hour on two cores
    python benchmarks/bench.py posterior likelihood  # some of them; the others stay as they were
    python benchmarks/bench.py --full campaign       # 200 diagnoses in the place of 100
    python benchmarks/bench.py --full everyday       # `make test` too

Each part runs in a process of its own and leaves its measurements as JSON; tables, figure and
README are written from whatever parts are there.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
# Small matrices: threads would only wait for each other, and the peers get one core as we do.
ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS",
     "NUMEXPR_NUM_THREADS", "RAYON_NUM_THREADS"), "1",
)  # fmt: skip

PARTS: dict[str, list[str]] = {
    "posterior": ["posterior.py"],
    "likelihood": ["likelihood.py"],
    "genetic": ["genetic.py"],
    "million": ["million.py"],
    "campaign": ["campaign.py", "--cases", "100", "--repeats", "1"],
    "survival": ["campaign_survival.py", "--cases", "200"],
    "everyday": ["everyday.py"],
    "emulator": ["emulator.py"],
}
FULL = {"campaign": ["--cases", "200"], "everyday": ["--tests"]}


def main() -> int:
    """Run the parts asked for, then write the report."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--out", type=Path, default=HERE.parent / "out" / "benchmarks")
    parser.add_argument(
        "--full", action="store_true", help="campaigns of 200, `make test`: 40 minutes more"
    )
    parser.add_argument("--only-write", action="store_true", help="measure nothing")
    options = parser.parse_args()
    unknown = set(options.parts) - set(PARTS)
    if unknown:
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    measured = options.out / "measured"
    measured.mkdir(parents=True, exist_ok=True)
    failed = []
    for part in [] if options.only_write else options.parts or list(PARTS):
        print(f"--- {part}", flush=True)
        began = time.perf_counter()
        fresh = measured / f"{part}.json.new"
        script, *words = PARTS[part]
        words += FULL.get(part, []) if options.full else []
        command = [sys.executable, HERE / script, *words, "--out", fresh]
        code = subprocess.run(command, env={**os.environ, **ONE_THREAD}, check=False).returncode
        if code:
            failed.append(part)
            fresh.unlink(missing_ok=True)
        else:
            fresh.replace(measured / f"{part}.json")
        print(f"--- {part}: {time.perf_counter() - began:.0f} s", flush=True)
    from report.write import write

    write(options.out)
    print(f"written: {options.out.name}/README.md, results.csv, results.md, benchmarks.png")
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
