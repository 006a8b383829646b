"""Hold inclusion against searches in another order, and against one that tries far more sets.

    calib challenge make --out large --key large.key --seed 4247 --cases 60 --tier large
    python benchmarks/search_order.py --cases large

Of each case the largest difference that the probability of an effect to act has from that of the
search as it is: with another seed of the draws (what chance alone does), with the effects listed in
another order, with pairs tried from four effects drawn at random instead of the four best, and with
all pairs and several times as many sets of more effects. A difference where pairs come from other
effects may be chance as well.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from calib.gap import search
from calib.gap.batch import case_folders
from calib.gap.campaigns import campaigns
from calib.gap.case import read_case
from calib.gap.effects import EFFECTS
from calib.gap.mixture import inclusion_probability
from calib.gap.ranking import rank

# A search that gives up later, makes more sets of more others, and fits each from all of them.
WIDER = {
    "pair_seeds": 99, "sets_changed": 8, "near_best": 6.0, "fitted": 48, "fitted_again": 99,
    "again": np.inf, "better": 0.3, "hopeless": 25.0, "searched": 12.0, "behind": 12.0,
    "behind_resized": 14.0,
}  # fmt: skip
SEARCHES = ("another seed", "listed otherwise", "other pairs first", "several times as wide")


def found(folder: Path, how: str) -> Mapping[str, float]:
    """Return the probability of every effect to act, by one of the searches."""
    rng = np.random.default_rng(int(folder.name.split("-")[-1]))
    names = list(EFFECTS)
    patches, seed = nullcontext(), 1
    if how == "another seed":
        seed = 2
    elif how == "listed otherwise":
        names = rng.permutation(names).tolist()
    elif how == "other pairs first":
        patches = patch.object(search, "_pair_seeds", lambda m, _: rng.permutation(m)[:4].tolist())
    elif how == "several times as wide":
        patches = patch.object(search, "SEARCH", replace(search.SEARCH, **WIDER))
    with patches:
        ranking = rank(campaigns(read_case(folder)), seed, effects={n: EFFECTS[n] for n in names})
    return inclusion_probability(ranking.probability)


def differences(folder: Path) -> list[tuple[float, bool]]:
    """Return the largest difference of each search, and whether what acts is another set."""
    usual = found(folder, "as it is")
    result = []
    for how in SEARCHES:
        other = found(folder, how)
        names = {*usual, *other}
        apart = {n: abs(usual.get(n, 0.0) - other.get(n, 0.0)) for n in names}
        acting = [{n for n, p in one.items() if p >= 0.5} for one in (usual, other)]
        result.append((max(apart.values()), acting[0] != acting[1]))
    return result


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=Path, required=True, nargs="+")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    folders = [f for cases in options.cases for f in case_folders(cases)]
    with ProcessPoolExecutor(options.workers) as pool:
        results = list(pool.map(differences, folders))
    print(f"{len(folders)} cases: largest difference of an effect's probability\n")
    print(f"{'':22} {'median':>7} {'90 %':>7} {'largest':>8} {'> 0.05':>7} {'other set':>10}")
    for i, how in enumerate(SEARCHES):
        apart = np.array([r[i][0] for r in results])
        other = sum(r[i][1] for r in results)
        print(f"{how:22} {np.median(apart):7.4f} {np.quantile(apart, 0.9):7.4f} {apart.max():8.3f}"
              f" {(apart > 0.05).sum():7} {other:10}")  # fmt: skip
        far = [f"{folders[j].parent.name}/{folders[j].name} {apart[j]:.2f}"
               for j in np.argsort(-apart)[:5] if apart[j] > 0.05]  # fmt: skip
        if far:
            print("  " + ", ".join(far))


if __name__ == "__main__":
    main()
