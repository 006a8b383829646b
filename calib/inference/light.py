"""Parts of packages that import other packages for what is not used here."""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module
from typing import Any

__all__ = ["part_of"]


@cache
def part_of(module: str, without: str) -> Any:
    """Import a module as where an optional package of its package's is not installed.

    arviz-stats imports xarray if it can, and corner ArviZ, for labelled arrays that nothing here
    hands them; that takes longer than to sample a posterior. Whoever imports these packages
    themselves gets them whole: nothing of it stays among the imported modules.

    Parameters
    ----------
    module : str
        With its package, as "arviz_stats.base".
    without : str
        The optional package.
    """
    package = module.partition(".")[0]
    if package in sys.modules or without in sys.modules:
        return import_module(module)
    sys.modules[without] = None  # type: ignore[assignment]
    try:
        return import_module(module)
    except ImportError:  # a version that cannot do without
        pass
    finally:
        del sys.modules[without]
        for name in [n for n in sys.modules if n.partition(".")[0] == package]:
            del sys.modules[name]
    return import_module(module)
