"""Measured cases as they are stored, and the folders of cases and answers that are made of them."""

from __future__ import annotations

import csv
import io
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.quantities import OUTPUTS
from calib.errors import CalibError
from challenge.mechanism import UNKNOWN
from challenge.seal import write_case

__all__ = ["HERE", "NONE", "SIMULATORS", "UNLISTED", "MeasuredCase", "read_cases"]

HERE = Path(__file__).parent
# The bench's own simulators, as `--models` takes them.
SIMULATORS = tuple(p for p in sorted(HERE.glob("*.py")) if "\nregister(" in p.read_text("utf-8"))
NONE, UNLISTED = "none", "unlisted"
_SERIES = "series"
_FEWEST = 5  # field rows of a case

type Rows = list[dict[str, str]]


@dataclass(frozen=True)
class MeasuredCase:
    """Two series of one laboratory, or two halves of one, and what makes them differ.

    Parameters
    ----------
    name : str
    set_aside : bool
        Whether it is looked at once, at the end.
    models : mapping of str to str
        Output to the simulator's model.
    lab, field : list of dict
        Rows as in the tables, without outputs that are not modelled.
    laboratory, cause : str
        Who measured it, and the documented difference.
    expected : str
        The name the cause has in a diagnosis; ``unlisted`` or ``none``.
    defensible : tuple of str
        Names that are no wrong answer besides.
    sizes : mapping of str to float
        Output to the difference of means, rms in standard deviations of repeats, where there are
        repeats.
    """

    name: str
    set_aside: bool
    models: Mapping[str, str]
    lab: Rows
    field: Rows
    laboratory: str
    cause: str
    expected: str
    defensible: tuple[str, ...]
    sizes: Mapping[str, float]

    def write(self, folder: Path, answers: Path, leave_out: int = 0) -> None:
        """Write the case folder, and its answer into a folder of its name among the answers.

        Parameters
        ----------
        folder, answers : Path
        leave_out : int, optional
            Of so many field rows one is left out of the field, to be predicted.
        """
        # Of a quantity of the bench's own too, which is registered where a program reads the case.
        columns = {o: next(c for c in self.field[0] if c.startswith(f"{o}_")) for o in self.models}
        whole = [i for i, row in enumerate(self.field) if all(row[c] for c in columns.values())]
        kept = whole[leave_out // 2 :: leave_out] if leave_out else []
        fresh = [self.field[i] for i in kept] if len(self.field) - len(kept) >= _FEWEST else []
        field = [row for row in self.field if row not in fresh]
        models = "".join(f'{output} = "{model}"\n' for output, model in self.models.items())
        predict = 'predict = "fresh.csv"\n' if fresh else ""
        files = {
            "case.toml": f'calibration = "lab.csv"\nfield = "field.csv"\n{predict}\n'
            f"[models]\n{models}",
            "lab.csv": _text(self.lab),
            "field.csv": _text(field),
        }
        answer: dict[str, Any] = {
            "tier": "measured",
            "truth": UNKNOWN if self.expected == UNLISTED else self.expected,
            "defensible": list(self.defensible),
            "cause": self.cause,
            "laboratory": self.laboratory,
        }
        if fresh:
            outputs = {*columns.values()}
            files["fresh.csv"] = _text(
                [{c: v for c, v in row.items() if c not in outputs} for row in fresh]
            )
            answer["fresh_truth"] = {
                o: [float(row[c]) for row in fresh] for o, c in columns.items()
            }
        write_case(folder, files, answers, answer)


def _text(rows: Rows) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def read_cases(folder: Path = HERE) -> tuple[MeasuredCase, ...]:
    """Return the measured cases, by name.

    Parameters
    ----------
    folder : Path
        With ``cases/*.toml`` and ``data/*.csv``.

    Raises
    ------
    CalibError
        If a case names a series that its table lacks.
    """
    return tuple(_read(path, folder / "data") for path in sorted((folder / "cases").glob("*.toml")))


def _read(path: Path, data: Path) -> MeasuredCase:
    said: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    with (data / said["data"]).open(encoding="utf-8", newline="") as file:
        table = [row for row in csv.DictReader(file) if _in_range(row, said.get("at_least", {}))]
    dropped = {_SERIES} | {c for output, c in OUTPUTS.items() if output not in said["models"]}
    if "split" in said:
        lab, field = _halves(_of(table, said["split"], path), said["seed"])
    else:
        lab, field = _of(table, said["lab"], path), _of(table, said["field"], path)
    lab, field = (
        [{c: v for c, v in row.items() if c not in dropped} for row in part]
        for part in (lab, field)
    )
    answer = said["answer"]
    return MeasuredCase(
        path.stem, said["set_aside"], said["models"], lab, field, said["laboratory"],
        answer["cause"], answer["expected"], tuple(answer.get("defensible", ())),
        answer.get("size_sds", {}),
    )  # fmt: skip


def _in_range(row: Mapping[str, str], at_least: Mapping[str, float]) -> bool:
    return all(float(row[column]) >= least for column, least in at_least.items())


def _of(table: Rows, series: Sequence[str], path: Path) -> Rows:
    """Return the rows of some series, in the order of the table."""
    there = {row[_SERIES] for row in table}
    for name in series:
        if name not in there:
            raise CalibError(
                f"there is no series {name}", where=str(path), expected=", ".join(sorted(there)),
                hint="correct the name",
            )  # fmt: skip
    return [row for row in table if row[_SERIES] in series]


def _halves(rows: Rows, seed: int) -> tuple[Rows, Rows]:
    """Return two random halves, the first with the odd row."""
    order = np.random.default_rng(seed).permutation(len(rows))
    cut = math.ceil(len(rows) / 2)
    return [rows[i] for i in order[:cut]], [rows[i] for i in order[cut:]]
