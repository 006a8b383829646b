"""The generator made to order must be the generator."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from calib.challenge.design import Needs, draw_columns, draw_design, draw_models, draw_outputs
from calib.challenge.effects import LISTED, UNLISTED
from calib.challenge.oracle.causes import causes_of, unlisted_states
from calib.challenge.oracle.designs import log_design, plan_shares
from calib.challenge.oracle.script import branches
from calib.challenge.shift import draw_shift


def test_branches_are_as_frequent_as_draws() -> None:
    """Layouts of a design, enumerated and drawn, agree to four standard errors."""
    needs = Needs(varies=("speed_m_s",))

    def draw(rng: np.random.Generator) -> tuple[object, ...]:
        outputs = draw_outputs(rng, needs)
        models = tuple(draw_models(rng, outputs, needs).items())
        return models, draw_columns(rng, outputs, needs, 3)

    shares: Counter[object] = Counter()
    for branch in branches(draw):
        shares[branch.at()] += branch.probability  # type: ignore[assignment]
    assert sum(shares.values()) == pytest.approx(1.0)
    rng, n = np.random.default_rng(1), 4000
    seen = Counter(draw(rng) for _ in range(n))
    assert set(seen) <= set(shares)
    for what, share in shares.most_common(10):
        assert abs(seen[what] / n - share) < 4.0 * np.sqrt(share * (1.0 - share) / n)


@pytest.mark.parametrize("kind", [*LISTED.values(), *UNLISTED], ids=lambda k: k.name)
def test_every_variant_is_a_branch(kind) -> None:
    """Probabilities add up to one, and each variant has that of its draws."""
    shares: Counter[str] = Counter()
    for branch in branches(kind.draw):
        shares[branch.at().variant] += branch.probability  # type: ignore[assignment]
    assert sum(shares.values()) == pytest.approx(1.0)
    rng, n = np.random.default_rng(2), 600
    drawn = {kind.draw(rng).variant for _ in range(n)}
    assert drawn >= set(shares) - {"short", "long"}


def test_dials_are_quantiles() -> None:
    """A uniform dial at 0 and 1 gives the ends of its range, a normal one its sd at 1."""
    (hard_pan,) = branches(UNLISTED[0].draw)
    texts = [hard_pan.at([u]).at(1.0).sentence for u in (0.0, 1.0)]
    assert "12 mm" in texts[0]
    assert "45 mm" in texts[1]
    without_length = next(b for b in branches(draw_shift) if len(b.normal) == 6)
    assert without_length.probability == pytest.approx(0.7)
    assert without_length.at([1.0])[0]["support"] == pytest.approx(0.8)


def test_causes_share_out_their_state() -> None:
    """Variants and signs of each state have shares that add up to one."""
    for state in (*LISTED, *unlisted_states(), "parameter_shift"):
        assert sum(cause.share for cause in causes_of(state)) == pytest.approx(1.0)
    assert {c.sign: round(c.share, 3) for c in causes_of("rate_effect")[:2]} == {
        1.0: 0.375,
        -1.0: 0.125,
    }


@pytest.mark.parametrize("tier", ["easy", "hard"])
def test_plan_is_shared_out(tier) -> None:
    """Shares are those of the plan; pairs in the hard tier only."""
    shares = plan_shares(tier)
    assert sum(shares.values()) == pytest.approx(1.0)
    assert sum(v for k, v in shares.items() if k.startswith("unknown:")) == pytest.approx(1 / 8)
    assert sum("+" in name for name in shares) == (78 if tier == "hard" else 0)


@pytest.mark.parametrize("state", ["slip_sinkage", "cone_index_bias", "rate_effect+sensor_drift"])
def test_a_design_tells_as_much_as_importance_weights_ask(state: str) -> None:
    """Over designs drawn for no effect, the ratio to those drawn for a state averages one."""
    rng, ratios = np.random.default_rng(3), []
    for _ in range(1500):
        design = draw_design(rng, "hard", Needs())
        ratios.append(np.exp(log_design(design, state) - log_design(design, "none")))
    error = np.std(ratios) / np.sqrt(len(ratios))
    assert np.mean(ratios) == pytest.approx(1.0, abs=4.0 * error)
