"""The methods paragraph: every number in it is the manifest's or the summary's."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from calib.data.labels import KNOWN_DATA
from calib.inference.estimators import METHODS
from calib.models import get_model
from calib.report.labels import axis_of, joined
from calib.report.numbers import format_number, format_value
from calib.report.publish.markup import joined_symbols
from calib.report.publish.records import Output

# Digits of a hash that tell two files apart; the manifest has all of them.
_HASH = 12


@dataclass(frozen=True)
class Paragraph:
    """A heading, empty for the first, and sentences with marks."""

    heading: str
    sentences: tuple[str, ...]


def methods(manifest: Mapping[str, Any], outputs: Sequence[Output]) -> list[Paragraph]:
    """Return the methods in words, see `calib.report.publish.markup` for the marks in them."""
    return [
        Paragraph("", tuple(_everything(manifest, outputs))),
        *(Paragraph(o.name, tuple(_output(o))) for o in outputs),
    ]


def _everything(manifest: Mapping[str, Any], outputs: Sequence[Output]) -> list[str]:
    """What holds for all outputs."""
    v, s = manifest["versions"], manifest["settings"]
    gate = s["gate"]
    sentences = [f"Tyre-soil models were calibrated with calib {v['terracalib']} [@calib]."]
    labels = sorted({o.label for o in outputs if o.label})
    sentences += [KNOWN_DATA[label].methods for label in labels if label in KNOWN_DATA]
    if any("genetic" in o.found["estimates"] for o in outputs):
        sentences.append(_genetic(manifest["genetic_algorithm"]))
    return [
        *sentences,
        f"Posteriors were sampled with emcee {v['emcee']} [@ForemanMackey_2013] by "
        f"{s['ensembles']} independently seeded ensembles, in which an independence move proposes "
        "pairs of opposite (antithetic) points from a mixture of Student-t distributions in "
        "straightened coordinates, fitted to the posterior by adaptive importance sampling "
        "[@Cappe_2008] from every mode that was found, beside a random walk in the same "
        "coordinates or, had the mixture resembled the posterior little, differential-evolution "
        "moves [@terBraak_2006]; "
        f"proposals of {s['ahead']} steps at a time were evaluated in one batch.",
        f"Each ensemble ran for {s['steps']} steps, doubled up to at most {s['max_steps']} until "
        "every sampled parameter passed a gate: rank-normalised split R-hat [@Vehtari_2021] of "
        f"at most {gate['rhat_max']:g}, bulk and tail effective sample sizes (ESS) of at least "
        f"{gate['ess_min']:g}, and a length of at least {gate['taus_min']:g} autocorrelation "
        "times.",
        f"Computations used Python {v['python']}, NumPy {v['numpy']} [@Harris_2020] and SciPy "
        f"{v['scipy']} [@Virtanen_2020]; diagnostics are those of ArviZ {v['arviz']} "
        f"[@Martin_2026]; figures were drawn with Matplotlib {v['matplotlib']} [@Hunter_2007] and "
        f"corner {v['corner']} [@ForemanMackey_2016].",
        f"All random numbers follow from the seed {manifest['seed']}; the command was "
        f"`{shlex.join(str(part) for part in manifest['command'])}`.",
    ]


def _genetic(settings: Mapping[str, Any]) -> str:
    return (
        "The genetic algorithm [@Cabrera_2004] weighted "
        f"differences by {settings['F']:g}, had probabilities of crossover {settings['CP']:g} and "
        f"of mutation {settings['MP']:g}, a population of {settings['NP']} and at most "
        f"{settings['max_iterations']} generations."
    )


def _output(o: Output) -> list[str]:
    return [*_model(o), *_data(o), *_inference(o), *_sampling(o), *_validation(o), *_against(o)]


def _model(o: Output) -> list[str]:
    model = get_model(o.model)
    equation = f": [={o.model}]" if model.latex else ""
    letters = f", with {model.letters}" if model.letters else ""
    return [f"The model is {o.model_words}{equation}{letters}."]


def _data(o: Output) -> list[str]:
    data, file = o.found["data"], o.task["data"]
    text = (
        f"It was calibrated on {data['n']} rows of {o.data_words} (`{file['file']}`, SHA-256 "
        f"`{file['sha256'][:_HASH]}`): "
        f"{joined([_range(name, r) for name, r in data['ranges'].items()])}."
    )
    if not o.held_out:
        return [text]
    return [text, f"The {o.found['validation']['n']} rows at {o.held_out} were held out."]


def _range(name: str, found: Mapping[str, float]) -> str:
    axis = axis_of(name)
    low, high = axis.value_text(found["lower"]), axis.value_text(found["upper"])
    both = {1: low, 2: f"{low} and {high}"}.get(int(found["distinct"]), f"{low} to {high}")
    return f"{_lower(axis.name)} {both} {axis.unit}"


def _lower(name: str) -> str:
    return name[0].lower() + name[1:]


def _inference(o: Output) -> list[str]:
    model, priors = get_model(o.model), o.task["priors"]
    output = _lower(axis_of(model.output).name)
    what = f"the logarithm of {output}" if model.response == "log" else output
    sampled = [name for name, p in o.found["posterior"].items()
               if p["posterior_to_prior_sd"] is not None]  # fmt: skip
    sentences = [
        f"The likelihood takes the rows as {_dependence(o)} and {what} as {_noise(o)}.",
        f"The sampled parameters are {joined_symbols(sampled)}; their priors, with reasons and "
        f"sources, are those of `{priors['source']}` (SHA-256 `{priors['sha256'][:_HASH]}`).",
    ]
    methods = [METHODS[m].words if m in METHODS else m for m in o.found["estimates"]]
    if methods:
        rows = f" from all {o.found['data']['n_all']} rows" if o.estimates_use_all_rows else ""
        sentences.append(
            f"Point estimates{rows} are by {joined(methods)}; least squares seeded the search for "
            "the mode from which sampling began."
        )
    return sentences


def _dependence(o: Output) -> str:
    if not o.found.get("noise", {}).get("correlated_along"):
        return "independent"
    return "correlated along a run by [$rho] to the power of how many rows they are apart"


def _noise(o: Output) -> str:
    chosen = o.found.get("noise", {})
    student, depends = chosen.get("family") == "student_t", chosen.get("depends_on")
    scale = "scale" if student else "standard deviation"
    law = "normal about the model"
    if student:
        law = "Student-t about the model with unknown degrees of freedom [$nu]"
    if not depends:
        return f"{law} {'and' if student else 'with'} one unknown {scale} [$sigma]"
    axis = axis_of(depends["column"])
    return (
        f"{law} {'and' if student else 'with'} an unknown {scale} whose logarithm is linear in "
        f"{_lower(axis.name)}: that of [$sigma] at {axis.value_text(depends['centre'])} "
        f"{axis.unit}, and [$sigma_slope] more for each {axis.value_text(depends['spread'])} "
        f"{axis.unit}"
    )


def _sampling(o: Output) -> list[str]:
    s = o.found["sampling"]
    gate = s["gate"]
    passed = "passed" if o.converged else "DID NOT PASS"
    text = (
        f"Sampling by {s['ensembles']} ensembles of {s['walkers']} walkers with {s['steps']} kept "
        f"steps each {passed} the gate: R-hat at most {_four(gate['largest_rhat'])}, ESS at least "
        f"{_whole(gate['smallest_ess_bulk'])} (bulk) and {_whole(gate['smallest_ess_tail'])} "
        f"(tail), length at least {_three(gate['smallest_steps_over_tau'])} autocorrelation times."
    )
    if o.converged:
        return [text]
    return [text, f"These numbers must not be used: {'; '.join(s['reasons'])}."]


def _validation(o: Output) -> list[str]:
    v = o.found["validation"]
    axis = axis_of(o.found["output"])
    hits = joined([f"{round(share * v['n'])}" for share in v["coverage"].values()])
    levels = joined([f"{level} %" for level in v["coverage"]])
    error = "could not be scored"
    if v["rmse"] is not None:
        error = f"missed by {format_number(axis.factor * v['rmse'])} {axis.unit} rms"
    if v["max_relative_error"] is not None:
        error += f" and {format_number(100.0 * v['max_relative_error'], 2)} % at most"
    scores = (
        f"the predictive median {error}, and the central {levels} predictive bands cover {hits} "
        f"of {v['n']}"
    )
    if v["method"] == "held_out":
        return [f"On the held-out rows, which share a curve and so are not independent, {scores}."]
    text = (
        "Each row was predicted without itself by Pareto-smoothed importance sampling "
        f"leave-one-out [@Vehtari_2017; @Vehtari_2024], {len(v['refitted'])} of {v['n']} rows by "
        f"fitting again: {scores}"
    )
    if v["elpd"] is not None and v["elpd_se"] is not None:
        text += (
            f"; the expected log predictive density is {format_value(v['elpd'], v['elpd_se'])} "
            "(standard error)"
        )
    return [f"{text}."]


def _against(o: Output) -> list[str]:
    """Of another noise than the usual: whether the rows prefer it."""
    against = o.found.get("noise", {}).get("against_normal")
    return [] if against is None else [against["sentence"]]


def _four(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.4f}"


def _whole(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.0f}"


def _three(value: float | None) -> str:
    return "undefined" if value is None else format_number(value, 3)
