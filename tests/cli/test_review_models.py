"""Every model, from its template through every verb."""

from __future__ import annotations

import csv
import io
from html import unescape
from pathlib import Path

import pytest

from calib.errors import CalibError
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS, example_csv
from calib.validation.replicate import Item, replicate
from tests.commands import Calib

# Too few steps to pass the gate: what is tried is that every verb comes to its end.
FEW = ["--max-steps", 100, "--workers", 1]
QUICK = [
    "wismer_luth", "brixius", "reece", "bekker_plate", "lyasko", "janosi_hanamoto", "upadhyaya",
    "elliptic_contact", "maclaurin_rut", "reece_plate",
]  # fmt: skip
SLOW = ["wong_reece_pull", "wong_reece_torque", "wong_reece_sinkage"]
PAPER = [
    "ayers_perumpral", "ayers_perumpral_volumetric", "magic_formula", "magic_formula_pressure",
    "bekker", "modified_bekker",
]  # fmt: skip
# Beside which a model is compared; torque and shear stress have one model each.
BESIDE = {
    "ayers_perumpral": "ayers_perumpral_volumetric",
    "ayers_perumpral_volumetric": "ayers_perumpral", "magic_formula": "upadhyaya",
    "magic_formula_pressure": "magic_formula", "bekker": "modified_bekker",
    "modified_bekker": "bekker",
    "wismer_luth": "brixius", "brixius": "wismer_luth", "reece": "bekker_plate",
    "bekker_plate": "bekker", "lyasko": "modified_bekker", "wong_reece_pull": "wismer_luth",
    "wong_reece_sinkage": "lyasko", "upadhyaya": "magic_formula",
    "elliptic_contact": "upadhyaya", "maclaurin_rut": "bekker",
    "reece_plate": "reece",
}  # fmt: skip


def fitted_and_checked(calib: Calib, model: str) -> None:
    written = calib("template", model, "--out", "my.csv")
    assert written.code == 0, written.err
    fitted = calib("fit", "my.csv", "--model", model, "--out", "run", *FEW)
    assert fitted.code in (0, 3), fitted.err
    told = calib("predict", "run", "--at", "my.csv", "--out", "bands.csv")
    assert told.code == fitted.code, told.err
    lines = Path("bands.csv").read_text().splitlines()
    assert len(lines) == len(example_csv(model).splitlines())
    assert f"{MODELS[model].output}_predictive_90_lower" in lines[0]


# The others go through every verb below.
@pytest.mark.parametrize("model", ["reece", "janosi_hanamoto"])
def test_a_model_from_template_to_bands(calib: Calib, model: str) -> None:
    fitted_and_checked(calib, model)


def both_columns(model: str, other: str) -> str:
    """The example of a model, with the conditions that another needs besides, each the same."""
    rows = list(csv.DictReader(io.StringIO(example_csv(model))))
    more = next(csv.DictReader(io.StringIO(example_csv(other))))
    text = io.StringIO()
    writer = csv.DictWriter(text, list({**rows[0], **more}), lineterminator="\n")
    writer.writeheader()
    writer.writerows({**more, **row} for row in rows)
    return text.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize("model", [*PAPER, *QUICK, *SLOW])
def test_a_model_through_every_verb(
    calib: Calib, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SamplerSettings, "n_walkers", lambda self, n_dim: 2 * (n_dim + 1))
    fitted_and_checked(calib, model)
    checked = calib("check", "run", "--workers", 1)
    assert checked.code == 0, checked.out
    assert checked.out.startswith("SAME, bit for bit")
    reported = calib("report", "my.csv", "--model", model, "--out", "report", *FEW)
    assert reported.code in (0, 3), reported.err
    assert MODELS[model].title in unescape(Path("report/index.html").read_text())
    few = SamplerSettings(steps=100, max_steps=100)
    for i in range(2):
        record = replicate(Item(model, i, 1, few))
        assert set(MODELS[model].parameters) <= set(record["ranks"])
        assert record["rows"] + record["no_band"] > 0
    if model not in BESIDE:
        return
    other = BESIDE[model]
    Path("both.csv").write_text(both_columns(model, other))
    compared = calib("compare", model, other, "both.csv", "--out", "compared", *FEW)
    assert compared.code in (0, 3), compared.err
    again = calib("check", "compared", "--workers", 1)
    assert again.code == 0, again.out
    stacked = calib("predict", "compared", "--at", "both.csv", "--out", "stacked.csv")
    assert stacked.code == compared.code, stacked.err


def test_no_model_is_left_out() -> None:
    assert {*PAPER, *QUICK, *SLOW} == set(MODELS)
    alone = {m for m in MODELS if [MODELS[o].output for o in MODELS].count(MODELS[m].output) == 1}
    assert set(MODELS) - set(BESIDE) == alone


def test_slow_models_are_left_out_of_sbc_unless_named(
    calib: Calib, monkeypatch: pytest.MonkeyPatch
) -> None:
    from calib.batch.campaign.kinds import SbcSection
    from calib.validation.sbc import chosen_models

    assert [m for m in MODELS if MODELS[m].slow] == SLOW
    assert set(chosen_models()) == set(MODELS) - set(SLOW)
    assert chosen_models(SLOW[:1]) == SLOW[:1]
    assert SbcSection(name="ranks", simulations=1, draw_seed=1).models == chosen_models()

    def stop(*_: object, **__: object) -> None:
        raise CalibError("begun")

    monkeypatch.setattr("calib.validation.sbc.run_sbc", stop)
    told = calib("sbc", "--out", "sbc").err
    assert "begun" in told
    assert f"left out: {', '.join(SLOW)}, of which each campaign takes minutes" in told
    assert "left out" not in calib("sbc", "--out", "sbc", "--model", SLOW[0]).err
