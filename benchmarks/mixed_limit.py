"""Diagnose mixed gaps with the priors that `calib challenge make --tier large` draws them by.

    calib challenge well-specified large --key key --out believed --out-key answers
    python benchmarks/mixed_limit.py --cases believed --out results
    calib challenge score believed --results results --key answers

Where readings are drawn by the formulas and priors of the diagnosis itself, and it knows how often
the bench mixes causes, its probabilities are close to those of Bayes' theorem: whoever believes the
same of the effects names hardly more of them. No prior of the diagnosis is chosen by this.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from unittest.mock import patch

from calib.gap.batch import case_folders, written
from calib.gap.case import read_case
from calib.gap.diagnose import diagnose
from challenge.make import PAIR_FRACTION, TRIPLE_FRACTION, UNKNOWN_FRACTION

EFFECTS = 14  # that are tested where pull and rut are measured
NEVER = 1e-9
SEED = 1


def priors() -> Mapping[str, object]:
    """Return the constants of `calib.gap.odds` that say how often the bench draws what."""
    pairs = PAIR_FRACTION["large"]
    alone = 1.0 - pairs - TRIPLE_FRACTION["large"]
    a_pair, a_single = pairs / (EFFECTS * (EFFECTS - 1) / 2), alone / EFFECTS
    return {
        "PAIR_TO_SINGLE": a_pair / a_single,
        "PRIOR": {
            "none": NEVER, "parameter_shift": NEVER, "unknown": UNKNOWN_FRACTION,
            "single": (1.0 - UNKNOWN_FRACTION) * alone,
        },
    }  # fmt: skip


def diagnosed(folder: Path) -> dict[str, bytes]:
    """Return the files of one diagnosis."""
    with patch.multiple("calib.gap.odds", **priors()):
        return written(diagnose(read_case(folder), SEED))


def main() -> None:
    """Diagnose all cases of a folder."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True, help="new folder")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    options.out.mkdir(parents=True)
    folders = case_folders(options.cases)
    with ProcessPoolExecutor(options.workers) as pool:
        for folder, files in zip(folders, pool.map(diagnosed, folders), strict=True):
            for name, content in files.items():
                path = options.out / folder.name / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)


if __name__ == "__main__":
    main()
