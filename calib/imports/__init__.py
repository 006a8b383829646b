"""Files as rigs write them: read, mapped to quantities, and reduced to independent rows."""

from __future__ import annotations

from calib.imports.run import Imported, read_log
from calib.imports.suggest import suggest_mapping

__all__ = ["Imported", "read_log", "suggest_mapping"]
