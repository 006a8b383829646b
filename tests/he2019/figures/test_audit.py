"""Figures of the audit: all there, labelled, and saying what the findings say."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from calib.he2019.figures import audit_plates

UNIT = re.compile(r"\(.+\)$")


@pytest.fixture(scope="module")
def drawn(audit):
    return {p.name: p for p in audit_plates(audit)}


def test_all_are_drawn(drawn):
    assert [p.caption for p in drawn.values() if p.figure is None] == []
    assert list(drawn) == [
        "audit_costs", "audit_digits", "audit_rut", "audit_chord", "audit_signs",
    ]  # fmt: skip
    assert all(p.heading and p.caption.endswith(".") for p in drawn.values())


def test_axes_have_units_and_figures_a_legend(drawn):
    for p in drawn.values():
        assert p.figure.legends
        for ax in p.figure.axes:
            for label in (ax.get_xlabel(), ax.get_ylabel()):
                assert not label or UNIT.search(label), (p.name, label)


def test_the_range_drawn_is_the_range_found(audit, drawn):
    for ax, psi in zip(drawn["audit_digits"].figure.axes, audit.rounding.allowed, strict=True):
        (band,) = ax.collections
        y = band.get_paths()[0].vertices[:, 1]
        assert y.max() == pytest.approx(float(audit.rounding.allowed[psi].upper.max()))
        assert y.min() == pytest.approx(float(audit.rounding.allowed[psi].lower.min()), abs=1e-9)


def test_one_dot_for_each_seed(audit, drawn):
    runs = drawn["audit_costs"].figure.axes[1]
    dots = [line.get_xdata() for line in runs.lines if line.get_marker() == "o"]
    assert [d.size for d in dots] == [s.costs.size for s in audit.genetic.searches]


def test_captions_quote_the_findings(audit, drawn):
    assert audit["table5_joint_cost"].evidence in drawn["audit_costs"].caption
    assert "reconstructed data" in drawn["audit_rut"].caption


def test_one_that_fails_does_not_stop_the_rest(audit):
    broken = replace(audit, quality=replace(audit.quality, n=np.array([])))
    found = {p.name: p for p in audit_plates(broken)}
    assert found["audit_rut"].figure is None
    assert "could not be drawn" in found["audit_rut"].caption
    assert found["audit_digits"].figure is not None
