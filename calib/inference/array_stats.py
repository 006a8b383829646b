"""ArviZ's functions of plain arrays."""

from __future__ import annotations

from calib.inference.light import part_of

__all__ = ["array_stats"]

array_stats = part_of("arviz_stats.base", "xarray").array_stats
