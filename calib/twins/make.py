"""Write the twins of a blind test as a blind test of their own, with a sealed key."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.batch.folders import check_folder
from calib.batch.tasks import completed
from calib.challenge.files import OUTPUT_COLUMNS, CaseFiles
from calib.challenge.seal import KEY_SCHEMA, check_outside, open_key, publish, seal
from calib.data import Table
from calib.errors import CalibError
from calib.gap.case import campaigns, read_case
from calib.gap.noise import noise_at
from calib.gap.which import calibrate_lab
from calib.inference.random import generator
from calib.models.base import Array
from calib.twins.draw import draw_twin

__all__ = ["make_twins"]

# As many as a careful reading has; more than the noise needs.
_DIGITS = 6


@dataclass(frozen=True)
class _Job:
    folder: Path
    tier: str
    truth: str
    gap_over_noise: float


def make_twins(
    cases: Path,
    key_path: Path,
    out: Path,
    twin_key_path: Path,
    *,
    seed: int,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    announce: Callable[[str], None] | None = None,
) -> dict[str, str]:
    """Write a twin of every blind case that has one.

    Parameters
    ----------
    cases, key_path : Path
        Written by `calib challenge make`.
    out, twin_key_path : Path
        New: the twins, and their sealed answers, outside them.
    seed : int
    workers, scheduler, announce
        As for `calib.batch.tasks.completed`; the result does not depend on them.
    progress : callable, optional
        Called with the number of twins done and their total.

    Returns
    -------
    dict of str to str
        Cases without a twin, and why.

    Raises
    ------
    CalibError
        If the key is not that of the cases, or a path will not do.
    """
    key = open_key(cases, key_path)
    check_outside(out, twin_key_path)
    check_folder(out, overwrite=False)
    if twin_key_path.exists():
        raise CalibError("a key is there already", where=str(twin_key_path))
    jobs = {
        name: _Job(cases / name, entry["tier"], entry["truth"], entry["gap_over_noise"])
        for name, entry in key["cases"].items()
    }
    entries: dict[str, Any] = {}
    without: dict[str, str] = {}
    twin_of = partial(_twin, seed)
    with closing(
        completed(twin_of, jobs, workers=workers, scheduler=scheduler, announce=announce)
    ) as coming:
        for task in coming:
            if task.result is None:
                without[task.name] = str(task.error)
            else:
                task.result.write(out / task.name)
                entries[task.name] = task.result.key
            if progress is not None:
                progress(len(entries) + len(without), len(jobs))
    if not entries:
        raise CalibError(f"no case has a twin: {next(iter(without.values()))}", where=str(cases))
    kept = {name: entries[name] for name in jobs if name in entries}
    twin_key = {"schema": KEY_SCHEMA, "seed": seed, "salt": key["salt"], "cases": kept}
    tiers = tuple(dict.fromkeys(entry["tier"] for entry in kept.values()))
    publish(out, twin_key, seal(twin_key, twin_key_path), tiers)
    return {name: without[name] for name in jobs if name in without}


def _twin(seed: int, job: _Job) -> CaseFiles:
    """Draw a case's twin, as files."""
    case = read_case(job.folder)
    if case.fresh is None:
        raise CalibError("there is no fresh.csv", where=str(job.folder))
    data = campaigns(case)
    lab_mode, noise = calibrate_lab(data, seed)
    rng = generator(seed, "twin", job.folder.name)
    twin = draw_twin(data, lab_mode, noise, job.truth, job.gap_over_noise, rng)
    forward, psi, view, fresh = twin.forward, twin.psi, data.view, data.at(case.fresh)
    lab, in_field = forward.lab(psi), forward.field(psi, view)
    said = {
        "field_truth": in_field,
        "field_without": forward.simulator(psi, view),
        "fresh_truth": forward.field(psi, fresh),
        "fresh_without": forward.simulator(psi, fresh),
    }
    key: dict[str, Any] = {
        "tier": job.tier,
        "truth": job.truth,
        "gap_over_noise": twin.gap_over_noise,
        "mechanism": f"as the diagnosis believes: {forward.hypothesis.name}",
        "noise_sd": {},
    }
    lab_readings, field_readings = {}, {}
    for o in data.outputs:
        back, sd_of = o.problem.bound.from_response, noise[o.name].sd
        for name, values in said.items():
            key.setdefault(name, {})[o.name] = back(values[o.name][0]).tolist()
        sd = np.broadcast_to(sd_of(noise_at(view)), in_field[o.name][0].shape)
        # On a logarithm the noise is relative; the key states it in the output's own unit.
        log = o.problem.bound.model.response == "log"
        unit = back(in_field[o.name][0]) if log else np.ones_like(sd)
        key["noise_sd"][o.name] = (sd * unit).tolist()
        lab_sd = np.broadcast_to(sd_of(data.lab_at[o.name]), lab[o.name][0].shape)
        lab_readings[o.name] = back(lab[o.name][0] + lab_sd * rng.standard_normal(lab_sd.size))
        field_readings[o.name] = back(in_field[o.name][0] + sd * rng.standard_normal(sd.size))
    files = {
        "case.toml": (job.folder / "case.toml").read_text(encoding="utf-8"),
        "lab.csv": _table(case.lab, lab_readings),
        "field.csv": _table(case.field, field_readings),
        "fresh.csv": _table(case.fresh, {}),
    }
    return CaseFiles(files, key)


def _table(table: Table, outputs: dict[str, Array]) -> str:
    """The table as it was written, with other readings."""
    cells = dict(zip(table.header, zip(*table.text, strict=True), strict=True))
    for name, values in outputs.items():
        cells[OUTPUT_COLUMNS[name]] = tuple(f"{value:.{_DIGITS}g}" for value in values)
    rows = zip(*cells.values(), strict=True)
    return "\n".join(",".join(row) for row in (tuple(cells), *rows)) + "\n"
