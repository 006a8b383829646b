"""The conditions of every run."""

from __future__ import annotations

import numpy as np

from calib.inference.design import choose_nodes

SLIP = np.array([0.05, 0.1, 0.1, 0.4])


def test_the_data_are_among_them_and_their_box_is_filled() -> None:
    nodes = choose_nodes([{"slip_ratio": SLIP}, {"slip_ratio": np.array([0.6])}], {})
    found = nodes["slip_ratio"]
    assert np.isin(np.round([0.05, 0.1, 0.4, 0.6], 9), np.round(found, 9)).all()
    assert np.unique(found).size == found.size == 24
    # Never across zero, a margin above.
    assert found.min() >= 0.0
    assert 0.6 < found.max() < 0.7
    assert np.diff(np.sort(found)).max() < 0.08


def test_a_margin_changes_the_sign_only_if_asked_to() -> None:
    small = SLIP - 0.04
    assert choose_nodes([{"slip_ratio": small}], {})["slip_ratio"].min() >= 0.0
    found = choose_nodes([{"slip_ratio": small}], {}, across_zero=True)["slip_ratio"]
    assert -0.1 < found.min() < 0.0
    positive = choose_nodes([{"normal_load_kn": SLIP}], {}, across_zero=True)["normal_load_kn"]
    assert positive.min() > 0.0


def test_given_ranges_are_spanned() -> None:
    nodes = choose_nodes([{"slip_ratio": SLIP}], {"slip_ratio": (-0.1, 0.9)})
    np.testing.assert_allclose([nodes["slip_ratio"].min(), nodes["slip_ratio"].max()], [-0.1, 0.9])


def test_what_did_not_vary_stays() -> None:
    nodes = choose_nodes([{"slip_ratio": SLIP, "normal_load_kn": np.full(4, 5.0)}], {})
    assert set(nodes["normal_load_kn"]) == {5.0}


def test_whole_numbers_stay_whole() -> None:
    nodes = choose_nodes([{"slip_ratio": SLIP, "pass_number": np.array([1.0, 2, 3, 1])}], {})
    np.testing.assert_array_equal(nodes["pass_number"], np.round(nodes["pass_number"]))


def test_long_data_are_thinned() -> None:
    nodes = choose_nodes([{"slip_ratio": np.linspace(0.0, 0.5, 5000)}], {})
    assert nodes["slip_ratio"].size <= 160
