"""What the benchmarks' README says: what was asked and reached, on what, how, what was tried."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median
from typing import Any

import numpy as np

from report.rows import NAMES, Row, sound

__all__ = ["readme"]

_HEAD = """# Benchmarks

Made by `make bench`; `make bench PART="posterior likelihood"` renews some of the parts posterior,
likelihood, genetic, million, campaign, survival, everyday and emulator. Medians over repeats that
take turns with the peers', with the least and the most of them; the median decides whether a level
is met. The levels are goals that were set before any of it was built. Every line is in
[results.md](results.md) and `results.csv`, every measurement in `measured/`.

![What a posterior costs, and the likelihood against its floor](benchmarks.png)
"""

_HOW = """## How it was measured

- **Time** on one core is the process's, all threads together, kept on that core: the time on the
  clock of a machine that does nothing else. On all cores it is the clock's.
- **Posterior.** One core. The three problems of the report, with all their rows: same data, priors,
  truncations, likelihood and coordinates for every sampler (`benchmarks/shared/peers.py` writes
  them in PyMC). Time is everything but PyMC's compilation: our search for modes, adaptation and
  gate, nutpie's tuning, the stretch move's burn-in (a tenth of it). The stretch move starts from
  draws of our posterior and searches for nothing. Effective sample sizes are ArviZ's, smallest over
  the parameters, of all draws that were kept, with walkers as chains. calib stores 16,384 draws of
  a posterior unless `SamplerSettings.keep` says more; here it keeps all. "Default" is 4 ensembles
  of 320 walkers and 192 steps, and nutpie's 4 chains of 1,000 draws after its tuning; "long" is 4
  ensembles of 1,024 walkers and 640 steps, and 4 chains of 10,000 draws: what a sampler does once
  what comes first is of little account. A ratio to nutpie's rate is that of a run to the run beside
  it, one to the stretch move's rate that of each of our runs to the median of its three.
- **Runs left out.** Runs of nutpie's with an R-hat above 1.01 are counted in results.md and left
  out of ratios and comparisons; in most of them a chain stays where the drawbar's density is cut
  off. {divergences} R-hat compares chains, of ours the four ensembles: 1.0001 to 1.0005. (`rhat` of
  our runs in `measured/` is over the walkers, as chains of 192 steps; so short ones have 1.009 to
  1.018 for their shortness alone.)
- **Memory.** The machine is a virtual one that gives freed memory back to its host within seconds
  and gets it anew at 3 ms for each megabyte: a sixth of the time of a long run, whose draws take
  100 MB, and nothing of nutpie's, whose draws take 2. Both run in a process that takes 2 GiB
  before the first of them and keeps what it frees, so that neither pays for the host.
- **Changed since the run before**, in which 42 of 43 were met: density's long runs had 48.4 times
  nutpie's rate where 50 are asked. Long runs then were of 320 steps, of which what comes first took
  a sixth of the time; they are of 640, and memory is held. {attribution}
- **The hour.** The machine shares its hardware with others: seconds of one long run of density
  were 1.24 to 1.54. Of two workers see below.
- **Bulk and tail.** Our draws come in opposite pairs, whose errors of a mean cancel: bulk ESS,
  which is that of means of normal scores, then exceeds what evaluations would be worth as
  independent draws, as nutpie's own does. Tail ESS, of the shares beyond the 5 and 95 % quantiles,
  gains nothing by it: it is in results.md beside the bulk's, and smaller.
