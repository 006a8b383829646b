"""The methods: every number is the manifest's or the summary's, none is remembered."""

from __future__ import annotations

import copy
import itertools
import re
from importlib.metadata import version
from typing import Any

import pytest

from calib.report.publish import publication
from calib.report.publish.markup import entries
from tests.report.publish.reader import check

NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)*")


def text_of(manifest: dict[str, Any], summary: dict[str, Any]) -> str:
    """The methods without references."""
    found = publication(manifest, summary)
    return " ".join(f"{heading}. {body}" for heading, body in found.methods).replace("\u00a0", " ")


@pytest.fixture(scope="module")
def text(he2019) -> str:
    return text_of(*he2019)


def changed(document: dict[str, Any], path: tuple[str, ...], value: Any) -> dict[str, Any]:
    other = copy.deepcopy(document)
    place: Any = other
    for key in path[:-1]:
        place = place[key]
    assert path[-1] in place, path
    place[path[-1]] = value
    return other


MANIFEST_LEAVES: list[tuple[tuple[str, ...], Any]] = [
    (("seed",), 777),
    (("command",), ["calib", "report", "--seed", "777"]),
    (("settings", "ensembles"), 7),
    (("settings", "steps"), 777),
    (("settings", "max_steps"), 77_777),
    (("settings", "gate", "rhat_max"), 1.07),
    (("settings", "gate", "ess_min"), 777.0),
    (("settings", "gate", "taus_min"), 77.0),
    (("tasks", "drawbar_pull", "held_out", "value"), 33.0),
    (("tasks", "rut_depth", "data", "sha256"), "f" * 64),
    (("tasks", "rut_depth", "data", "file"), "data/other.csv"),
    (("tasks", "bulk_density", "priors", "sha256"), "e" * 64),
    (("tasks", "bulk_density", "priors", "source"), "mine.toml"),
    (("tasks", "rut_depth", "model"), "bekker"),
    *((("genetic_algorithm", name), 7777) for name in ("F", "CP", "MP", "NP", "max_iterations")),
    *(((("versions"), name), "99.9") for name in ("terracalib", "python", "numpy", "scipy",
                                                  "emcee", "arviz", "matplotlib", "corner")),
]  # fmt: skip
SUMMARY_LEAVES: list[tuple[tuple[str, ...], Any]] = [
    (("models", "rut_depth", *path), value)
    for path, value in [
        (("data", "n"), 777),
        (("data", "label"), ""),
        (("data", "ranges", "slip_ratio", "upper"), 0.77),
        (("sampling", "ensembles"), 77),
        (("sampling", "walkers"), 77),
        (("sampling", "steps"), 7777),
        (("sampling", "converged"), False),
        (("sampling", "gate", "largest_rhat"), 1.0777),
        (("sampling", "gate", "smallest_ess_bulk"), 7777.0),
        (("sampling", "gate", "smallest_ess_tail"), 7777.0),
        (("sampling", "gate", "smallest_steps_over_tau"), 777.0),
        (("validation", "n"), 77),
        (("validation", "rmse"), 7.77),
        (("validation", "max_relative_error"), 0.77),
        (("validation", "coverage", "90"), 0.0),
    ]
] + [
    (("models", "bulk_density", "validation", "elpd"), 7.7),
    (("models", "bulk_density", "validation", "elpd_se"), 7.7),
    (("models", "bulk_density", "validation", "refitted"), [1, 2, 3]),
    (("models", "drawbar_pull", "data", "n_all"), 777),
    (("models", "drawbar_pull", "estimates"), {}),
]


@pytest.mark.parametrize(("path", "value"), MANIFEST_LEAVES)
def test_the_methods_follow_the_manifest(he2019, text, path, value):
    manifest, summary = he2019
    assert text_of(changed(manifest, path, value), summary) != text


@pytest.mark.parametrize(("path", "value"), SUMMARY_LEAVES)
def test_the_methods_follow_the_summary(he2019, text, path, value):
    manifest, summary = he2019
    assert text_of(manifest, changed(summary, path, value)) != text


