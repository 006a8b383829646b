"""A run: resumable, the same on any number of processes, and what it leaves."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from calib.cli.app import app
from calib.errors import CalibError
from calib.inference.diagnostics import Gate
from calib.inference.prior_files import default_priors
from calib.inference.sampler import SamplerSettings
from calib.report.sbc import text_table, verdict
from calib.validation.sbc import run_sbc
from tests.browser import Browser, faults

MODELS = ("bekker", "modified_bekker")
QUICK = SamplerSettings(steps=100, max_steps=400)
# Where it does not matter how well replicates converge.
SHORT = SamplerSettings(steps=40, max_steps=40, gate=Gate(rhat_max=10.0, ess_min=0.0, taus_min=0.0))


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sbc") / "run"
    result = CliRunner().invoke(
        app,
        ["sbc", "--out", str(folder), "--model", "bekker", "--simulations", "10", "--seed", "3",
         "--workers", "1"],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "No miscalibration found" in result.output
    return folder


def test_the_command_leaves_numbers_figures_and_a_page(out: Path) -> None:
    assert {p.name for p in out.iterdir()} == {
        "run.json", "replicates", "sbc.json", "figures", "index.html",
    }  # fmt: skip
    assert {p.name for p in (out / "figures").iterdir()} == {"bekker.png", "coverage.png"}
    found = json.loads((out / "sbc.json").read_text())
    assert found["seed"] == 3
    assert found["alarms"] == []
    model = found["models"]["bekker"]
    assert model["replicates"] == 10
    assert set(model["coverage"]) == {"50", "90", "95"}
    for quantity in model["quantities"].values():
        assert len(quantity["pit"]) == 10
        assert quantity["p"] <= quantity["p_adjusted"]


def test_the_page_makes_no_request_and_has_its_figures_inside(out: Path) -> None:
    html = (out / "index.html").read_text()
    assert not re.search(r"https?://|@import|url\(", html)
    assert html.count('src="data:image/png;base64,') == 2
    assert "calib" in html


def test_the_page_holds_in_a_browser(out: Path, browser: Browser) -> None:
    assert faults(browser, out / "index.html") == []


def test_a_run_is_resumed_and_extended(out: Path, tmp_path: Path) -> None:
    first = run_sbc(tmp_path / "run", models=MODELS, simulations=3, seed=1, settings=SHORT)
    files = sorted((tmp_path / "run" / "replicates").glob("*-*.json"))
    assert len(files) == 6
    before = {f: (f.read_bytes(), f.stat().st_mtime_ns) for f in files}
    files[2].unlink()
    more = run_sbc(tmp_path / "run", models=MODELS, simulations=4, seed=1, settings=SHORT)
    assert [m.replicates for m in first.models] == [3, 3]
    assert [m.replicates for m in more.models] == [4, 4]
    for path, (content, changed) in before.items():
        assert path.read_bytes() == content
        assert (path.stat().st_mtime_ns == changed) == (path != files[2])


@pytest.mark.slow
def test_two_processes_give_what_one_gives(tmp_path: Path) -> None:
    for workers in (1, 2):
        run_sbc(
            tmp_path / str(workers), models=MODELS[:1], simulations=4, seed=2, settings=QUICK,
            workers=workers,
        )  # fmt: skip
    one, two = (
        {p.name: p.read_bytes() for p in (tmp_path / w / "replicates").glob("*-*.json")}
        for w in "12"
    )
    assert len(one) == 4
    assert one == two


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda folder: {"seed": 4, "simulations": 10}, "another seed"),
        (lambda folder: {"models": ("no_such",)}, "there is no model"),
    ],
)
def test_what_does_not_fit_is_refused(out: Path, spoil, message: str) -> None:
    arguments = {"models": ("bekker",), "simulations": 10, "seed": 3, **spoil(out)}
    with pytest.raises(CalibError, match=message):
        run_sbc(out, **arguments)


def test_a_folder_of_something_else_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(CalibError, match="holds no simulation-based calibration"):
        run_sbc(tmp_path, simulations=3, seed=1)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_replicates_that_fail_are_named_and_the_others_are_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from calib.validation.sbc import run as module

    whole = module.replicate

    def broken(item):
        if item.index == 1:
            raise CalibError("no luck")
        return whole(item)

    monkeypatch.setattr(module, "replicate", broken)
    found = run_sbc(tmp_path / "run", models=MODELS[:1], simulations=3, seed=1, settings=QUICK)
    assert list(found.models[0].failed) == ["bekker-0001"]
    assert found.models[0].replicates == 2
    assert "(1 failed)" in text_table(found)


def test_a_miscalibration_is_said_first(out: Path) -> None:
    from dataclasses import replace

    found = run_sbc(out, models=("bekker",), simulations=10, seed=3)
    (model,) = found.models
    spoilt = replace(model.quantities[0], p=1e-6)
    bad = replace(found, models=(replace(model, quantities=(spoilt, *model.quantities[1:])),))
    assert verdict(bad).startswith("MISCALIBRATED: k of bekker")


def test_a_prior_file_chooses_the_noise_that_is_proved(tmp_path: Path) -> None:
    path = tmp_path / "heavy.toml"
    text = default_priors("modified_bekker").read_text(encoding="utf-8")
    path.write_text(f'{text}\n[likelihood]\nfamily = "student_t"\nnoise_depends_on = "slip"\n')
    options = {"simulations": 2, "seed": 1, "settings": SHORT}
    found = run_sbc(tmp_path / "run", models=MODELS, priors=[path], **options)
    named = {m.model: {q.name for q in m.quantities} for m in found.models}
    assert {"nu", "sigma_slope", "sigma"} <= named["modified_bekker"]
    assert "nu" not in named["bekker"]
    # A run of other priors is another run.
    with pytest.raises(CalibError, match="other sampler settings or priors"):
        run_sbc(tmp_path / "run", models=MODELS, **options)
    with pytest.raises(CalibError, match="priors of modified_bekker"):
        run_sbc(tmp_path / "other", models=MODELS[:1], priors=[path], **options)


def test_a_run_that_was_killed_as_it_began_begins_again(tmp_path: Path) -> None:
    (tmp_path / ".run.json.part").write_text('{"see', encoding="utf-8")
    run_sbc(tmp_path, models=["bekker"], simulations=2, seed=3, settings=SHORT)
    assert json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))["seed"] == 3


def test_the_option_of_correlated_noise_is_simulated(tmp_path: Path) -> None:
    priors = tmp_path / "along.toml"
    extra = '\n[likelihood]\ncorrelated_along = "run_order"\n'
    priors.write_text(default_priors("bekker").read_text(encoding="utf-8") + extra, "utf-8")
    score = run_sbc(
        tmp_path / "out", models=["bekker"], simulations=3, seed=3, settings=SHORT, priors=[priors]
    )
    assert "rho" in {quantity.name for quantity in score.models[0].quantities}
