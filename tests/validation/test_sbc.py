"""Simulation-based calibration: ranks, p values, coverage, power, and runs in a folder."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from typer.testing import CliRunner

from calib.cli.app import app
from calib.errors import CalibError
from calib.inference.prior_files import default_priors
from calib.report.sbc import text_table, verdict
from calib.validation import sbc
from calib.validation.replicate import Item, simulated
from calib.validation.sbc import _coverage, ecdf_band, p_value, pit, run_sbc
from calib.validation.sbc import score as score_of
from calib.validation.scores import holm
from tests.browser import Browser, faults


def statistic(values: np.ndarray) -> float:
    """The smallest pointwise tail, written out."""
    n = values.size
    tails = []
    for i in range(1, n):
        k = int((values <= i / n).sum())
        law = stats.binom(n, i / n)
        tails += [law.cdf(k), law.sf(k - 1)]
    return min(tails)


def p_by_transitions(n: int, tail: float) -> float:
    """An independent way: counts are a Markov chain with binomial steps."""
    mass = {0: 1.0}
    for i in range(1, n):
        z, before = i / n, (i - 1) / n
        law, new = stats.binom(n, z), {}
        for k, m in mass.items():
            step = stats.binom(n - k, (z - before) / (1.0 - before))
            for j in range(n - k + 1):
                if min(law.cdf(k + j), law.sf(k + j - 1)) > tail * (1.0 + 1e-9):
                    new[k + j] = new.get(k + j, 0.0) + m * step.pmf(j)
        mass = new
    return 1.0 - sum(mass.values())


@pytest.mark.parametrize("seed", range(6))
def test_the_p_value_is_that_of_a_slow_and_plain_recursion(seed: int) -> None:
    values = np.random.default_rng(seed).uniform(size=12) ** (1.0 + 0.5 * seed)
    expected = p_by_transitions(12, statistic(values))
    assert p_value(values) == pytest.approx(expected, rel=1e-8, abs=1e-12)


def test_p_values_of_uniform_samples_are_uniform() -> None:
    rng = np.random.default_rng(2)
    found = np.array([p_value(rng.uniform(size=60)) for _ in range(1000)])
    for level in (0.01, 0.05, 0.2, 0.5):
        # They are discrete: P(p <= level) may fall short of the level a little, never exceed it.
        hits = int((found <= level).sum())
        assert stats.binomtest(hits, 1000, level, alternative="greater").pvalue > 1e-3
        assert hits > 0.6 * 1000 * level


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 80), power=st.floats(0.2, 5.0))
def test_a_p_value_is_a_probability_whatever_the_side(seed: int, n: int, power: float) -> None:
    values = np.random.default_rng(seed).uniform(size=n) ** power
    assert 0.0 <= p_value(values) <= 1.0
    assert p_value(1.0 - values) == pytest.approx(p_value(values), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("shape", [(0.5, 0.5), (2.0, 2.0), (1.5, 1.0), (1.0, 1.5)])
def test_what_is_not_uniform_is_found(shape: tuple[float, float]) -> None:
    """Too narrow, too wide, biased up, biased down."""
    assert p_value(stats.beta(*shape).rvs(300, random_state=1)) < 1e-4


@pytest.mark.parametrize("n", [40, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("level", [0.9, 0.95])
def test_arviz_bands_hold_the_whole_curve_as_often_as_they_say(n: int, level: float) -> None:
    rng = np.random.default_rng(3)
    band = ecdf_band(rng.uniform(size=n), level)
    assert band.x[0] == band.ecdf[0] == 0.0
    assert band.x[-1] == band.ecdf[-1] == 1.0
    x = band.x[1:-1]
    samples = np.sort(rng.uniform(size=(2000, n)), axis=1)
    inside = 0
    for sample in samples:
        ecdf = np.searchsorted(sample, x, side="right") / n
        inside += bool(((ecdf >= band.lower[1:-1]) & (ecdf <= band.upper[1:-1])).all())
    # The band is simulated itself, from 4000 samples: a standard error of its own.
    error = np.sqrt(level * (1.0 - level) * (1.0 / 2000 + 1.0 / 4000))
    assert abs(inside / 2000 - level) < 5.0 * error


def test_ranks_are_spread_over_their_share() -> None:
    ranks = [[0, 3], [3, 3], [1, 3]]
    drawn = np.array([pit(ranks, np.random.default_rng(s)) for s in range(400)])
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    np.testing.assert_allclose(low, [0.0, 0.75, 0.25], atol=0.01)
    np.testing.assert_allclose(high, [0.25, 1.0, 0.5], atol=0.01)


SIMULATIONS, DRAWS, ROWS, EXPERIMENTS = 300, 400, 5, 10


def least_p(rng: np.random.Generator, *, scale: float, shift: float) -> float:
    """Adjusted p value of a run whose posterior is wrong by a factor of its sd and a shift.

    A level theta ~ N(0, 1) seen in `ROWS` readings of unit noise; the posterior is normal.
    """
    theta = rng.standard_normal((SIMULATIONS, 1))
    y = theta + rng.standard_normal((SIMULATIONS, ROWS))
    sd = (1.0 + ROWS) ** -0.5
    mean = y.sum(axis=1, keepdims=True) * sd**2
    drawn = mean + sd * (shift + scale * rng.standard_normal((SIMULATIONS, DRAWS)))

    def log_likelihood(level: np.ndarray) -> np.ndarray:
        return -0.5 * np.square(y[:, :, None] - level[:, None]).sum(axis=1)

    quantities = {
        "theta": (drawn, theta),
        "log_likelihood": (log_likelihood(drawn), log_likelihood(theta)),
        "reading": (
            drawn + rng.standard_normal(drawn.shape), theta + rng.standard_normal(theta.shape)
        ),
    }  # fmt: skip
    p = [
        p_value(pit([[int(b), DRAWS] for b in (d < t).sum(axis=1)], rng))
        for d, t in quantities.values()
    ]
    return min(holm(p))


@pytest.mark.parametrize(
    ("scale", "shift", "found"),
    [
        (0.8, 0.0, True),
        pytest.param(1.25, 0.0, True, marks=pytest.mark.slow),
        (1.0, 0.3, True),
        (1.0, 0.0, False),
    ],
)
def test_wrong_posteriors_are_found_and_right_ones_pass(
    scale: float, shift: float, found: bool
) -> None:
    rng = np.random.default_rng(6)
    alarms = sum(least_p(rng, scale=scale, shift=shift) < 0.05 for _ in range(EXPERIMENTS))
    if found:
        assert alarms >= 0.9 * EXPERIMENTS
    else:
        # A twentieth by chance: five of ten would happen once in sixteen thousand times.
        assert alarms < 5


def covered_records(covered: np.ndarray, rows: int) -> list[dict]:
    return [{"rows": rows, "covered": {"95": int(c)}} for c in covered]


def test_the_error_of_a_coverage_is_that_of_rows_or_of_campaigns():
    """Ten campaigns that nearly all cover wholly hardly show their spread; all or nothing do."""
    few = _coverage(0.95, covered_records(np.array([9] * 9 + [8]), 9))
    assert few.se == pytest.approx(np.sqrt(0.95 * 0.05 / 90))
    assert few.p > 0.05
    covered = np.array([9] * 38 + [0] * 2)
    shared = _coverage(0.95, covered_records(covered, 9))
    assert shared.se == pytest.approx((covered / 9).std(ddof=1) / np.sqrt(40))
    assert shared.p == pytest.approx(1.0)
    none = _coverage(0.95, covered_records(np.zeros(3, dtype=int), 0))
    assert np.isnan(none.proportion)
    assert none.p == 1.0


def test_right_bands_raise_alarms_as_often_as_they_should():
    """Of independent rows: p below 0.05 in a twentieth of the runs, and never much more."""
    rng = np.random.default_rng(3)
    runs = [_coverage(0.95, covered_records(rng.binomial(9, 0.95, n), 9)) for n in (10, 300) * 200]
    for few in (0, 1):
        share = np.mean([run.p < 0.05 for run in runs[few::2]])
        assert share < 0.05 + 4.0 * np.sqrt(0.05 * 0.95 / 200)


def test_a_run_of_which_all_failed_says_why():
    with pytest.raises(CalibError, match="could be calibrated: no disk"):
        score_of([], 1, 10, {"bekker-0000": "no disk"})


NAMES = ("bekker", "modified_bekker")


def ranked(item: Item) -> dict[str, Any]:
    """A record of the item's own campaign, ranks as those of a posterior that is right."""
    rng = np.random.default_rng([item.index, item.seed])
    names = (*simulated(item).problem.names, "prediction")
    return {
        "model": item.model, "index": item.index, "seed": item.seed, "design": "here",
        "attempts": 1, "converged": True, "reasons": [], "steps": 100, "extended": False,
        "ranks": {name: [int(rng.integers(400)), 399] for name in names},
        "covered": {"50": 5, "90": 9, "95": 10}, "rows": 10, "no_band": 0,
    }  # fmt: skip


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replicates are not calibrated here; `test_replicate.py` does."""
    monkeypatch.setattr(sbc, "replicate", ranked)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sbc") / "run"
    words = "sbc --model bekker --simulations 10 --seed 3 --workers 1 --out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sbc, "replicate", ranked)
        result = CliRunner().invoke(app, [*words.split(), str(folder)])
    assert result.exit_code == 0, result.output
    assert "No miscalibration found" in result.output
    return folder


def test_the_command_leaves_numbers_figures_and_a_page(out: Path) -> None:
    assert {p.name for p in out.iterdir()} == {
        "run.json", "replicates", "sbc.json", "figures", "index.html",
    }  # fmt: skip
    assert {p.name for p in (out / "figures").iterdir()} == {"bekker.png", "coverage.png"}
    found = json.loads((out / "sbc.json").read_text())
    assert (found["seed"], found["alarms"]) == (3, [])
    model = found["models"]["bekker"]
    assert model["replicates"] == 10
    assert set(model["coverage"]) == {"50", "90", "95"}
    for quantity in model["quantities"].values():
        assert len(quantity["pit"]) == 10
        assert quantity["p"] <= quantity["p_adjusted"]
    html = (out / "index.html").read_text()
    assert not re.search(r"https?://|@import|url\(", html)
    assert html.count('src="data:image/png;base64,') == 2


def test_the_page_holds_in_a_browser(out: Path, browser: Browser) -> None:
    assert faults(browser, out / "index.html") == []


def test_a_run_is_resumed_and_extended(tmp_path: Path) -> None:
    first = run_sbc(tmp_path / "run", models=NAMES, simulations=2, seed=1)
    files = sorted((tmp_path / "run" / "replicates").glob("*-*.json"))
    assert len(files) == 4
    before = {f: (f.read_bytes(), f.stat().st_mtime_ns) for f in files}
    files[2].unlink()
    more = run_sbc(tmp_path / "run", models=NAMES, simulations=3, seed=1)
    assert [m.replicates for m in first.models] == [2, 2]
    assert [m.replicates for m in more.models] == [3, 3]
    for path, (content, changed) in before.items():
        assert path.read_bytes() == content
        assert (path.stat().st_mtime_ns == changed) == (path != files[2])


def test_what_does_not_fit_is_refused(out: Path, tmp_path: Path) -> None:
    with pytest.raises(CalibError, match="another seed"):
        run_sbc(out, models=("bekker",), simulations=10, seed=4)
    with pytest.raises(CalibError, match="there is no model"):
        run_sbc(out, models=("no_such",), simulations=10, seed=3)
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(CalibError, match="holds no simulation-based calibration"):
        run_sbc(tmp_path, simulations=3, seed=1)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_replicates_that_fail_are_named_and_the_others_are_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(item):
        if item.index == 1:
            raise CalibError("no luck")
        return ranked(item)

    monkeypatch.setattr(sbc, "replicate", broken)
    found = run_sbc(tmp_path / "run", models=NAMES[:1], simulations=3, seed=1)
    assert list(found.models[0].failed) == ["bekker-0001"]
    assert found.models[0].replicates == 2
    assert "(1 failed)" in text_table(found)


def test_a_miscalibration_is_said_first(out: Path) -> None:
    found = run_sbc(out, models=("bekker",), simulations=10, seed=3)
    (model,) = found.models
    spoilt = replace(model.quantities[0], p=1e-6)
    bad = replace(found, models=(replace(model, quantities=(spoilt, *model.quantities[1:])),))
    assert verdict(bad).startswith(f"MISCALIBRATED: {spoilt.name} of bekker")


def test_a_prior_file_chooses_the_noise_that_is_proved(tmp_path: Path) -> None:
    heavy, along = tmp_path / "heavy.toml", tmp_path / "along.toml"
    more = {
        heavy: ("modified_bekker", 'family = "student_t"\nnoise_depends_on = "slip"\n'),
        along: ("bekker", 'correlated_along = "run_order"\n'),
    }
    for path, (model, noise) in more.items():
        text = default_priors(model).read_text(encoding="utf-8")
        path.write_text(f"{text}\n[likelihood]\n{noise}", encoding="utf-8")
    found = run_sbc(tmp_path / "run", models=NAMES, priors=[heavy, along], simulations=2, seed=1)
    named = {m.model: {q.name for q in m.quantities} for m in found.models}
    assert {"nu", "sigma_slope", "sigma"} <= named["modified_bekker"] - named["bekker"] | {"sigma"}
    assert "rho" in named["bekker"]
    # A run of other priors is another run.
    with pytest.raises(CalibError, match="other sampler settings or priors"):
        run_sbc(tmp_path / "run", models=NAMES, simulations=2, seed=1)
    with pytest.raises(CalibError, match="priors of modified_bekker"):
        run_sbc(tmp_path / "other", models=NAMES[:1], priors=[heavy], simulations=2, seed=1)


def test_a_run_that_was_killed_as_it_began_begins_again(tmp_path: Path) -> None:
    (tmp_path / ".run.json.part").write_text('{"see', encoding="utf-8")
    run_sbc(tmp_path, models=["bekker"], simulations=2, seed=3)
    assert json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))["seed"] == 3
