"""Effects from a user's own Python file: a class for each, its priors in a TOML file beside it."""

from __future__ import annotations

import inspect
from pathlib import Path

from calib.batch.plugins import run_file
from calib.errors import CalibError
from calib.gap.effects.base import Effect
from calib.gap.effects.check import check_declared


def load_effects(path: Path) -> dict[str, Effect]:
    """Load the effects that a Python file defines.

    Parameters
    ----------
    path : Path
        Python file with subclasses of `calib.gap.effects.Effect`; ``NAME.toml`` beside it holds
        the priors of the effect of that name.

    Raises
    ------
    CalibError
        If the file cannot be run, defines no effect, priors are missing, or an effect is not
        what it must be.
    """
    path = Path(path)
    module = run_file(path, "effects")
    found: dict[str, Effect] = {}
    for _, kind in inspect.getmembers(module, inspect.isclass):
        if issubclass(kind, Effect) and kind.__module__ == module.__name__ and kind.name:
            effect = kind()
            check_declared(effect)
            beside = path.with_name(f"{effect.name}.toml")
            effect.prior_file = None if effect.priors else beside
            if not effect.priors and not beside.is_file():
                raise CalibError(
                    f"the effect {effect.name} has no priors", where=str(beside),
                    hint="write this file after the example of priors/effects/rate_effect.toml",
                )  # fmt: skip
            found[effect.name] = effect
    if not found:
        raise CalibError(
            "the file defines no effect", where=str(path),
            expected="a subclass of calib.gap.effects.Effect with a name",
        )  # fmt: skip
    return found
