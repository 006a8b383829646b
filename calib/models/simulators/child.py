"""Call one Python function, as a program: python child.py INPUT OUTPUT.

It knows nothing of this package: what it calls comes pickled, with where to import from.
"""

from __future__ import annotations

import os
import pickle
import sys
import traceback
from pathlib import Path


def main(given: str, taken: str) -> None:
    """Read a call, make it, and write ``(result, None)`` or ``(None, what was raised)``."""
    folder, path, call = pickle.loads(Path(given).read_bytes())
    os.chdir(folder)
    sys.path[:] = path
    found = raised = None
    try:
        function, arguments = pickle.loads(call)
        found = function(*arguments)
    except (Exception, SystemExit) as error:
        traceback.print_exc()
        raised = f"{type(error).__name__}: {error}"
    Path(taken).write_bytes(pickle.dumps((found, raised)))


if __name__ == "__main__":
    main(*sys.argv[1:])
