"""The pages of the files name every key: of the committed results, and of a simulator file."""

from __future__ import annotations

import json
import re
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel, ValidationError

from calib.data.quantities import QUANTITIES
from calib.gap.effects import View
from calib.imports.mapping import DERIVED, INPUTS, Mapped, Source
from calib.inference.io import RunRecord
from calib.inference.sampler import SamplerSettings
from calib.models import example_csv
from calib.models.simulators.files import SimulatorFile
from calib.report.sbc import write_sbc
from calib.validation.sbc import run_sbc
from tests.commands import Calib
from tests.docs.pages import DOCS
from tests.gap_files import gap_files

RESULTS = (DOCS / "formats" / "results.md").read_text(encoding="utf-8")
SCRATCH = tempfile.TemporaryDirectory(prefix="formats-")
EXTEND = (DOCS / "extend.md").read_text(encoding="utf-8")
# Of the program's own, before any test adds to them.
ROLES = {q.physical: (column, q.role) for column, q in QUANTITIES.items()}
# Below these keys, how many levels of keys are names of one's own: outputs, methods, parameters.
NAMES = {"models": 1, "estimates": 2, "fit": 1, "priors": 1, "posterior": 1, "parameters": 1,
         "shrink": 1, "quantities": 1, "inclusion": 1}  # fmt: skip
# Told in words, or of other programs.
WHOLE = {"ranges", "references", "mode", "coverage", "coverage_interval", "by_pressure", "criteria",
         "gate", "conditions", "paper_gaps", "audit", "tasks", "files", "left_out", "versions",
         "machine", "seconds", "settings", "genetic_algorithm"}  # fmt: skip


def keys(value: Any, names: int = 0) -> Iterator[str]:
    """Yield the keys of a document that are the format's own."""
    for inside in value if isinstance(value, list) else ():
        yield from keys(inside)
    for key, inside in value.items() if isinstance(value, dict) else ():
        if names:
            yield from keys(inside, names - 1)
            continue
        yield key
        if key not in WHOLE:
            yield from keys(inside, NAMES.get(key, 0))


def written(name: str) -> list[Path]:
    """Return results of a kind: of the committed report, of gaps, of a small SBC."""
    if name == "sbc":
        return [simulated() / "sbc.json"]
    if name in ("summary", "manifest"):
        return [DOCS.parent / "reports" / "he2019" / f"{name}.json"]
    file = {"diagnosis": "diagnosis.json", "case": "case/case.toml"}[name]
    return [gap_files(gap) / file for gap in ("nominal_slip", "held_out_pull")]


@cache
def simulated() -> Path:
    folder = Path(SCRATCH.name) / "sbc"
    settings = SamplerSettings(steps=100, max_steps=100)
    score = run_sbc(folder, models=["bekker"], simulations=4, seed=2019, settings=settings)
    write_sbc(score, folder, asdict(settings), ["calib", "sbc"])
    return folder


@pytest.mark.parametrize("name", ["summary", "manifest", "diagnosis", "sbc"])
def test_every_key_is_told(name: str) -> None:
    told = set(re.findall(r"`(\w+)`", RESULTS))
    for path in written(name):
        document = json.loads(path.read_text(encoding="utf-8"))
        assert {key for key in keys(document) if key not in told} == set()


