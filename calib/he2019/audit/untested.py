"""What is printed and cannot be tested at all, so that nothing is passed over in silence."""

from __future__ import annotations

from calib.he2019.audit.finding import Basis, Finding, Verdict
from calib.he2019.datasets.published import Published


def untested(published: Published) -> Finding:
    """Name the figures of the test description that no other figure bears on."""
    setup = published.setup
    return Finding(
        "test_description", "Not testable", "test description",
        (
            "Setup: tyre_width_mm", "Setup: speed_m_s", "Setup: slip_levels",
            *(f"Setup: named slip {i}" for i in range(1, len(setup.named_slips) + 1)),
            "Setup: rebound_slip", "Setup: largest_water_content",
        ),
        f"a tyre {setup.tyre_width_mm.text} mm wide at {setup.speed_m_s.text} m/s, "
        f"{setup.slip_levels.text} slip levels, water contents up to "
        f"{100.0 * setup.largest_water_content.value:g} %, rebound above "
        f"{100.0 * setup.rebound_slip.value:g} % slip",
        "none: no other printed figure depends on them",
        (), Verdict.UNTESTABLE,
        "They describe the tests; the slip levels and the shift of zero slip are printed in part "
        "only, and several verdicts depend on them.",
        "The raw measurements (Part I of the source).", Basis.PRINTED,
    )  # fmt: skip
