"""What an effect is: something the simulator does not model, acting in the field only.

An effect may act on the conditions a model is given (a wrong gauge), on the prediction itself (a
force that is added), or both, for every output it physically touches. It knows outputs and
conditions by their physical roles (`calib.data.quantities.Quantity.physical`), not by columns, so
that it acts on whatever has the role. To add one, write a class like those in this folder and a
prior file of its name.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.quantities import QUANTITIES, columns_of
from calib.models.base import Array

# Conditions of a model by physical role, each of shape (n,) or (k, n).
type Conditions = dict[str, Array]


@dataclass(frozen=True)
class Known:
    """What physics says of what an effect adds to an output, whatever its formula.

    A formula is the centre of a family of shapes: what the effect adds is the formula's times a
    factor that varies with the conditions (its form error) and is never negative. So the sign, the
    zeros and the bound that are stated here hold for the whole family.

    Parameters
    ----------
    output : str
        Its physical role.
    sign : {-1, 0, 1}
        Of what it adds; 0 where either is possible.
    zero_at : tuple of str
        Physical roles of conditions without which it adds nothing: at no slip, and of any other
        condition at the laboratory's value.
    grows_with : tuple of str
        Physical roles of conditions with which what the formula adds does not shrink.
    at_most : str
        What it can take no more of an output than, in words, if anything bounds it: `Effect.most`
        is how much that is.
    """

    output: str
    sign: int = 0
    zero_at: tuple[str, ...] = ()
    grows_with: tuple[str, ...] = ()
    at_most: str = ""


@dataclass(frozen=True)
class View:
    """What an effect can see of a campaign.

    Parameters
    ----------
    conditions : mapping of str to ndarray, shape (n,)
        Recorded conditions and covariates of the rows, in canonical columns.
    lab : mapping of str to float
        Median of every condition in the calibration data.
    load_kn : float
        Typical normal load, the scale of forces.
    ground_exponent : float
        d ln(average ground pressure)/d ln(inflation pressure) over the data.
    order_range : tuple of float
        First and last run order of the field campaign.
    base : mapping of str to ndarray, shape (k, n)
        The simulator's prediction of each modelled output, by role, in its canonical unit and
        before any effect.
    """

    conditions: Mapping[str, Array]
    lab: Mapping[str, float]
    load_kn: float
    ground_exponent: float
    order_range: tuple[float, float]
    base: Mapping[str, Array] = field(default_factory=dict)

    def column(self, role: str) -> str | None:
        """Return the recorded column of a physical role; None if there is none."""
        return next((c for c in (*columns_of(role), role) if c in self.conditions), None)

    def of(self, role: str) -> Array:
        """Return recorded values by their physical role, shape (n,)."""
        return self.conditions[self.column(role) or role]

    def lab_of(self, role: str, otherwise: float | None = None) -> float:
        """Return the median in the calibration data by its physical role; by default the field's.

        That is for what the calibration did not record.
        """
        column = self.column(role) or role
        if column in self.lab:
            return self.lab[column]
        return float(np.median(self.conditions[column])) if otherwise is None else otherwise

    def with_base(self, base: Mapping[str, Array]) -> View:
        """Return the same campaign with other predictions."""
        return replace(self, base=base)

    def slip(self) -> Array:
        """Recorded slip (fraction), zero where it is not recorded, shape (n,)."""
        column = self.column("slip")
        if column is not None:
            return self.conditions[column]
        return np.zeros(next(iter(self.conditions.values())).size)

    def sinkage(self) -> Array:
        """Sinkage over 30 mm: the simulator's where rut depth is modelled, else 1 + slip."""
        if "sinkage" in self.base:
            return self.base["sinkage"] / 30.0
        return (1.0 + np.maximum(self.slip(), 0.0))[None, :]


