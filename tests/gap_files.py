"""The files of diagnoses of the source's gaps, made once in a process; an effect of one's own."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from calib.gap.diagnose import diagnose
from calib.gap.files import write_diagnosis
from calib.he2019.gaps import paper_gaps

_SCRATCH = tempfile.TemporaryDirectory(prefix="gaps-")


# A file with an effect of a user's own.
SOFT_PATCH = '''
import calib

class SoftPatch(calib.Effect):
    name = "soft_patch"
    title = "the last runs were on softer ground"
    parameters = ("deeper",)
    outputs = ("sinkage",)
    form = ("size",)
    priors = """
model = "soft_patch"

[parameters.deeper]
dist = "normal"
mean = 0.0
sd = 0.2
unit = "1"
reason = "ruts a fifth deeper"
source = "assumed"
"""

    def on_output(self, phi, output, location, view):
        return location + phi[:, :1] * (view.slip() > 0.15)
'''


@cache
def gap_files(name: str) -> Path:
    """Return the folder of a gap's diagnosis, without its page."""
    (case,) = (gap.case for gap in paper_gaps() if gap.name == name)
    folder = Path(_SCRATCH.name) / name
    folder.mkdir()
    write_diagnosis(diagnose(case, 2019), folder)
    return folder
