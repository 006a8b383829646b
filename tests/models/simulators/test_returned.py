"""What a simulator gives back, by every way in: the right numbers, or a run without a value."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pint
import pytest

import calib
from calib.errors import CalibError
from calib.inference.emulation.prepared import read_runs
from calib.models.base import BoundModel
from calib.models.simulators.base import Failure, Output
from calib.models.simulators.files import read_simulator
from calib.models.simulators.registered import from_callable, models_of
from calib.models.simulators.ways import CallableWay, UmbridgeWay
from tests.models.simulators.examples import PRIORS, pull, serving, write_program
from tests.models.simulators.test_ways import EXACT, THETA, X, failure, in_percent, simulator

PRINTS = f'"{sys.executable} wheel.py {{input}}"'
UNITS = pint.UnitRegistry()
# As many parameter vectors as rows: what is transposed has the right shape.
SOME = np.array([[0.6, 0.08], [0.5, 0.1], [0.7, 0.2]])


def newtons(t: np.ndarray, x: dict) -> object:
    return UNITS.Quantity(in_percent(t, x)["pull"] / 9.80665, "kgf")


def masked(t: np.ndarray, x: dict) -> object:
    return np.ma.array(in_percent(t, x)["pull"], mask=[[False, True]] * len(t))


def complex_(t: np.ndarray, x: dict) -> object:
    return in_percent(t, x)["pull"] + 1e-3j


def transposed(t: np.ndarray, x: dict) -> object:
    return in_percent(t, x)["pull"].T


def nothing(t: np.ndarray, x: dict) -> None:
    in_percent(t, x)


def sorted_rows(t: np.ndarray, x: dict) -> object:
    pandas = pytest.importorskip("pandas")
    return {"pull": pandas.Series(in_percent(t, x)["pull"][0]).sort_values(ascending=False)}


def table(t: np.ndarray, x: dict) -> object:
    pandas = pytest.importorskip("pandas")
    return pandas.DataFrame({"pull": in_percent(t, x)["pull"][0], "step": [0, 1]})


@pytest.mark.parametrize("limit", [None, 60.0])
def test_a_function_that_returns_a_quantity_is_converted(limit: float | None) -> None:
    found = simulator(CallableWay(newtons, ("pull",), limit=limit)).run(THETA, X)
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)


def test_a_table_of_pandas_is_outputs_by_name() -> None:
    found = simulator(CallableWay(table, ("pull",))).run(THETA, X)
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)


@pytest.mark.parametrize(
    ("gives", "kind", "word"),
    [
        (masked, "nan", "1 of 2 rows, first in row 2"),
        (complex_, "unreadable", "imaginary parts up to 0.001"),
        (nothing, "unreadable", "nothing (None)"),
        (sorted_rows, "unreadable", "labelled 1, 0"),
        (lambda t, x: "1,5", "unreadable", "'1,5' is no number"),
        (lambda t, x: np.ones((2, 2)), "short", "4 values for 2 rows"),
    ],
)
def test_a_run_without_plain_numbers_has_no_value(gives: Callable, kind: str, word: str) -> None:
    found = failure(simulator(CallableWay(gives, ("pull",))).run(THETA, X))
    assert found.kind == kind
    assert word in found.reason


def test_rows_in_the_shape_of_a_grid_are_in_no_known_order() -> None:
    x = {name: np.tile(values, 2) for name, values in X.items()}
    way = CallableWay(lambda t, c: in_percent(t, c)["pull"].reshape(2, 2), ("pull",))
    assert "shape (2, 2) for 4 rows" in failure(simulator(way).run(THETA, x)).reason


def quick(f: Callable, **changes: object) -> BoundModel:
    given = {
        "parameters": PRIORS, "conditions": {"s": "slip_percent", "w": "normal_load_kn"},
        "output": {"pull": "drawbar_pull_n"}, "name": "quick",
    } | changes  # fmt: skip
    (model,) = models_of(from_callable(f, **given).simulator)  # type: ignore[arg-type]
    return BoundModel(model, {})


def plain(f: Callable) -> BoundModel:
    def own(t: np.ndarray, x: dict) -> object:
        x["slip_ratio"] *= 100.0
        found = f(t, {"s": x["slip_ratio"], "w": x["normal_load_kn"]})
        return found["pull"] / 1000.0 if isinstance(found, dict) else found

    return BoundModel(
        calib.Model(
            name="plain", title="", output="drawbar_pull_kn", parameters=("mu", "s0"),
            conditions=("slip_ratio", "normal_load_kn"), predict=own,
        ), {},
    )  # fmt: skip


@pytest.mark.parametrize("way", [quick, plain])
def test_a_model_that_is_asked_by_the_sampler_gives_the_same(way: Callable) -> None:
    exact = pull(SOME, X)
    np.testing.assert_allclose(way(newtons).mean_response(SOME, X), exact)
    for unusable in (complex_, transposed, nothing, sorted_rows):
        with pytest.raises(CalibError):
            way(unusable).mean_response(SOME, X)
    gaps = way(masked).mean_response(SOME, X)
    assert np.isnan(gaps[:, 1]).all()
    assert np.isfinite(gaps[:, 0]).all()


PRINTED = "print(json.dumps({{'pull': {value}}})); sys.exit()"


@pytest.mark.parametrize(
    ("value", "word"),
    [
        ("[True, False]", "bool"),
        ("['1,5', '2,5']", "'1,5' is no number"),
        ("[10**400, 1]", "too large"),
        ("[[1.0], [2.0, 3.0]]", "differ in length"),
        ("[1.0, None]", "not finite in 1 of 2 rows, first in row 2"),
        ("[1.0, float('inf')]", "not finite in 1 of 2 rows, first in row 2"),
        ("[1.0, 2.0, 3.0]", "3 values for 2 rows"),
        ("{'0': 1.0}", "no output 'pull'"),
    ],
)
def test_a_program_that_writes_no_plain_numbers(tmp_path: Path, value: str, word: str) -> None:
    extra = PRINTED.format(value=value)
    file = write_program(tmp_path, extra=extra, retries="0", run=PRINTS)
    assert word in failure(read_simulator(file).simulator.run(THETA, X)).reason


@pytest.mark.parametrize(
    ("printed", "gives", "word"),
    [
        ('{"pull": [1, 2], "pull": [3, 4]}', "json", "'pull' is there twice"),
        ("pull,pull\\n1,3\\n2,4", "csv", "'pull' is there twice"),
        ("step,pull\\n1,1,5\\n2,2,5", "csv", "different numbers of cells"),
        ("step;pull\\n1;1,5\\n2;2,5", "csv", ""),
        ("pull\\n1_5\\n2.0", "csv", "'1_5' is no number"),
        ("pull\\n****\\n2.0", "csv", "'****' is no number"),
        ("pull\\nTrue\\nFalse", "csv", "'True' is no number"),
        ("F=1.5e+03 F=2.5e+03 ", "pattern", "the beginning of '1.5e+03'"),
        ("F=1,5 F=2,5 ", "pattern", "the beginning of '1,5'"),
    ],
)
def test_text_that_is_read_by_half_is_refused(
    tmp_path: Path, printed: str, gives: str, word: str
) -> None:
    extra = f"print('{printed}'); sys.exit()"
    file = write_program(tmp_path, extra=extra, retries="0", run=PRINTS, output=f'"{gives}"')
    text = file.read_text()
    if gives == "pattern":
        text = text.replace("[conditions]", "[patterns]\npull = 'F=([0-9.]+)'\n[conditions]")
    file.write_text(text)
    assert word in failure(read_simulator(file).simulator.run(THETA, X)).reason


def test_a_list_without_spaces_is_read_number_by_number(tmp_path: Path) -> None:
    file = write_program(
        tmp_path, extra="print('1.5D1,-25'); sys.exit()", run=PRINTS,
        output='"pattern"',
    )  # fmt: skip
    file.write_text(file.read_text().replace(
        "[conditions]", "[patterns]\npull = '([-+0-9.D]+)'\n[conditions]"
    ))  # fmt: skip
    found = read_simulator(file).simulator.run(THETA, X)
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], [0.015, -0.025])


def test_a_row_that_gives_two_numbers_takes_no_others_place(tmp_path: Path) -> None:
    """Two rows with two and no numbers are two numbers, and of the wrong rows."""
    file = write_program(
        tmp_path, rows='"each"', retries="0",
        extra="json.dump({'pull': [1.0, 2.0] if x['s'][0] < 20 else []}, open(sys.argv[2], 'w'));"
        "sys.exit()",
    )  # fmt: skip
    assert "differ in length" in failure(read_simulator(file).simulator.run(THETA, X)).reason


@pytest.mark.parametrize(
    ("mood", "word"), [("bool", "bool"), ("text", "'1,5' is no number"), ("pair", "4 values")]
)
def test_a_server_that_replies_with_no_plain_numbers(mood: str, word: str) -> None:
    with serving() as url:
        found = failure(simulator(UmbridgeWay(url, mood, ("pull",))).run(THETA, X))
    assert word in found.reason


def table_of_runs(folder: Path, change: Callable[[str], str]) -> Path:
    """Write runs of ten parameter vectors at two rows, in a table as somebody changed it."""
    vectors = np.random.default_rng(1).uniform([0.3, 0.05], [0.9, 0.3], (10, 2))
    rows = [
        f"{t[0]!r},{t[1]!r},{100 * s!r},{w!r},{1000 * y!r}"
        for t in vectors.tolist()
        for s, w, y in zip(*map(np.ndarray.tolist, X.values()), pull(np.array([t]), X)[0].tolist(),
                           strict=True)
    ]  # fmt: skip
    (folder / "runs.csv").write_text(change("\n".join(["mu,s0,s,w,pull", *rows]) + "\n"))
    return write_program(folder, run="", table='"runs.csv"')


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (
            lambda t: t.replace("\n", ",7\n").replace("pull,7", "pull,pull"),
            "twice",
        ),
        (lambda t: t.replace(",10.0,", ",1_0,", 1), "'1_0' is no number"),
        (lambda t: t.replace(",10.0,", ",,", 1), "there is no number"),
        (lambda t: t.replace(",10.0,", ",10,0,", 1), "different numbers of cells"),
    ],
)
def test_a_table_with_other_than_plain_numbers(tmp_path: Path, change: Callable, word: str) -> None:
    one = read_simulator(table_of_runs(tmp_path, change)).simulator
    problem = SimpleNamespace(bound=BoundModel(models_of(one)[0], {}))
    with pytest.raises(CalibError, match=word):
        read_runs(one, problem)  # type: ignore[arg-type]
    same = table_of_runs(tmp_path, lambda text: text)
    found = read_runs(read_simulator(same).simulator, problem)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.values, pull(found.theta, X))


def selfish(t: np.ndarray, x: dict) -> object:
    """Change what is handed over, and fail on every second call."""
    exact = in_percent(t, x)
    x["s"] *= 0.5
    x["w"] += 1.0
    t *= 2.0
    del x["s"]
    CALLS.append(1)
    return exact if len(CALLS) % 2 == 0 else {"pull": np.full(exact["pull"].shape, np.nan)}


CALLS: list[int] = []


@pytest.mark.parametrize("batched", [True, False])
def test_a_retry_sees_the_conditions_of_the_run(batched: bool) -> None:
    CALLS.clear()

    def f(t: np.ndarray, x: dict) -> object:
        return selfish(t if batched else t[None], x)

    found = simulator(CallableWay(f, ("pull",), batched), retries=1).run(THETA, X)
    assert len(CALLS) == 2
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)


@pytest.mark.parametrize("way", [quick, plain])
def test_a_function_that_changes_what_it_is_handed_changes_nothing_else(way: Callable) -> None:
    def f(t: np.ndarray, x: dict) -> object:
        CALLS[:] = [1]
        return selfish(t, x)

    theta, x = SOME.copy(), {name: values.copy() for name, values in X.items()}
    model = way(f)
    for _ in range(2):
        np.testing.assert_allclose(model.mean_response(theta, x), pull(SOME, X))
    own = {name: np.tile(values, (len(SOME), 1)) for name, values in x.items()}
    np.testing.assert_allclose(model.mean_response(theta, own), pull(SOME, X))
    np.testing.assert_array_equal(theta, SOME)
    for name, values in X.items():
        np.testing.assert_array_equal(x[name], values)
        np.testing.assert_array_equal(own[name], np.tile(values, (len(SOME), 1)))


def test_a_retry_of_a_program_finds_no_file_of_the_first(tmp_path: Path) -> None:
    extra = f"""
import os
if os.path.exists("half.txt"):
    p["mu"] = 99.0
open("half.txt", "w").close()
if not os.path.exists({str(tmp_path / "tried")!r}):
    open({str(tmp_path / "tried")!r}, "w").close(); sys.exit(3)
"""
    file = write_program(tmp_path, extra=extra, retries="1")
    found = read_simulator(file).simulator.run(THETA, X)
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)


def test_outputs_of_several_quantities_are_each_in_their_unit() -> None:
    def both(t: np.ndarray, x: dict) -> dict[str, object]:
        found = in_percent(t, x)["pull"]
        return {"pull": UNITS.Quantity(found, "N"), "rut": UNITS.Quantity(found / 1000.0, "cm")}

    outputs = (Output("drawbar_pull_n", "pull", ""), Output("rut_depth_mm", "rut", ""))
    found = simulator(CallableWay(both, ("pull", "rut")), outputs=outputs).run(THETA, X)
    assert not isinstance(found, Failure)
    np.testing.assert_allclose(found["drawbar_pull_kn"], EXACT)
    np.testing.assert_allclose(found["rut_depth_mm"], 10.0 * EXACT)
