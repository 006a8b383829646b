"""All effects of the contract that the independent reality can make, and what each needs."""

from __future__ import annotations

from calib.errors import CalibError
from challenge import effects_ground, effects_instruments, unlisted
from challenge.design import Needs
from challenge.mechanism import DENSITY, EffectKind

LISTED: dict[str, EffectKind] = {
    kind.name: kind for kind in (*effects_instruments.KINDS, *effects_ground.KINDS)
}
UNLISTED: tuple[EffectKind, ...] = unlisted.KINDS

# A recalibrated model absorbs these (nearly) whole: a gauge's gain is another pressure
# dependence, a probe's gain another constant. Only their simplicity tells them apart.
ABSORBABLE = frozenset(
    {"pressure_gauge_bias", "load_transfer", "cone_index_bias", "water_content_bias"}
)
_OF_THE_WHEEL = tuple(name for name, kind in LISTED.items() if DENSITY not in kind.outputs)


def kind_of(name: str) -> EffectKind:
    """Return the listed effect of a name.

    Raises
    ------
    CalibError
        If the reality has no such effect.
    """
    if name not in LISTED:
        raise CalibError(
            f"the challenge has no effect named {name!r}",
            expected=", ".join(sorted(LISTED)),
            hint="use one of these names",
        )
    return LISTED[name]


def wheel_effects() -> tuple[str, ...]:
    """Return the listed effects that act on a wheel, which can be paired."""
    return _OF_THE_WHEEL


def needs_of(kinds: tuple[EffectKind, ...]) -> Needs:
    """Return what a design needs so that all of some effects can act."""
    sinkage = any(kind.name == "slip_sinkage" for kind in kinds)
    return Needs(
        outputs=tuple(kind.outputs for kind in kinds),
        varies=tuple(name for kind in kinds for name in kind.varies),
        # The modified Bekker model has slip sinkage already; plain Bekker lacks it.
        rut_model="bekker" if sinkage else None,
    )


def acts_on(kind: EffectKind, outputs: tuple[str, ...], varying: tuple[str, ...]) -> bool:
    """Whether an effect can show on a design."""
    return bool(set(kind.outputs) & set(outputs)) and set(kind.varies) <= set(varying)
