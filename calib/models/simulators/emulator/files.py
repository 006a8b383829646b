"""An emulator on disk: the runs it stands on and its length scales, to build it again from."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import CalibError
from calib.models import MODELS, get_model
from calib.models.simulators.emulator.emulator import (
    Axes,
    Emulator,
    Training,
    build_emulator,
    emulated_model,
)
from calib.models.simulators.emulator.kriging import Region, Scales
from calib.models.simulators.emulator.over import over_conditions


def save_emulator(emulator: Emulator, model: str, path: Path) -> None:
    """Write an emulator, whole or not at all.

    Parameters
    ----------
    model : str
        The model that it stands for.
    path : Path
        Ending in ``.npz``.
    """
    t = emulator.training
    meta = {
        "model": model, "nodes": list(t.nodes), "noisy": t.noisy,
        "negligible": emulator.negligible, "reach": [r.reach for r in emulator.regions],
    }  # fmt: skip
    arrays: dict[str, Any] = {
        "meta": np.array(json.dumps(meta)), "theta": t.theta, "values": t.values,
        "log": emulator.axes.log, "loc": emulator.axes.loc, "width": emulator.axes.width,
        "over": emulator.over.lengths,
        **{f"node_{i}": v for i, v in enumerate(t.nodes.values())},
        **{f"centre_{i}": r.centre for i, r in enumerate(emulator.regions)},
        **{f"root_{i}": r.root for i, r in enumerate(emulator.regions)},
    }  # fmt: skip
    arrays["lengths"] = emulator.functions.scales.lengths
    arrays["nugget"] = np.array(emulator.functions.scales.nugget)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part.npz")
    # In the archive no time of its making: equal emulators give equal files.
    np.savez(part, **arrays)
    part.replace(path)


def load_emulator(path: Path) -> tuple[str, Emulator]:
    """Read an emulator and the name of its model.

    Raises
    ------
    CalibError
        If the file is damaged or is none.
    """
    try:
        with np.load(path, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
        meta = json.loads(str(arrays["meta"]))
        return meta["model"], _built(meta, arrays)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise CalibError(
            f"the emulator cannot be read ({type(error).__name__})", where=str(path),
            mend="make it again from the simulator's runs: call the same command",
        ) from None  # fmt: skip


def _built(meta: dict[str, Any], arrays: dict[str, Any]) -> Emulator:
    nodes = {name: arrays[f"node_{i}"] for i, name in enumerate(meta["nodes"])}
    regions = [
        Region(arrays[f"centre_{i}"], arrays[f"root_{i}"], reach)
        for i, reach in enumerate(meta["reach"])
    ]
    # Files of earlier versions have scales for each curve: they are found anew from the runs.
    kept = Scales(arrays["lengths"], float(arrays["nugget"])) if "nugget" in arrays else None
    values = arrays["values"]
    return build_emulator(
        Training(arrays["theta"], values, nodes, bool(meta["noisy"])),
        Axes(arrays["log"], arrays["loc"], arrays["width"]), meta["negligible"], regions,
        scales=kept, known=kept is not None,
        over=over_conditions(nodes, values[:1], arrays["over"]),
    )  # fmt: skip


def use_emulator(path: Path) -> None:
    """Let the model of an emulator on disk be the emulator, in this process."""
    name, emulator = load_emulator(path)
    model = emulated_model(get_model(name), emulator)
    MODELS.discard(name)
    MODELS.add(replace(model))
