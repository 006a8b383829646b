"""Kernels of the gallery's notebooks: with this Python's commands, without the user's settings."""

from __future__ import annotations

import atexit
import json
import logging
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any


def setup(app: Any) -> dict[str, Any]:
    """Prepare what kernels inherit."""
    # The command `calib` that a notebook calls is beside the Python that runs it.
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    # What would be said: that messages between here and a kernel are not encrypted; each start.
    folder = Path(tempfile.mkdtemp(prefix="calib-docs-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    settings = folder / "profile_default" / "ipython_kernel_config.json"
    settings.parent.mkdir()
    settings.write_text(json.dumps({"IPKernelApp": {"log_level": logging.ERROR}}))
    os.environ["IPYTHONDIR"] = str(folder)
    logging.getLogger("traitlets").setLevel(logging.WARNING)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
