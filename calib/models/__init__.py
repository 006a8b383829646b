"""The six models, one equation set per file, by name in `MODELS`."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from calib.errors import CalibError
from calib.models.ayers_perumpral import AYERS_PERUMPRAL, AYERS_PERUMPRAL_VOLUMETRIC
from calib.models.base import Array, BoundModel, Conditions, Model, References
from calib.models.bekker import BEKKER, MODIFIED_BEKKER
from calib.models.magic_formula import MAGIC_FORMULA
from calib.models.magic_formula_pressure import MAGIC_FORMULA_PRESSURE

__all__ = [
    "MODELS", "Array", "BoundModel", "Conditions", "Model", "References", "get_model",
]  # fmt: skip

MODELS: Mapping[str, Model] = MappingProxyType(
    {
        model.name: model
        for model in (
            AYERS_PERUMPRAL,
            AYERS_PERUMPRAL_VOLUMETRIC,
            MAGIC_FORMULA,
            MAGIC_FORMULA_PRESSURE,
            BEKKER,
            MODIFIED_BEKKER,
        )
    }
)


def get_model(name: str) -> Model:
    """Return a model by its name.

    Raises
    ------
    CalibError
        If there is none of that name.
    """
    if name not in MODELS:
        raise CalibError(
            f"there is no model {name!r}",
            allowed=", ".join(MODELS),
            mend="use one of these names",
        )
    return MODELS[name]
