"""A user's own effects: loaded from a Python file, checked, and evaluated once on a case."""

from __future__ import annotations

import difflib
import inspect
import traceback
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.batch.user_code import declared_in, run_file
from calib.data.quantities import QUANTITIES, role_of
from calib.errors import CalibError, meant
from calib.gap.campaigns import Campaigns, OutputData, campaigns
from calib.gap.case import Case
from calib.gap.effects import EFFECTS, Effect, Known, View
from calib.gap.forward import Forward
from calib.gap.hypotheses import Hypothesis, effect_priors
from calib.inference.random import generator
from calib.models.base import Array, check_tuple

_BASE = tuple(name for name in vars(Effect) if not name.startswith("_"))
_METHODS = tuple(name for name in _BASE if callable(getattr(Effect, name)))
_TUPLES = ("latex", "parameters", "outputs", "needs", "covariates", "form")
_FORMS = ("size", "slip", "pressure", "cone", "water", "shape", "extrapolation")


def check_effects(effects: Mapping[str, Effect], case: Case) -> None:
    """Check those effects that are not calib's own, and evaluate them once on a case.

    It is the same whether a file of a diagnosis, a registered file, an installed package or a
    caller brought them.

    Parameters
    ----------
    effects : mapping of str to Effect
        All that a diagnosis is to consider.

    Raises
    ------
    CalibError
        If one declares what there is not, raises, returns something else than numbers of the right
        shape, or changes nothing.
    """
    own = [e for e in effects.values() if not type(e).__module__.startswith("calib.")]
    for effect in own:
        check_declared(effect)
    if own:
        data = campaigns(case)
        for effect in own:
            if _call(effect.not_testable, effect, data.view, data.roles) is None:
                _check_testable(effect, data)


def check_declared(effect: Effect) -> None:
    """Check what can be seen without data.

    Raises
    ------
    CalibError
        If the name is taken, an output, covariate or form is unknown, plain text stands for a
        tuple, what is known of it is of no such thing, or a method is misspelt.
    """
    where = _place(effect)
    taken = EFFECTS.get(effect.name)
    if taken is not None and type(taken) is not type(effect):
        whose = "calib's own" if type(taken).__module__.startswith("calib.") else "another file"
        raise CalibError(
            f"the name is that of an effect of {whose}",
            where=where,
            expected=f"any name but {', '.join(EFFECTS)}",
            hint="give it another name",
        )
    for attribute in _TUPLES:
        check_tuple(attribute, getattr(effect, attribute), where)
    outputs = {q.physical: q.stem for q in QUANTITIES.values() if q.role == "output"}
    conditions = {q.physical: c for c, q in QUANTITIES.items() if q.role != "output"}
    for attribute, known in (
        ("outputs", outputs),
        ("needs", outputs),
        ("covariates", conditions),
        ("form", _FORMS),
    ):
        for name in getattr(effect, attribute):
            _check_name(name, attribute, known, where)
    for fact in effect.known if isinstance(effect.known, tuple) else [effect.known]:
        _check_known(effect, fact, conditions, where)
    for kind in type(effect).__mro__[:-2]:
        for name, value in vars(kind).items():
            _check_attribute(name, value, where)


def _check_known(effect: Effect, fact: object, conditions: Mapping[str, str], where: str) -> None:
    if (
        not isinstance(fact, Known)
        or fact.output not in effect.outputs
        or fact.sign not in (-1, 0, 1)
        or not isinstance(fact.at_most, str)
        or fact.at_most.isspace()
    ):
        raise CalibError(
            f"known has {fact!r}",
            where=where,
            expected=f"a tuple of Known(output, sign, ...), output one of "
            f"{', '.join(effect.outputs)}, sign -1, 0 or 1, at_most words",
            hint='write known = (Known("pull", -1, zero_at=("slip",)),), with the comma; '
            'at_most="the pull that there is"',
        )
    for attribute in ("zero_at", "grows_with"):
        check_tuple(attribute, getattr(fact, attribute), where)
        for name in getattr(fact, attribute):
            _check_name(name, attribute, conditions, where)


def _check_name(name: str, attribute: str, known: Collection[str], where: str) -> None:
    if name not in known:
        raise CalibError(
            f"unknown name {name!r} in {attribute}",
            where=where,
            expected=", ".join(known),
            hint=_role_of_column(name) or meant(name, known),
        )


def _check_attribute(name: str, value: object, where: str) -> None:
    if name in _METHODS and not callable(value):
        raise CalibError(
            f"the method {name} is {_described(value)}",
            where=where,
            expected="a function",
            hint=f"write def {name}(self, ...)",
        )
    if name.startswith("_") or name in _BASE:
        return
    if callable(value):
        raise CalibError(
            f"the method {name} is none of an effect's, so nothing would call it",
            where=where,
            expected=", ".join(_METHODS),
            hint=f"{meant(name, _METHODS)} (a helper's name starts with an underscore)",
        )
    if difflib.get_close_matches(name, _BASE, cutoff=0.8):
        raise CalibError(
            f"the attribute {name} is none of an effect's",
            where=where,
            expected=", ".join(_BASE),
            hint=f"{meant(name, _BASE)} (a constant's name starts with an underscore)",
        )


