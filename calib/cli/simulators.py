"""Emulation of simulators before the verbs that need it, and what is said of it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calib.data import Table
    from calib.gap.case import Case
    from calib.inference.emulation import Emulation


def say(model: str, emulation: Emulation | None) -> bool:
    """Say what became of an emulation; return whether it is good enough (or was not needed)."""
    if emulation is None:
        return True
    from calib.data.files import plain_number
    from calib.report.sections import coverage_words

    h = emulation.held_out
    seen = "" if h is None else (
        f"; on {h.runs} runs not seen it is off by {h.rmse:.3f} noise sds (rms); of their values "
        f"its 90 % intervals hold {coverage_words(h.covered, h.pit.size)}"
    )  # fmt: skip
    n = len(emulation.runs)
    print(f"{model}: emulated {f'with {n} more' if emulation.extended else f'from {n}'} runs{seen}")
    if emulation.own_noise:
        sd = plain_number(emulation.own_noise)
        print(f"{model}: the simulator has a noise of its own, sd {sd}")
    if emulation.failed:
        first = emulation.failed[0].failure
        why = "" if first is None else f", the first as {first.reason}"
        print(
            f"calib: {len(emulation.failed)} of {len(emulation.runs)} runs failed{why}; they are "
            "listed beside the runs, and the posterior keeps out of where there is no value",
            file=sys.stderr,
        )
    for reason in emulation.reasons:
        print(f"EMULATOR NOT GOOD ENOUGH: {reason}")
    return emulation.passed


def say_failed(model: str) -> None:
    """Say which runs failed of a simulator that the sampler asked itself, and list them."""
    from calib.inference.emulation.prepared import write_failed
    from calib.models import get_model
    from calib.models.simulators.registered import Direct, simulated_by

    direct, found = get_model(model).predict, simulated_by(model)
    if not isinstance(direct, Direct) or found is None or not direct.tally.failed:
        return
    tally, listed = direct.tally, ""
    if found.folder is not None:
        path = found.folder / f"{model}-failed.csv"
        write_failed(tally.failed, direct.simulator.parameters, path)
        listed = f"; the first {len(tally.failed)} are listed in {path}"
    first = tally.failed[0].failure
    print(
        f"calib: {tally.lost} of {tally.made} runs failed, the first as "
        f"{'' if first is None else first.reason}{listed}; the posterior keeps out of where there "
        "is no value",
        file=sys.stderr,
    )


def keep_emulators(models: Iterable[str], folder: Path) -> None:
    """Keep the emulators among some models in a folder, to predict from it again."""
    from calib.models import get_model
    from calib.models.simulators.emulator import emulator_of, save_emulator

    for model in models:
        emulator = emulator_of(get_model(model))
        if emulator is not None:
            save_emulator(emulator, model, folder / "emulators" / f"{model}.npz")


def prepare_case(
    case: Case, run: Path | None, seed: int, workers: int, tell: Callable[[str, int, int], None]
) -> list[tuple[str, Emulation | None]]:
    """Emulate the simulators of a case for both of its campaigns."""
    import numpy as np

    from calib.batch.plugins import load_files
    from calib.data.quantities import OUTPUTS
    from calib.models.simulators.registered import simulated_by

    if run is None and not any(map(simulated_by, case.models.values())):
        return []
    # Of which most cases have no need.
    from calib.gap.campaigns import campaigns
    from calib.inference.emulation.prepared import prepare, prepare_field, reaches

    campaigns(case)  # refuses, before any run is made, what cannot be diagnosed
    said = []
    others = [case.field, *([] if case.new_conditions is None else [case.new_conditions])]
    for output, model in case.models.items():
        column = OUTPUTS[output]

        def measured(table: Table, column: str = column) -> Table:
            return table.take(np.isfinite(table[column]))

        priors = case.priors.get(output)
        kept = None if run is None else run / "emulator.npz"
        if kept is not None and kept.exists():
            load_files([kept])
        if not reaches(model, [case.lab, *others]):
            found = prepare(
                model, measured(case.lab), seed, priors=priors, elsewhere=others, workers=workers,
                progress=tell,
            )  # fmt: skip
            said.append((model, found))
        found = prepare_field(
            model, measured(case.field), seed, priors=priors, workers=workers, progress=tell
        )
        said.append((f"{model}, field", found))
    return said