@cache
def _words() -> dict[str, dict[str, Any]]:
    text = files("calib.gap.effects").joinpath("words.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def words(name: str) -> tuple[str, tuple[str, ...], str]:
    """Return title, equations and check of a shipped effect."""
    found = _words()[name]
    return found["title"], tuple(found["latex"]), found.get("check", "zero and span")


def each(phi: Array) -> Array:
    """Parameters of draws (k, n_parameters), to be unpacked: columns (k, 1) beside the rows."""
    return phi.T[:, :, None]


def saturating(u: Array, exponent: Array, half_way: Array) -> Array:
    """Growth from 0 at 0 to 1 at 1: a power at first, levelling off beyond `half_way`.

    Parameters
    ----------
    u : ndarray, shape (n,)
        Positive.
    exponent, half_way : ndarray, shape (k, 1)
        A large `half_way` leaves a plain power; a large exponent makes a step at it.

    Returns
    -------
    ndarray, shape (k, n)
    """
    grown = u**exponent
    half = half_way**exponent
    return np.asarray((1.0 + half) * grown / (grown + half))


class Effect:
    """Base of all effects: by default it does nothing.

    Attributes
    ----------
    name : str
        Its name in a diagnosis and of its prior file.
    title : str
        What happens, in a few words.
    latex : tuple of str
        What it changes, words with mathematics between dollars: quantities that truly held in the
        field have the subscript f.
    parameters : tuple of str
        In the order of the columns of `phi`.
    outputs : tuple of str
        Physical roles of the outputs it touches: ``"pull"``, ``"sinkage"``, ``"density"``, ...
    needs : tuple of str
        Those of them without which its trace in the others would be another effect's as well.
    covariates : tuple of str
        Physical roles of what it needs recorded.
    varies : bool
        Whether the (first) covariate, if any, must vary in the field, or differ from the
        laboratory's.
    form : tuple of {"size", "slip", "pressure", "cone", "water", "shape", "extrapolation"}
        Along what its size may depart from its formula, by the form error of the diagnosis
        (extrapolation: along inflation pressure, to values the simulator was not fitted at);
        empty where the formula is exact.
    known : tuple of Known
        What is known of its shape, an entry for each output of which anything is.
    instrument : bool
        Whether an instrument is at fault, not wheel or soil; predicted with it is what it reads.
    seldom : bool
        Whether it is tried by itself only, and less probable than others beforehand; if it goes by
        run order, where the readings do.
    check : str
        How such an instrument is checked, in words.
    device : str
        The instrument, if other effects are faults of the same: one check settles them all.
    priors : str
        Its priors as the text of a prior file, if they are in no file.
    prior_file : Path, optional
        Where its priors are, if not among the shipped ones.
    """

    name: str = ""
    title: str = ""
    latex: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    covariates: tuple[str, ...] = ()
    varies: bool = True
    form: tuple[str, ...] = ()
    known: tuple[Known, ...] = ()
    instrument: bool = False
    seldom: bool = False
    check: str = "zero and span"
    device: str = ""
    priors: str = ""
    prior_file: Path | None = None

    def on_conditions(
        self, phi: Array, output: str, conditions: Conditions, view: View
    ) -> Conditions:
        """Return the conditions that truly held, each of shape (n,) or (k, n).

        Parameters
        ----------
        phi : ndarray, shape (k, n_parameters)
        output : str
            Physical role of the output about to be predicted.
        conditions : dict
            Conditions of the output's model by physical role, possibly changed by other effects.
        """
        return conditions

    def on_output(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Return the prediction with the effect in it, shape (k, n).

        Parameters
        ----------
        phi : ndarray, shape (k, n_parameters)
        output : str
            Its physical role.
        mean_response : ndarray, shape (k, n)
            On the scale of the response: kN, ln mm, g/cm^3.
        """
        return mean_response

    def most(self, phi: Array, output: str, mean_response: Array, view: View) -> Array:
        """Return the most that it can take of an output that it bounds, shape (k, n).

        By default all of a positive output. Parameters are those of `on_output`.
        """
        return np.maximum(mean_response, 0.0)

    def shape(self, view: View) -> Array | None:
        """Return the covariate along which the effect's form is least certain, shape (n,)."""
        return None

    def not_testable(self, view: View, outputs: tuple[str, ...]) -> str | None:
        """Say why a data set cannot show this effect; None if it can.

        Parameters
        ----------
        outputs : tuple of str
            Physical roles of the outputs that the case models.
        """
        if unseen := self._unseen(outputs):
            return f"no {unseen} output"
        if missing := self._unrecorded(view):
            return f"the data lack {', '.join(missing)}"
        if column := self._still(view):
            absent = "and the calibration has no such column"
            compared = "as in the calibration" if column in view.lab else absent
            return f"{column} is the same in every row, {compared}"
        return None

    def lacking(self, view: View, outputs: tuple[str, ...]) -> list[str]:
        """Name the columns for want of which alone the data cannot show this effect.

        Those that are not recorded, or else one that does not vary in the field and is not recorded
        in the calibration, from which it may differ. Parameters are those of `not_testable`.
        """
        if self._unseen(outputs):
            return []
        still = self._still(view)
        return self._unrecorded(view) or ([still] if still and still not in view.lab else [])

    def _unseen(self, outputs: tuple[str, ...]) -> str:
        """Name the outputs that it would have to be seen in and that are not there."""
        if not set(self.outputs) & set(outputs):
            return " or ".join(map(_named, self.outputs))
        return " and ".join(_named(o) for o in self.needs if o not in outputs)

    def _unrecorded(self, view: View) -> list[str]:
        return [(*columns_of(c), c)[0] for c in self.covariates if view.column(c) is None]

    def _still(self, view: View) -> str | None:
        """Return the column that would have to vary and has the calibration's median throughout."""
        column = view.column(self.covariates[0]) if self.varies and self.covariates else None
        if column is None:
            return None
        values = view.conditions[column]
        reference = view.lab.get(column, float(values[0]))
        return column if np.allclose(values, reference, rtol=1e-6, atol=1e-12) else None

    def register(self) -> None:
        """Make the effect known to every diagnosis.

        Raises
        ------
        CalibError
            If its declaration does not hold together, or there is another one of its name.
        """
        from calib.gap.effects import EFFECTS
        from calib.gap.effects.user import check_declared

        check_declared(self)
        EFFECTS.add(self)


def _named(role: str) -> str:
    """Name the outputs that have a role as results do."""
    names = [QUANTITIES[c].stem for c in columns_of(role) if QUANTITIES[c].role == "output"]
    return " or ".join(names) or role
