"""The outputs that are calibrated, by the names used in results."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

__all__ = ["OUTPUTS"]

OUTPUTS: Mapping[str, str] = MappingProxyType(
    {
        "bulk_density": "bulk_density_g_cm3",
        "drawbar_pull": "drawbar_pull_kn",
        "rut_depth": "rut_depth_mm",
    }
)