- **Are those sizes honest?** Not quite. The means of 40 runs of other seeds must scatter by what
  the sizes claim, and they scatter by more: of chains of 192 steps that alternate, ArviZ's sizes
  come out too large, {honest} (ratios of variances less one, means over the parameters; the error
  of one parameter's is {honest_error}). The ratios at default settings therefore stand in the table
  twice, by ArviZ's sizes and by the scatter; nutpie's own sizes are taken as they are.
- **One posterior?** z-scores of the means and of the shares below the pooled 5, 50 and 95 %
  quantiles of every parameter (`equality.csv`), with the error of that very quantity. The limit is
  what the largest of so many exceeds once in a hundred times.
- **Evaluations** of nutpie are of the density with its gradient, each worth several of ours. The
  figure has its long runs, in which tuning counts for less.
- **Likelihood.** One core. The floor is one sine and two arctangents for each row and vector, which
  is what Eqs 12-15 take, by NumPy in place on blocks in the cache. "log posterior" is all that a
  step of the sampler asks for; libraries are compared by the sums of squares alone, ours as well,
  with the coefficients of each pressure worked out beforehand. Conditions are distinct but in the
  line that says otherwise: repeated rows are worked out once, and cost next to nothing.
- **Emulator.** A closed form of five parameters in the place of a slow simulator, so that its
  posterior is known; three data sets of 28 readings. Not blind: earlier runs on these data were
  seen while the emulator was made, and the diagnosis of the first led to nodes at slips below zero
  (two other data sets confirmed it). Each way has the same sampler; runs count those that check the
  emulator. The peer is scikit-learn's regressor on principal
  components of a Latin hypercube, its mean taken for the simulator.
- **A million rows.** All cores. The check evaluates the equation as printed at every row in plain
  NumPy, at draws of a Student-t that are weighted by it.
- **Genetic algorithm.** That of the paper's Table 2, one core, same likelihood and box, a
  population in each call for both. A seed is at the optimum if its cost is within a millionth (of
  itself) of the lowest that any run reached. The table has the methods that are at the optimum from
  every seed; results.md has all (SciPy's defaults miss it from some seeds of most problems).
- **Campaign.** Two worker processes over one process, start-up included. `benchmarks/campaign.py`
  also times two plain processes without Dask that have half of the cases each: what the two cores
  can do. Of the tiny tasks there is one run.
- **Survival.** A worker is killed at a quarter of the results and another at three quarters, the
  client with all it started at a half; the same command is given again, and its files are held
  against those of one process, byte by byte (`benchmarks/campaign_survival.py`).
- **Everyday.** Whole processes, start-up and children included, modules compiled beforehand; those
  of the commit before run in a worktree of its own with the same environment, by turns. Five runs
  each, of report and check three, of the tests one. A ratio is that of a run to the one beside it.
  One diagnosis and the import are timed inside their process. It needs no peers:
  `make bench PART=everyday` runs in the ordinary environment (`benchmarks/everyday.py`).
"""

_TRIED = """## What was tried

Figures are of the day they were tried, each against the code before it in one script; they are in
no measured file.

Sampler, by bulk ESS per second of the joint drawbar pull on one core:

- Kept, at last: no more than 16 steps before those that are kept, if walkers start at draws of a
  good proposal (26 of 320 before).
- Kept, before: a step of the walk after every 32 of pairs, in its turn, where a twentieth of the
  steps were drawn for it (each has every walker's pair found anew: density's long runs a tenth
  faster, 0.80 s for 0.87, with 4 % more effective draws); steps written by emcee's backend to where
  they stay, for memory new from the system is dear on this machine (0.89 s for 1.07 with the walk's
  turns, where results are kept from run to run); flat indices. The numbers drawn are the same for
  the last two.
- Kept, before that: **opposite pairs** of proposals for single ones (an independence sampler of
  pairs, and a step between a pair's points), one mixture with its broad component in straightened
  coordinates for two densities, scales of the straightening map that grow with every coordinate
  and not with the noise alone (a point's opposite is accepted with 0.85 for 0.79, of density 0.70
  for 0.61), what walkers do with the pairs of 16 steps worked out in one go, no copy of the state
  of emcee's random numbers at every step, and 320 walkers and 192 steps for 128 and 160. Work on
  a step, ours and emcee's, was that of 200 proposals: with 320 walkers a run of density takes as
  long as with 160 before these two (0.24 s for 0.23) and has twice the effective size. Chains of
  80 steps, tried between, tell little of how they mix: their autocorrelation time is now taken as
  that of a coordinate's distance from its median too, and is two to three steps.
- Kept, at first: proposals' densities worked out with the draws; expectation maximisation in two
  matrix products; a random walk in straightened coordinates in the place of differential
  evolution; the gate on the draws that are stored; log densities taken past emcee's loop over
  scalars; components of the mixture limited by the entries of their covariances; a twelfth of the
  steps before those that are kept: 2.5 times the rate.
- Dropped, without gain beyond their cost: Newton's method in the search for modes (quasi-Newton
  ascents in a batch were there), 12,000 draws in the place of 6,000 in each fit, a fifth round of
  adaptation at default settings (as much time as it gains; it is made where a million draws or more
  follow: density 1.26 million bulk ESS for 1.19 in long runs), one component only, fewer rounds
  (efficiency 0.65), wider or narrower components, six steps of expectation maximisation (half the
  tail ESS of density), each coordinate made normal by its own quantiles (0.83 for 0.79).
- emcee's snooker move is not used: half the exponent of ter Braak & Vrugt (2008) in its acceptance.

Second worker: two workers took 0.89 of the time of one process (1.12 times) as long as Dask had the
C library give every freed array back to the system: half of their time went to page faults. Dask
also looks into a worker a hundred times a second to see what it is at, and fifty times whether its
event loop is awake; each look takes the interpreter from the task, together a twelfth of the time
(20 diagnoses on two workers in 21.9 s with and 20.2 s without, in two plain processes without Dask
in 18.4 s; means of three runs in turn). Both are switched off for workers that calib starts itself.
Start-up, of 3 to 5 s, is in the figure. One memory arena for all threads, and thresholds that keep
the C library from ever giving memory back (6,000 page faults a diagnosis without, 140 with),
changed nothing. What is left depends on the hour, on a machine that shares its hardware with
others: 100 diagnoses in one process took 195 to 212 s in one run, and two workers gave 1.77 and
1.96; 208 and 216 s in another, and 1.79 and 1.51; 234 to 262 s in a third, and 1.73, 1.71 and 1.87;
231 to 269 s in a fourth, and 1.95, 1.96 and 1.49, when two plain processes without Dask gave 2.00,
1.85 and 1.76; 210 to 222 s in a fifth, and 1.85, 1.80 and 1.89, two plain processes 1.89, 1.84 and
1.85.

Likelihood: {libraries}
A sine is worked out as a tangent of the half argument, for which NumPy has vector instructions:
that is why the whole density can be below the floor. No compiler is a dependency.
"""


# Measured apart, by the functions of posterior.py: what held memory and longer runs are worth.
_ATTRIBUTION = """By today's code, five runs of each beside as many of nutpie's, medians:
  58.7 with neither, 56.9 with memory held, 68.9 with 640 steps, 73.3 with both."""


def readme(measured: Mapping[str, Mapping[str, Any]], rows: list[Row]) -> str:
    """Write the README from the measurements."""
    asked = [r for r in rows if r.asked]
    missed = [r for r in asked if r.met is False]
    lines = [_HEAD, "## What was asked, and what was reached", ""]
    lines += ["| | | median | range | asked | |", "|---|---|---:|---:|---|---|"]
    lines += [r.line for r in asked]
    lines += ["", f"{len(asked) - len(missed)} of {len(asked)} are met.", ""]
    if "everyday" in measured:
        lines += ["## Every day, before and after", "", *_everyday(measured["everyday"]), ""]
    lines += ["## On what", "", *_machines(measured), ""]
    how = _HOW.format(**_of_posterior(measured), attribution=_ATTRIBUTION)
    return "\n".join(lines) + "\n" + how + "\n" + _TRIED.format(libraries=_libraries(measured))


def _everyday(m: Mapping[str, Any]) -> list[str]:
    """Return a table of medians, the commit before beside this code."""
    commit = f"commit {m['before'][:7]}" if "before" in m else "not measured"
    lines = [f"Medians of seconds; before is {commit}.", "",
             "| | clock before | now | processors before | now | asked | |",
             "|---|---:|---:|---:|---:|---|---|"]  # fmt: skip
    for name, c in m["commands"].items():
        cells = [
            f"{median(c[side][by]):.3g}" if side in c else ""
            for by in ("clock", "processor") for side in ("before", "now")
        ]  # fmt: skip
        asked = met = ""
        if c["asked"] is not None:
            asked = f"≤ {c['asked']:g} s, {c['by']}"
            met = "**met**" if median(c["now"][c["by"]]) <= c["asked"] else "**missed**"
        lines.append(f"| `{name}` | {' | '.join(cells)} | {asked} | {met} |")
    return lines


def _of_posterior(measured: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """What the posterior part says of effective sizes and of nutpie's divergences."""
    if "posterior" not in measured:
        return dict.fromkeys(("honest", "honest_error", "divergences"), "(not measured)")
    problems = measured["posterior"]["problems"]
    excess = {
        NAMES[key]: 100.0 * (float(np.mean(p["replicates"]["variance_over_claimed"])) - 1.0)
        for key, p in problems.items()
    }
    honest = ", ".join(f"{name} by {value:.0f} %" for name, value in excess.items())
    error = max(p["replicates"]["standard_error_each"] for p in problems.values())
    diverged = [
        [r["divergences"] for r in p["runs"]["nutpie long"] if sound(r)] for p in problems.values()
    ]
    most = max((max(d) for d in diverged if d), default=0.0)
    divergences = (
        f"Those that are kept have up to {most:.0f} divergent transitions of 40,000 (results.md)."
    )
    return {"honest": honest, "honest_error": f"{error:.2f}", "divergences": divergences}


def _machines(measured: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """One line for each machine that parts were measured on, and the load they met."""
    parts: dict[str, list[str]] = {}
    for part, m in measured.items():
        machine = m.get("machine")
        if not isinstance(machine, dict):
            continue
        versions = ", ".join(f"{n} {v}" for n, v in machine["versions"].items())
        text = (
            f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gib']} GiB, "
            f"{machine['system']}; {versions}."
        )
        load = machine["load_average_1_min"]
        parts.setdefault(text, []).append(f"{part} {load:g}")
    return [
        f"- {text} Load average as each part began: {', '.join(p)}." for text, p in parts.items()
    ]


def _libraries(measured: Mapping[str, Mapping[str, Any]]) -> str:
    if "likelihood" not in measured:
        return "not measured here."
    found = []
    for r in measured["likelihood"]["peers"]:
        speeds = ", ".join(
            f"{n} {s['median']:.2f}" for n, s in r["speed_over_calib"].items() if n != "calib"
        )
        found.append(f"{speeds} at {r['rows']:,} rows")
    first = [r["first_call_seconds"]["JAX"] for r in measured["likelihood"]["peers"]]
    return (
        "speed of the sums of squares over ours, on one core in double precision, coefficients of "
        f"each pressure handed over ready: {'; '.join(found)}. "
        f"(Numba has no vectorised arctangent without Intel's library. JAX is as fast as NumPy; it "
        f"takes 360 MB of disk, and {min(first):.1f} to {max(first):.1f} s to compile each shape.)"
    )
