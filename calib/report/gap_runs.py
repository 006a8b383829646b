"""What a diagnosis says of a change over the order of the runs, in whichever form it may be."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.special import softmax

from calib.gap.diagnose import Diagnosis
from calib.gap.effects import Effect
from calib.gap.inclusion import UNLISTED
from calib.report.gap_facts import NEITHER, RunsFact
from calib.report.gap_rows import output_word
from calib.report.labels import joined


def over_runs(found: Diagnosis) -> RunsFact | None:
    """Say how probable it is that a reading changes over the runs, and in which form.

    Of the outputs that may, those that most probably do; None where none is at all likely to.
    """
    facts = [_of(found, (o.name,)) for o in found.data.outputs]
    if len(found.data.outputs) > 1:
        facts.append(_of(found, found.data.names))
    best = max(facts, key=lambda fact: fact.probability)
    return best if best.probability >= 0.05 else None


def _of(found: Diagnosis, outputs: Sequence[str]) -> RunsFact:
    p = found.ranking.probability
    roles = [o.role for o in found.data.outputs if o.name in outputs]
    # Of several outputs at once nothing that is listed changes the reading over the runs.
    kinds = {name: _kind(e) for name, e in _faults(found).items() if list(e.outputs) == roles}
    forms = dict.fromkeys(kinds.values(), 0.0)
    total, causes = 0.0, dict.fromkeys(kinds, 0.0)
    for name, probability in p.items():
        acting = {kinds[cause] for cause in name.split("+") if cause in kinds}
        total += probability if acting else 0.0
        causes |= {c: causes[c] + probability for c in name.split("+") if c in kinds}
        # One that is a drift and a step at once is neither by itself.
        both = "a drift and a step at once" if len(acting) > 1 else ""
        for kind in [both] if both else acting:
            forms[kind] = forms.get(kind, 0.0) + probability
    unlisted = _unlisted(found, tuple(outputs))
    forms[NEITHER] = unlisted
    ranked = sorted(forms.items(), key=lambda form: -form[1])
    return RunsFact(
        joined([output_word(o) for o in outputs]), total + unlisted, ranked,
        together=len(outputs) > 1, only=len(found.data.outputs) == 1,
        surest=max(causes.values(), default=0.0),
    )  # fmt: skip


def _faults(found: Diagnosis) -> dict[str, Effect]:
    """Instruments that fail with run order, of those that are tried, by name."""
    fits = (fit for group in found.ranking.fits.values() for fit in group)
    effects = (e for fit in fits for e in fit.forward.hypothesis.effects)
    return {e.name: e for e in effects if e.instrument and "order" in e.covariates}


def _kind(effect: Effect) -> str:
    return "a step" if "change_point" in effect.parameters else "a drift"


def _unlisted(found: Diagnosis, outputs: tuple[str, ...]) -> float:
    """Probability that something unlisted follows the order of the runs in just these outputs."""
    ranking = found.ranking
    if UNLISTED not in ranking.fits:
        return 0.0
    hypotheses = [fit.forward.hypothesis for fit in ranking.fits[UNLISTED]]
    weights = softmax(ranking.scores[UNLISTED])
    part = sum(
        float(w)
        for h, w in zip(hypotheses, weights, strict=True)
        if "order" in (h.smooth_over, h.onset_over) and h.smooth_outputs == outputs
    )
    return part * ranking.probability[UNLISTED]
