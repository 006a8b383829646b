"""Example CSV files, one per model, for `calib template MODEL`: made-up values to write over.

The values are of the size of a 225 mm tyre in sandy loam; they are not measurements.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from calib.errors import CalibError

__all__ = ["template_csv"]

_TEMPLATES: Mapping[str, str] = MappingProxyType(
    {
        "ayers_perumpral": """\
cone_index_kpa,gravimetric_water_content,bulk_density_g_cm3
350,0.030,1.809
520,0.045,1.853
680,0.050,1.870
900,0.040,1.866
1150,0.060,1.865
1400,0.070,1.888
1750,0.055,1.899
2100,0.085,1.925
""",
        "ayers_perumpral_volumetric": """\
cone_index_kpa,volumetric_water_content,bulk_density_g_cm3
350,0.054,1.809
520,0.083,1.853
680,0.094,1.870
900,0.075,1.866
1150,0.112,1.865
1400,0.132,1.888
1750,0.104,1.899
2100,0.164,1.925
""",
        "magic_formula": """\
slip_ratio,normal_load_kn,drawbar_pull_kn
0.00,5.0,0.02
0.05,5.0,0.55
0.10,5.0,0.94
0.15,5.0,0.98
0.20,5.0,0.90
0.30,5.0,0.78
0.45,5.0,0.67
0.60,5.0,0.66
""",
        "magic_formula_pressure": """\
slip_ratio,inflation_pressure_psi,normal_load_kn,drawbar_pull_kn
0.00,18,5.0,-0.03
0.05,18,5.0,1.02
0.10,18,5.0,1.44
0.15,18,5.0,1.61
0.20,18,5.0,1.64
0.30,18,5.0,1.56
0.45,18,5.0,1.43
0.60,18,5.0,1.37
0.00,30,5.0,0.02
0.05,30,5.0,0.61
0.10,30,5.0,0.98
0.20,30,5.0,0.90
0.40,30,5.0,0.74
0.60,30,5.0,0.69
0.00,42,5.0,0.01
0.05,42,5.0,0.57
0.10,42,5.0,0.57
0.15,42,5.0,0.52
0.20,42,5.0,0.50
0.30,42,5.0,0.47
0.45,42,5.0,0.46
0.60,42,5.0,0.43
""",
        "bekker": """\
average_ground_pressure_kpa,rut_depth_mm
60,13.6
85,15.9
107,18.2
141,19.8
178,23.0
220,24.9
""",
        "modified_bekker": """\
slip_ratio,average_ground_pressure_kpa,rut_depth_mm
0.00,107,17.7
0.10,107,23.2
0.20,107,30.3
0.00,141,20.3
0.10,141,25.6
0.20,141,33.0
0.00,178,22.2
0.10,178,28.5
0.20,178,36.5
""",
    }
)


def template_csv(model_name: str) -> str:
    """Return an example of the data a model is calibrated on.

    Parameters
    ----------
    model_name : str
        Name of the model, such as ``"magic_formula_pressure"``.

    Returns
    -------
    str
        A CSV with the units in the column names; any other unit in `calib.data.quantities` may
        stand in their place.

    Raises
    ------
    CalibError
        If there is no template of that name.
    """
    if model_name not in _TEMPLATES:
        raise CalibError(
            f"there is no template for a model {model_name!r}",
            allowed=", ".join(_TEMPLATES),
            mend="use one of these names",
        )
    return _TEMPLATES[model_name]
