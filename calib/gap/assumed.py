"""What the effects of a hypothesis take for the calibration's where it was not recorded there."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from calib.gap.effects import View
from calib.gap.fit import Fit


@dataclass(frozen=True)
class _Asked(View):
    """A view that notes which defaults its effects have used."""

    defaults: dict[str, float] = field(default_factory=dict)

    def lab_of(self, role: str, otherwise: float | None = None) -> float:
        """Return the median in the calibration data, and note where there is none."""
        column, value = self.column(role) or role, super().lab_of(role, otherwise)
        if column not in self.lab:
            self.defaults[column] = value
        return value


def assumed(fit: Fit) -> dict[str, float]:
    """Return what a hypothesis assumes of the calibration, by canonical column, in its unit.

    Where the assumption is wrong, the whole field differs from what its effects say by a constant
    factor or offset, which another cause may then be named for.
    """
    view = fit.forward.data.view
    asked = _Asked(**{f.name: getattr(view, f.name) for f in fields(View)})
    fit.forward.field(fit.psi[None], asked)
    return dict(asked.defaults)
