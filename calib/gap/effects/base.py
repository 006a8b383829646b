"""What an effect is: something the simulator does not model, acting in the field only.

An effect may act on the conditions a model is given (a wrong gauge), on the prediction itself (a
force that is added), or both, for every output it physically touches. To add one, write a class
like those in this folder and a prior file of its name; see `docs` in the README.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from calib.models.base import Array

__all__ = ["Effect", "View", "saturating"]

DRAWBAR, RUT, DENSITY = "drawbar_pull", "rut_depth", "bulk_density"


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
        The simulator's prediction of each modelled output (kN, mm, g/cm^3) before any effect.
    """

    conditions: Mapping[str, Array]
    lab: Mapping[str, float]
    load_kn: float
    ground_exponent: float
    order_range: tuple[float, float]
    base: Mapping[str, Array] = field(default_factory=dict)

    def slip(self) -> Array:
        """Recorded slip (fraction), zero where it is not recorded, shape (n,)."""
        n = next(iter(self.conditions.values())).size
        return self.conditions.get("slip_ratio", np.zeros(n))

    def sinkage(self) -> Array:
        """Sinkage over 30 mm: the simulator's where rut depth is modelled, else 1 + slip."""
        if RUT in self.base:
            return self.base[RUT] / 30.0
        return (1.0 + np.maximum(self.slip(), 0.0))[None, :]


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
    parameters : tuple of str
        In the order of the columns of `phi`.
    outputs : tuple of str
        Outputs it touches.
    needs : tuple of str
        Those of them without which its trace in the others would be another effect's as well.
    covariates : tuple of str
        Columns it needs.
    varies : bool
        Whether the (first) covariate must vary in the field, or differ from the laboratory's.
    form : tuple of {"size", "slip", "pressure", "cone", "water", "shape", "extrapolation"}
        Along what its size may depart from its formula, by the form error of the diagnosis
        (extrapolation: along inflation pressure, to values the simulator was not fitted at);
        empty where the formula is exact.
    prior_file : Path, optional
        Where its priors are, if not among the shipped ones.
    """

    name: str = ""
    title: str = ""
    parameters: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    covariates: tuple[str, ...] = ()
    varies: bool = True
    form: tuple[str, ...] = ()
    prior_file: Path | None = None

    def on_conditions(
        self,
        phi: Array,
        output: str,
        conditions: dict[str, Array],
        view: View,
    ) -> dict[str, Array]:
        """Return the conditions that truly held, each of shape (n,) or (k, n).

        Parameters
        ----------
        phi : ndarray, shape (k, n_parameters)
        output : str
            The output about to be predicted.
        conditions : dict
            Conditions of the output's model, possibly changed by other effects.
        view : View
        """
        return conditions

    def on_output(self, phi: Array, output: str, location: Array, view: View) -> Array:
        """Return the prediction with the effect in it, shape (k, n).

        Parameters
        ----------
        phi : ndarray, shape (k, n_parameters)
        output : str
        location : ndarray, shape (k, n)
            On the scale of the response: kN, ln mm, g/cm^3.
        view : View
        """
        return location

    def shape(self, view: View) -> Array | None:
        """Return the covariate along which the effect's form is least certain, shape (n,)."""
        return None

    def not_testable(self, view: View, outputs: tuple[str, ...]) -> str | None:
        """Say why a data set cannot show this effect; None if it can.

        Parameters
        ----------
        view : View
        outputs : tuple of str
            Outputs that the case models.
        """
        if not set(self.outputs) & set(outputs):
            return f"no {' or '.join(self.outputs)} output"
        unseen = [o for o in self.needs if o not in outputs]
        if unseen:
            return f"no {' and '.join(unseen)} output"
        missing = [c for c in self.covariates if c not in view.conditions]
        if missing:
            return f"the data lack {', '.join(missing)}"
        if self.varies and self.covariates:
            values = view.conditions[self.covariates[0]]
            reference = view.lab.get(self.covariates[0], float(values[0]))
            if np.allclose(values, reference, rtol=1e-6, atol=1e-12):
                return f"{self.covariates[0]} is the same in every row, as in the calibration"
        return None
