from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.data import check_enough, check_varies, read_table
from calib.errors import CalibError
from calib.models import MODELS, Model, example_csv, template_csv


@pytest.mark.parametrize("name", MODELS)
def test_a_template_loads_and_can_be_fitted(name: str, tmp_path: Path) -> None:
    model = MODELS[name]
    path = tmp_path / "my.csv"
    path.write_text(example_csv(name))
    table = read_table(path, required=[*model.conditions, model.output])
    assert table.ignored == ()
    # Forces come with the load that gives the priors their scale; it is the same in every row.
    extra = {"normal_load_kn"} if model.output == "drawbar_pull_kn" else set()
    assert set(table) == {*model.conditions, model.output} | extra
    check_enough(table, len(model.parameters) + 1, model=name)
    for column in set(table) - extra:
        check_varies(table, column)
    assert np.isfinite(model.bind_references(table.columns).get("p_half_psi", 1.0))


@pytest.mark.parametrize("name", MODELS)
def test_a_template_is_the_example_in_the_order_of_its_rows(name: str, tmp_path: Path) -> None:
    example, template = tmp_path / "example.csv", tmp_path / "template.csv"
    example.write_text(example_csv(name))
    template.write_text(template_csv(name))
    known, found = dict(read_table(example).columns), dict(read_table(template).columns)
    assert found.pop("run_order").tolist() == list(range(1, len(found[MODELS[name].output]) + 1))
    assert {column: v.tolist() for column, v in found.items()} == {
        column: v.tolist() for column, v in known.items()
    }


def test_a_template_of_ones_own_with_an_order_is_left_as_it_is(monkeypatch) -> None:
    text = "slip_ratio,run_order,rut_depth_mm\n0.1,7,20\n"
    own = replace(MODELS["bekker"], name="own", example=text)
    monkeypatch.setattr("calib.models.get_model", lambda name: own)
    assert template_csv("own") == text


def test_a_mistake_in_ones_own_predict_is_told_by_its_line():
    def predict(theta, conditions):
        return theta[:, :1] * conditions["load"]

    model = Model(
        name="mistaken", title="Mistaken", output="drawbar_pull_kn", conditions=("slip_ratio",),
        parameters=("a",), predict=predict, response="identity",
    )  # fmt: skip
    with pytest.raises(CalibError, match="predict of the model mistaken fails: KeyError") as told:
        model.bind({"slip_ratio": np.array([0.1, 0.2])}).predict(
            np.ones((1, 1)), {"slip_ratio": np.array([0.1, 0.2])}
        )
    assert "test_examples.py, line" in told.value.where
    assert "slip_ratio" in told.value.expected
