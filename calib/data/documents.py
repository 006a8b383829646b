"""JSON documents that somebody else wrote, whatever is in them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from calib.errors import FAULTS

__all__ = ["inside", "read_json"]


def read_json(path: Path) -> dict[str, Any]:
    """Return a JSON object; empty where the file is missing or damaged."""
    try:
        return inside(json.loads(path.read_text(encoding="utf-8")))
    except FAULTS:
        return {}


def inside(document: Any, *keys: str) -> dict[str, Any]:
    """Return the object below some keys of a document; empty where there is none."""
    for key in keys:
        document = document.get(key) if isinstance(document, dict) else None
    return document if isinstance(document, dict) else {}
