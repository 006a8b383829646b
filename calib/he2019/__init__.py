"""He, Sandu & Osorio (2019, Part II): their data, tables, audit and gaps."""

from __future__ import annotations

import tomllib
from importlib import resources
from typing import Any


def declared(place: str) -> dict[str, Any]:
    """Return what a TOML file of this package declares, by its path below it."""
    text = (resources.files("calib.he2019") / place).read_text(encoding="utf-8")
    return tomllib.loads(text)
