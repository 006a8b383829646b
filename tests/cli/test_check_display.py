"""What a check prints where not everything is the same: what, how far off, and made where."""

from __future__ import annotations

import pytest

from calib.check.outcome import Item, Outcome, Status
from calib.check.tolerances import MONTE_CARLO
from calib.cli.check import show


def outcome(*items: Item, there: bool = False, allowed: str = "") -> Outcome:
    environment = {"numpy": ("1.0", "2.0")} if there else {}
    return Outcome("run", "run", False, items, environment, allowed)


def printed(capsys: pytest.CaptureFixture[str], found: Outcome, *, every: bool = False) -> str:
    show(found, every=every)
    return capsys.readouterr().out


def test_what_differs_is_shown_with_both_numbers_and_what_is_allowed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = printed(capsys, outcome(
        Item("estimates (rut)", "rut: n", Status.DIFFERENT, 1.25, 1.75, 0.125, "an optimum"),
        Item("estimates (pull)", "pull: C", Status.WITHIN, 2.0, 2.001, 0.01),
        Item("files", "data.csv", Status.UNJUDGED, "a" * 40, None, None, "not there"),
    ))  # fmt: skip
    lines = found.splitlines()
    assert lines[0] == "DIFFERENT: rut: n"
    # One row for both outputs; its largest difference is four times what is allowed.
    (row,) = (line for line in lines if line.startswith("│ estimates"))
    assert [cell.strip() for cell in row.strip("│").split("│")] == [
        "estimates", "", "1", "1", "", "400 %",
    ]  # fmt: skip
    (row,) = (line for line in lines if "rut: n" in line and line.startswith("│"))
    assert [cell.strip() for cell in row.strip("│").split("│")] == [
        "rut: n", "1.25", "1.75", "0.125", "an optimum",
    ]  # fmt: skip
    assert "aaaaaaaaaaaaaaaa..." in found
    assert "pull: C" not in found
    assert "pull: C" in printed(capsys, outcome(
        Item("estimates", "pull: C", Status.WITHIN, 2.0, 2.001, 0.01)), every=True)  # fmt: skip


def test_only_so_many_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    items = [Item("files", f"number {i}", Status.DIFFERENT, i, i + 1, 0.5) for i in range(43)]
    found = printed(capsys, outcome(*items))
    assert "number 39 " in found
    assert "number 40 " not in found
    assert "... and 3 more; --all or --json lists them" in found


@pytest.mark.parametrize("there", [True, False])
def test_other_draws_are_explained(capsys: pytest.CaptureFixture[str], there: bool) -> None:
    drawn = Item("rut: posterior", "mean", Status.WITHIN, 1.0, 1.01, 0.1, MONTE_CARLO)
    found = printed(capsys, outcome(drawn, there=there, allowed="seven standard errors"))
    assert found.startswith("SAME within Monte Carlo error, not bit for bit")
    assert "Allowed: seven standard errors." in found
    assert ("numpy: there 1.0; here 2.0" in found) == there
    assert ("or the record is not true" in found) != there