def _check_testable(effect: Effect, data: Campaigns) -> None:
    hypothesis = Hypothesis(effect.name, (effect,), (effect_priors(data, effect),))
    units = dict.fromkeys(data.names, 1.0)
    forward = _call(Forward, effect, data, hypothesis, units)
    psi = forward.priors.sample(generator(0, "gap", "effect check", effect.name), 8)
    phi = hypothesis.effect_priors[0].to_natural(psi[:, forward.phi_slices[0]])
    with np.errstate(all="ignore"):
        plain = forward.simulator(psi, data.view)
        base = {o.role: o.problem.bound.from_response(plain[o.name]) for o in data.outputs}
        view = replace(data.view, base=base)
        changed = [
            _changes_conditions(effect, phi, o, view)
            | _changes_output(effect, phi, o, plain[o.name], view)
            for o in data.outputs
        ]
    if not any(changed):
        raise CalibError(
            "it changes nothing on this case",
            where=_place(effect),
            expected=f"on_conditions or on_output that changes {' or '.join(effect.outputs)}",
            hint="correct it, or let not_testable say why the case cannot show it",
        )


def _changes_conditions(effect: Effect, phi: Array, o: OutputData, view: View) -> bool:
    where = _place(effect)
    selected = o.problem.bound.model.select(view.conditions)
    given = {role_of(column): values for column, values in selected.items()}
    found = _call(effect.on_conditions, effect, phi, o.role, dict(given), view)
    if not isinstance(found, dict) or set(found) != set(given):
        raise _wrong(
            f"on_conditions returned {_described(found)} for {o.name}",
            where,
            f"a dict with {', '.join(given)}",
        )
    n = view.slip().size
    for name, values in found.items():
        _check_numbers(values, ((n,), (phi.shape[0], n)), f"on_conditions, {name}", where)
    return any(not np.array_equal(found[name], given[name]) for name in given)


def _changes_output(effect: Effect, phi: Array, o: OutputData, plain: Array, view: View) -> bool:
    where = _place(effect)
    handed = plain.copy()
    found = _call(effect.on_output, effect, phi, o.role, handed, view)
    _check_kept(handed, plain, "on_output", where)
    _check_numbers(found, (plain.shape,), f"on_output for {o.name}", where)
    if not np.isfinite(found[np.isfinite(plain)]).any():
        raise _wrong(
            f"on_output returned no finite number for {o.name}",
            where,
            "numbers wherever the mean response is one",
        )
    if any(fact.at_most and fact.output == o.role for fact in effect.known):
        _check_most(effect, phi, o, handed, view)
    sign = next((fact.sign for fact in effect.known if fact.output == o.role), 0)
    added = sign * (found - plain)
    if (added < -1e-9 * np.abs(plain)).any():
        raise _wrong(
            f"on_output adds {sign * np.nanmin(added):.3g} to {o.name} at some draw of its prior",
            where,
            f"{'nothing below' if sign > 0 else 'nothing above'} zero, as known says",
        )
    return not np.array_equal(found, plain, equal_nan=True)


def _check_most(effect: Effect, phi: Array, o: OutputData, plain: Array, view: View) -> None:
    where = _place(effect)
    handed = plain.copy()
    most = _call(effect.most, effect, phi, o.role, handed, view)
    _check_kept(handed, plain, "most", where)
    _check_numbers(most, (plain.shape,), f"most for {o.name}", where)
    if not (most[np.isfinite(plain)] >= 0.0).all():
        raise _wrong(
            f"most returned {np.min(most):.3g} for {o.name} at some draw of its prior",
            where,
            "numbers from zero on, wherever the mean response is one",
        )


def _check_kept(handed: Array, plain: Array, method: str, where: str) -> None:
    if not np.array_equal(handed, plain, equal_nan=True):
        raise CalibError(
            f"{method} changes the mean response it is given",
            where=where,
            expected="a new array",
            hint="write mean_response = mean_response + ... instead of mean_response += ...",
        )


def _check_numbers(
    found: object, shapes: tuple[tuple[int, ...], ...], what: str, where: str
) -> None:
    right = isinstance(found, np.ndarray) and found.shape in shapes and found.dtype.kind in "fiu"
    if not right:
        raise _wrong(
            f"{what} returned {_described(found)}",
            where,
            f"an array of numbers of shape {' or '.join(map(str, shapes))}: "
            "draws by rows of the field",
        )


def _wrong(message: str, where: str, allowed: str) -> CalibError:
    return CalibError(
        message,
        where=where,
        expected=allowed,
        hint="correct it; phi[:, :1] is the first parameter as a column, (draws, 1)",
    )


def _described(found: object) -> str:
    if isinstance(found, np.ndarray):
        return f"an array of {found.dtype} of shape {found.shape}"
    return f"a dict with {', '.join(found)}" if isinstance(found, dict) else type(found).__name__


def _call[R](function: Callable[..., R], effect: Effect, *args: Any) -> R:
    """Call what a user wrote; its exceptions are theirs to mend, at the line they come from."""
    try:
        return function(*args)
    except CalibError:
        raise
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        path = Path(declared_in(type(effect))).resolve()
        line = next(
            (f.lineno for f in reversed(frames) if Path(f.filename).resolve() == path), None
        )
        at = _place(effect) if line is None else f"{_place(effect)}, line {line}"
        raise CalibError(
            f"it does not run: {type(error).__name__}: {error}",
            where=at,
            hint='correct it; view.of(role) gives what the data record, such as view.of("slip")',
        ) from error


def _role_of_column(name: str) -> str:
    """Name the physical role that goes by a column's or an output's name."""
    roles = [q.physical for c, q in QUANTITIES.items() if name in (c, q.stem)]
    return f"effects know {name} by its physical role, {roles[0]!r}" if roles else ""


def _place(effect: Effect) -> str:
    return f"{declared_in(type(effect))}, effect {effect.name}"


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
                    f"the effect {effect.name} has no priors",
                    where=str(beside),
                    hint="write this file after the example of priors/effects/rate_effect.toml",
                )
            found[effect.name] = effect
    if not found:
        raise CalibError(
            "the file defines no effect",
            where=str(path),
            expected="a subclass of calib.gap.effects.Effect with a name",
        )
    return found