def described() -> dict[str, type[BaseModel]]:
    """Return the models that the schemas of the documentation are made from."""
    spec = spec_from_file_location("result_schemas", DOCS / "_ext" / "result_schemas.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # pydantic looks for names that come later there
    try:
        spec.loader.exec_module(module)
    finally:
        del sys.modules[spec.name]
    return module.RESULTS


MODELS_OF = described()


@pytest.mark.parametrize("name", ["summary", "diagnosis", "sbc", "case"])
def test_what_is_written_is_as_its_schema_says(name: str) -> None:
    for path in written(name):
        text = path.read_text(encoding="utf-8")
        content = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
        MODELS_OF[name].model_validate(content)
        with pytest.raises(ValidationError):
            MODELS_OF[name].model_validate({**content, "models": {"a": {}}, "verdict": 3})


def test_what_a_check_and_a_campaign_say_is_as_their_schemas_say(run: Calib) -> None:
    Path("ruts.csv").write_text(example_csv("bekker"), encoding="utf-8")
    plan = '[[fit]]\nname = "ruts"\ndata = ["*.csv"]\nmodels = ["bekker"]\n'
    Path("plan.toml").write_text(plan, encoding="utf-8")
    assert run("campaign", "plan.toml", "--out", "c", "--workers", 1).code == 0
    written = json.loads(Path("c/summary.json").read_text(encoding="utf-8"))
    campaign = MODELS_OF["campaign"].model_validate(written)
    (task,) = campaign.tasks
    checked = json.loads(run("check", f"c/results/{task}/run", "--quick", "--json").out)
    assert MODELS_OF["check"].model_validate(checked).verdict == "same"


def test_the_keys_of_a_run_are_told() -> None:
    of_run = RESULTS.partition("`run.json`, schema")[2].partition("## Report folder")[0]
    fields = {f.alias or name for name, f in RunRecord.model_fields.items()} - {
        "document",
        "schema",
    }
    assert fields <= set(re.findall(r"`(\w+)`", of_run))


def of_simulators() -> dict[str, str]:
    """Return what the table of a simulator file's keys says of each: its default."""
    page = (DOCS / "simulators.md").read_text(encoding="utf-8")
    found: dict[str, str] = {}
    for line in page.partition("## Every key of the file")[2].splitlines():
        if line.startswith("| `"):
            keys, _, default = line.split(" | ")[:3]
            names = re.findall(r"`\[?(\w+(?:\.[a-z]+)?)", keys)
            found |= dict.fromkeys(names, default.strip("` "))
    return found


def test_every_key_of_a_simulator_file_is_told_with_its_default() -> None:
    told = of_simulators()
    fields = dict(SimulatorFile.model_fields)
    budget = fields["emulator"].annotation.model_fields
    fields |= {f"emulator.{name}": field for name, field in budget.items()}
    assert set(told) == set(fields)
    plain = {
        name: json.dumps(field.default)
        for name, field in fields.items()
        if isinstance(field.default, (str, int, float, bool)) and name != "cache"
    }
    assert {name: told[name] for name in plain} == plain


def test_every_key_of_a_mapping_is_told() -> None:
    page = (DOCS / "formats" / "inputs.md").read_text(encoding="utf-8")
    section = page.partition("\n## mapping.toml\n")[2].partition("\n## ")[0]
    told = set(re.findall(r"`\[?(\w+)\]?", section)) | {"sheet"}
    fields = {*Mapped.model_fields, *Source.model_fields, *DERIVED, *INPUTS} - {"from_"}
    assert fields <= told


def test_every_role_of_an_effect_is_told_with_its_column() -> None:
    section = EXTEND.partition("### Roles\n")[2].partition("\n### ")[0]
    table, _, others = section.partition("All others")
    rows = re.findall(r"^\| `(\w+)` \| `(\w+)`.*\| `(\w+)`[^|]*\|$", table, re.M)
    renamed = {role: column for role, column, _ in rows}
    outputs, _, conditions = others.partition(" One of ")[0].partition("; the conditions")
    named = dict.fromkeys(re.findall(r"`(\w+)`", outputs), "outputs")
    named |= dict.fromkeys(re.findall(r"`(\w+)`", conditions), "covariates")
    told = {role: place for role, _, place in rows} | named
    assert told == {
        role: "outputs" if kind == "output" else "covariates" for role, (_, kind) in ROLES.items()
    }
    assert renamed == {role: ROLES[role][0] for role in renamed}
    assert {role for role in named if QUANTITIES[ROLES[role][0]].stem != role} == set()


def test_what_a_view_gives_is_what_its_table_says() -> None:
    section = EXTEND.partition("### What `view` gives\n")[2]
    table = section.partition("`covariates = ()`")[0]
    view = View(
        conditions={"slip_ratio": np.array([0.1, -0.2]), "soil_heat": np.array([3.0, 4.0])},
        lab={"slip_ratio": 0.2}, load_kn=4.0, ground_exponent=1.0, order_range=(1.0, 9.0),
    )  # fmt: skip
    told = re.findall(r"^\| `view\.(\w+)", table, re.M)
    assert told == ["of", "lab_of", "slip", "sinkage", "column", "load_kn", "order_range"]
    assert view.of("slip").shape == view.slip().shape == (2,)
    with pytest.raises(KeyError):
        view.of("speed")
    assert (view.lab_of("slip", 9.0), view.lab_of("speed", 9.0)) == (0.2, 9.0)
    np.testing.assert_allclose(view.sinkage(), [[1.1, 1.0]])
    predicted = replace(view, base={"sinkage": np.array([[30.0, 60.0]] * 3)})
    np.testing.assert_allclose(predicted.sinkage(), [[1.0, 2.0]] * 3)
    assert (view.column("slip"), view.column("speed")) == ("slip_ratio", None)
    bare = replace(view, conditions={"speed_m_s": np.ones(2)})
    np.testing.assert_array_equal(bare.slip(), [0.0, 0.0])
