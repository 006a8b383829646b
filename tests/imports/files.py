"""Files as rigs write them, and what they hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.signal import lfilter

SHARED = Path(__file__).resolve().parents[3] / "shared" / "field"

# As the tyre test consortium lays its text files out: a title, names, units.
TTC = """\
Run 7, a tyre
ET\tV\tFX\tFZ\tSR\tIA\tP\tTSTC
sec\tkph\tN\tN\tnone\tdeg\tkPa\tdeg C
0.01\t40.2\t410.5\t-3000\t0.05\t0\t83\t51.5
0.02\t40.1\t930\t-3010\t0.25\t0\t83\t51.6
"""


def ar1(n: int, rho: float, seed: int = 1) -> np.ndarray:
    """Noise of unit variance whose autocorrelation time is (1 + rho) / (1 - rho)."""
    rng = np.random.default_rng(seed)
    steps = rng.standard_normal(n) * np.sqrt(1.0 - rho**2)
    steps[0] = rng.standard_normal()
    return lfilter([1.0], [1.0, -rho], steps)


def write(path: Path, text: str, encoding: str = "utf-8") -> Path:
    path.write_bytes(text.encode(encoding))
    return path
