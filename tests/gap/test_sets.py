"""Sets of causes: what is shared is kept, what promises most comes first, small parts are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.data import table_from_arrays
from calib.data.quantities import OUTPUTS, physical_role
from calib.gap.campaigns import campaigns
from calib.gap.case import Case
from calib.gap.effects import EFFECTS
from calib.gap.mixture import inclusion_probability
from calib.gap.ranking import rank
from tests.gap.cases import CHOICE, LARGE, make_case, parameters

CAUSES = ("rate_effect", "rut_rebound", "sensor_drift")


def mixed_case() -> Case:
    """Return a campaign in which three effects act, one on both outputs."""
    case = make_case("rate_effect")
    view = campaigns(case).view
    columns = dict(case.field.columns)
    for name in ("rut_rebound", "sensor_drift"):
        for output in case.models:
            if physical_role(output) in EFFECTS[name].outputs:
                column = OUTPUTS[output]
                phi = parameters(name, LARGE[name])
                log = output == "rut_depth"
                reading = np.log(columns[column]) if log else columns[column]
                read = EFFECTS[name].on_output(phi, physical_role(output), reading[None], view)[0]
                columns[column] = np.exp(read) if log else read
    return replace(case, name="mixed", field=table_from_arrays(columns))


def test_three_causes_are_found_whatever_comes_first_alone():
    ranking = rank(campaigns(mixed_case()), 1, effects=CHOICE)
    found = inclusion_probability(ranking.probability)
    assert [name for name in sorted(found) if found[name] >= 0.5] == list(CAUSES)
    # A set once, whatever it was made of: a second fit would count its evidence twice.
    assert len(ranking.fits["+".join(CAUSES)]) == 1
