"""The kinds of task a plan may ask for, by the name of their tables in it.

Another kind is a file here with a class, and a line below.
"""

from __future__ import annotations

from typing import Any

from calib.batch.campaign.kinds.base import Kind, Planned, Section, Task, Work
from calib.batch.campaign.kinds.challenge import Challenge, Sbc
from calib.batch.campaign.kinds.diagnose import Diagnose
from calib.batch.campaign.kinds.fit import Fit

__all__ = ["KINDS", "Kind", "Planned", "Section", "Task", "Work"]

KINDS: dict[str, Kind[Any, Any]] = {
    kind.name: kind for kind in (Fit(), Diagnose(), Challenge(), Sbc())
}