def test_no_number_is_remembered(he2019, text):
    """Change every number there is: what stays are the equations' numbers, and years of papers."""
    counter = itertools.count(7001)

    def other(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: other(v) for k, v in value.items()}
        if isinstance(value, list):
            # One more: a list is counted.
            return [*(other(v) for v in value), next(counter)]
        if isinstance(value, bool) or value is None:
            return value
        if isinstance(value, int | float):
            return type(value)(next(counter) * (1.0 if isinstance(value, int) else 1.0137))
        return value

    manifest, summary = (other(d) for d in he2019)
    manifest["command"] = ["calib"]
    manifest["versions"] = {k: f"{next(counter)}.71" for k in manifest["versions"]}
    for task in manifest["tasks"].values():
        for part in ("data", "priors"):
            task[part]["sha256"] = f"{next(counter):x}".rjust(64, "c")
    now = text_of(manifest, summary)
    allowed = {e["year"] for e in entries().values()}
    allowed |= {"1", "2", "3", "12", "15", "18", "20", "21", "6", "9", "22"}  # Eqs, in C2 + x^2
    allowed |= {"50", "90", "95", "256"}  # levels of the bands, and of the hash
    stayed = set(NUMBER.findall(text)) & set(NUMBER.findall(now))
    assert stayed <= allowed, stayed - allowed
    # And they did change: the test would pass on an empty text.
    assert len(set(NUMBER.findall(text)) - stayed) > 50


def test_what_a_methods_section_must_say(text):
    for words in (
        "The data are reconstructed", "not measurements", f"with calib {version('terracalib')}",
        "Eqs 12\N{EN DASH}15 of the source", "normal about the model", "logarithm of rut depth",
        "ayers_perumpral.toml (SHA-256 ", "emcee 3", "Student-t", "seed 42",
        "calib report --out 'a folder'", "The 14 rows at inflation pressure 30 psi were held out",
        "inflation pressure 18 and 42 psi", "multi-start least squares", "NumPy", "passed the gate",
        "from all 42 rows",
    ):  # fmt: skip
        assert words in text, words


def test_figures_in_words_are_the_summarys(he2019, text):
    _, summary = he2019
    for model in summary["models"].values():
        v, gate = model["validation"], model["sampling"]["gate"]
        hits = [str(round(share * v["n"])) for share in v["coverage"].values()]
        assert f"cover {hits[0]}, {hits[1]} and {hits[2]} of {v['n']}" in text
        assert f"R-hat at most {gate['largest_rhat']:.4f}" in text


def test_not_converged_cannot_be_quoted_by_mistake(users):
    text = text_of(*users)
    assert "DID NOT PASS the gate" in text
    assert "must not be used: R-hat of n0 is 1.3" in text
    assert text.count("DID NOT PASS") == 1


def test_measured_data_are_not_called_reconstructed(users):
    manifest, summary = users
    only = {"models": {"rut_depth": summary["models"]["rut_depth"]}}
    text = text_of(manifest, only)
    assert "econstructed" not in text
    assert "rows of data (data/rut_depth.csv" in text


def test_text_and_latex_files(published):
    text = published.files["methods.txt"]
    assert all(len(line) <= 96 for line in text.splitlines())
    assert "\u00a0" not in text
    assert "References" in text
    check(published.files["methods.tex"])
    assert r"\paragraph{Drawbar pull.}" in published.files["methods.tex"]


def test_another_noise_is_described_and_what_the_data_prefer(he2019):
    manifest, summary = he2019
    told = copy.deepcopy(summary)
    told["models"]["rut_depth"]["noise"] = {
        "family": "student_t",
        "depends_on": {"column": "slip_ratio", "centre": 0.25, "spread": 0.125},
        "against_normal": {"sentence": "The data prefer Student-t noise that depends on slip."},
    }
    text = text_of(manifest, told)
    nu, sigma = "\N{GREEK SMALL LETTER NU}", "\N{GREEK SMALL LETTER SIGMA}"
    assert f"Student-t about the model with unknown degrees of freedom {nu} and an unknown" in text
    assert f"scale whose logarithm is linear in slip: that of {sigma} at 25 %" in text
    assert "_slope more for each 12.5 %." in text
    assert "The data prefer Student-t noise that depends on slip." in text
    del told["models"]["rut_depth"]["noise"]["depends_on"]
    assert "and one unknown scale" in text_of(manifest, told)
