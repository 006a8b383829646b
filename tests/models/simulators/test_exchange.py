"""What commands read and write."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest

from calib.errors import CalibError
from calib.models.simulators.base import Failure
from calib.models.simulators.ways import (
    check_template,
    filled,
    input_csv,
    input_json,
    output_of_text,
)

PARAMETERS = {"mu": 0.1 + 0.2, "n": 1.0}
CONDITIONS = {"slip": np.array([0.1, 0.2]), "load": np.array([3.0, 4.0])}


def test_json_holds_every_digit() -> None:
    found = json.loads(input_json(PARAMETERS, CONDITIONS))
    assert found["parameters"] == PARAMETERS
    assert found["conditions"] == {"slip": [0.1, 0.2], "load": [3.0, 4.0]}


def test_csv_repeats_the_parameters() -> None:
    rows = list(csv.DictReader(io.StringIO(input_csv(PARAMETERS, CONDITIONS))))
    assert [float(row["mu"]) for row in rows] == [PARAMETERS["mu"]] * 2
    assert [float(row["load"]) for row in rows] == [3.0, 4.0]


def test_a_template_is_filled() -> None:
    template = "friction @mu@\nexponent=@n@\nslips @slip@\nload @load@\n"
    names = (*PARAMETERS, *CONDITIONS)
    check_template(template, names, "wheel.inp")
    text = filled(template, PARAMETERS, CONDITIONS)
    assert text.splitlines()[2:] == ["slips 0.1 0.2", "load 3.0 4.0"]
    assert float(text.splitlines()[0].split()[1]) == PARAMETERS["mu"]


@pytest.mark.parametrize(
    ("template", "word"),
    [("@mu@ @slip@ @load@", "no place for n"), ("@mu@ @n@ @slip@ @load@ @k@", "unknown @k@")],
)
def test_a_template_must_have_a_place_for_each(template: str, word: str) -> None:
    with pytest.raises(CalibError, match=word) as caught:
        check_template(template, (*PARAMETERS, *CONDITIONS), "wheel.inp")
    assert "wheel.inp" in str(caught.value)


@pytest.mark.parametrize(
    ("how", "text"),
    [
        ("json", '{"pull": [1.5, -2], "note": "a", "more": {"a": 1}}'),
        ("csv", "pull,note\n1.5,a\n-2.0,b\n"),
        ("pattern", "step 1\n Fx = 1.5 kN\nstep 2\n Fx = -2.0 kN\n"),
    ],
)
def test_outputs_are_read(how: str, text: str) -> None:
    found = output_of_text(text, how, {"pull": r"Fx = (\S+)"}) if how != "json" else None
    if how == "json":
        # A word is no number: the whole is refused, unless the word is left out.
        assert isinstance(output_of_text(text, how, {}), Failure)
        found = output_of_text(text.replace('"note": "a", ', ""), how, {})
    assert not isinstance(found, Failure)
    assert found is not None
    np.testing.assert_allclose(found["pull"], [1.5, -2.0])


@pytest.mark.parametrize(
    ("how", "text"), [("json", "Segmentation fault"), ("csv", ""), ("json", "[1]")]
)
def test_what_cannot_be_read_is_a_failure(how: str, text: str) -> None:
    found = output_of_text(text, how, {})
    assert isinstance(found, Failure)
    assert found.kind == "unreadable"


def test_null_is_no_number() -> None:
    found = output_of_text('{"pull": [1.0, null]}', "json", {})
    assert not isinstance(found, Failure)
    assert np.isnan(found["pull"][1])
