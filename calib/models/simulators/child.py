"""Call one Python function, as a program: python child.py INPUT OUTPUT.

It knows nothing of this package: what it calls comes pickled, with where to import from.
"""

from __future__ import annotations

import errno
import os
import pickle
import socket
import sys
import traceback
from pathlib import Path

# Resources that ran out and lost connections, whatever the parameters are.
_SHORT = {
    getattr(errno, name, 0)  # not every system has them all
    for name in (
        "ENOMEM", "ENOSPC", "EDQUOT", "EROFS", "EFBIG", "EMFILE", "ENFILE", "EAGAIN", "EIO",
        "ESTALE", "ETXTBSY", "ENETDOWN", "ENETUNREACH", "EHOSTDOWN", "EHOSTUNREACH", "ETIMEDOUT",
    )
}  # fmt: skip


def of_surroundings(error: BaseException | None) -> bool:
    """Whether an exception or its cause has nothing to do with the parameters of a run."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        kinds = (MemoryError, ConnectionError, TimeoutError, socket.gaierror, socket.herror)
        if isinstance(error, kinds) or (isinstance(error, OSError) and error.errno in _SHORT):
            return True
        error = error.__cause__ or error.__context__
    return False


def main(given: str, taken: str) -> None:
    """Read a call, make it, and write the result or what was raised."""
    folder, path, call = pickle.loads(Path(given).read_bytes())
    os.chdir(folder)
    sys.path[:] = path
    found = raised = None
    elsewhere = False
    try:
        function, arguments = pickle.loads(call)
        found = function(*arguments)
    except (Exception, SystemExit) as error:
        traceback.print_exc()
        raised, elsewhere = f"{type(error).__name__}: {error}", of_surroundings(error)
    Path(taken).write_bytes(pickle.dumps((found, raised, elsewhere)))


if __name__ == "__main__":
    main(*sys.argv[1:])
