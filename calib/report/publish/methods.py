"""The methods in words: every number is the manifest's or the summary's. They are `methods.j2`."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from jinja2 import UndefinedError

from calib.data.labels import KNOWN_DATA
from calib.inference.estimators import METHODS
from calib.models import get_model
from calib.report.labels import Axis
from calib.report.numbers import format_number, format_value
from calib.report.page.template import template
from calib.report.publish.markup import joined_symbols
from calib.report.publish.records import Output

# Digits of a hash that tell two files apart; the manifest has all of them.
_HASH = 12

type Paragraph = tuple[str, tuple[str, ...]]
"""A heading, empty for the first, and sentences with marks (`calib.report.publish.markup`)."""


def methods(manifest: Mapping[str, Any], outputs: Sequence[Output]) -> list[Paragraph]:
    """Return the methods; a KeyError where manifest or summary lack a number."""
    labels = sorted({o.label for o in outputs if o.label})
    try:
        text = template("methods.j2", "calib.report.publish", html=False).render(
            v=manifest["versions"], s=manifest["settings"], ga=manifest["genetic_algorithm"],
            seed=manifest["seed"], command=shlex.join(map(str, manifest["command"])),
            labels=[label for label in labels if label in KNOWN_DATA], known=KNOWN_DATA,
            genetic=any("genetic" in o.found["estimates"] for o in outputs), digits=_HASH,
            outputs=[(o, _words(o)) for o in outputs], format_value=format_value,
        )  # fmt: skip
    except UndefinedError as error:
        raise KeyError(str(error)) from None
    blocks = [" ".join(map(str.strip, block.splitlines())) for block in _blocks(text)]
    starts = [0, *(i for i, block in enumerate(blocks) if block.startswith("# "))]
    return [
        (blocks[a][2:] if a else "", tuple(blocks[a + bool(a) : b]))
        for a, b in zip(starts, [*starts[1:], len(blocks)], strict=True)
    ]


def _blocks(text: str) -> list[str]:
    return [block.strip() for block in re.split(r"\n\s*\n", text) if block.strip()]


def _words(o: Output) -> dict[str, Any]:
    """What is said of an output beside what stands in its records."""
    model, v, axis = get_model(o.model), o.found["validation"], o.axis(o.found["output"])
    hits = (f"{round(share * v['n'])}" for share in v["coverage"].values())
    return {
        "model": model,
        "noise": {"family": "", "correlated_along": "", "depends_on": None, "against_normal": None}
        | o.found.get("noise", {}),
        "output_word": _lower(axis.name),
        "ranges": [_range(o.axis(name), r) for name, r in o.found["data"]["ranges"].items()],
        "sampled": joined_symbols(
            name for name, p in o.found["posterior"].items()
            if p["posterior_to_prior_sd"] is not None
        ),
        "methods": [METHODS[m].words if m in METHODS else m for m in o.found["estimates"]],
        "rmse": f"{format_number(axis.factor * (v['rmse'] or 0.0))} {axis.unit}",
        "levels": [f"{level} %" for level in v["coverage"]],
        "hits": list(hits),
    }  # fmt: skip


def _range(axis: Axis, found: Mapping[str, float]) -> str:
    low, high = axis.value_text(found["lower"]), axis.value_text(found["upper"])
    both = {1: low, 2: f"{low} and {high}"}.get(int(found["distinct"]), f"{low} to {high}")
    return f"{_lower(axis.name)} {both} {axis.unit}"


def _lower(name: str) -> str:
    return name[0].lower() + name[1:]
