"""Tables, methods and references: the numbers of manifest and summary, and none remembered."""

from __future__ import annotations

import copy
import csv
import io
import itertools
import re
import shutil
import subprocess
from importlib import resources
from importlib.metadata import metadata, version
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.data import read_table
from calib.he2019.published import DOI, PUBLISHED
from calib.models import MODELS, example_csv
from calib.report.document import outputs
from calib.report.markup import (
    bibliography,
    bibtex,
    cited,
    entries,
    escape,
    latex_unit,
    prose,
    short_citation,
    symbol_html,
    to_html,
    to_latex,
    to_text,
    unit_html,
    with_symbols,
)
from calib.report.numbers import TIMES, interval_text, last_place
from calib.report.page.template import equation as page_equation
from calib.report.page.template import parametrisation
from calib.report.publish import publication
from calib.report.publish.tables import TOPICS
from tests.pages import Reader
from tests.report.latex import check, columns, rows

# Sentences with marks


@pytest.mark.parametrize(
    ("text", "latex"),
    [
        ("50 % of a_b & {c} #1 $5", r"50 \% of a\_b \& \{c\} \#1 \$5"),
        (r"a\b~c^d", r"a\textbackslash{}b\textasciitilde{}c\textasciicircum{}d"),
        (f"(3.3 ± 1.2){TIMES}10⁵", r"(3.3 $\pm$ 1.2)$\times$10$^{5}$"),
        ("g/cm³ \N{EN DASH} \N{GREEK SMALL LETTER SIGMA} Ω", "g/cm$^{3}$ -- $\\sigma$ $\\Omega$"),
        ("Cappé, Şahin, 雪", "Cappé, Sahin, ?"),
    ],
)
def test_escape(text, latex):
    assert escape(text) == latex


@given(st.text())
def test_any_text_is_well_formed(text):
    check(escape(text))


def test_marks_are_written_for_each_reader():
    sentence = "By [@He_2019; @Vehtari_2021], [$K_lo] in [u:kN/%] from `data/a_b.csv`: 5 %."
    assert cited([sentence, "[@He_2019]"]) == ["He_2019", "Vehtari_2021"]
    assert to_text(sentence) == (
        "By (He et al. 2019; Vehtari et al. 2021), K_lo in kN/% from data/a_b.csv: 5\u00a0%."
    )
    assert to_latex(sentence) == (
        r"By~\cite{He_2019,Vehtari_2021}, $K_\mathrm{lo}$ in kN/\% from "
        r"\texttt{data/\allowbreak{}a\_b.csv}: 5~\%."
    )
    assert to_html("[$K_lo] < [!5 kN] [u:g/cm^3]") == (
        "<i>K</i><sub>lo</sub> &lt; <strong>5\u00a0kN</strong> g/cm<sup>3</sup>"
    )
    assert str(symbol_html("<b>")) == "<i>&lt;b&gt;</i>"
    assert str(unit_html("kPa (g/cm^3)^-C4")) == "kPa (g/cm<sup>3</sup>)<sup>&minus;C4</sup>"
    assert latex_unit("kPa (g/cm^3)^-C4") == "kPa (g/cm$^{3}$)$^{-C4}$"
    assert (unit_html("1"), latex_unit("1")) == ("&ndash;", "--")


def test_parameters_in_a_text_become_symbols():
    """A lone letter may be a word of the sentence; Greek letters are not."""
    assert with_symbols("As K_lo and C2, not C23; C in g/cm^3", ["K_lo", "C2", "C"]) == (
        "As [$K_lo] and [$C2], not C23; C in g/cm³"
    )
    sigma = "\N{GREEK SMALL LETTER SIGMA}"
    assert prose(f"{sigma} is C", ["sigma", "C"]) == f"<i>{sigma}</i> is C"


@pytest.mark.parametrize("name", MODELS)
def test_every_model_has_its_equation_and_parametrisation(name, tmp_path):
    example = tmp_path / "example.csv"
    example.write_text(example_csv(name))
    bound = MODELS[name].bind(read_table(example))
    said = parametrisation(bound.model.parametrisation, bound.references)
    assert "{" not in said
    assert ("must stay positive" in said) == (name == "magic_formula_pressure")
    equation = to_latex(f"[={name}]")
    check(equation)
    check(to_latex(MODELS[name].letters))
    # Of other sources than the paper the numbers are not known.
    numbers = MODELS[name].numbers
    assert numbers.startswith("Eq") if MODELS[name].cited == "He_2019" else not numbers
    assert Reader(str(page_equation(MODELS[name].latex, numbers))).open == []
    # The parameters that the source prints are all in it.
    for parameter in MODELS[name].reported:
        digits = parameter.strip("ABCDEKSbcknvh")
        assert parameter[0] in equation
        assert not digits or digits in equation


# References


def test_every_entry_was_read():
    source = (resources.files("calib.report") / "references.bib").read_text("utf-8")
    assert len(re.findall(r"^@", source, re.MULTILINE)) == len(entries())
    for key, entry in entries().items():
        assert set(entry) >= {"author", "title", "journal", "year", "volume", "pages"}, key
        assert "doi" in entry or "url" in entry
        assert key.rpartition("_")[2] == entry["year"]
    assert entries()["He_2019"]["doi"] == DOI
    lines = bibliography(entries(), "1")
    assert not any(c in line for line in lines for c in "{}\\$")
    assert any("Virtanen, Pauli; Gommers, Ralf; Oliphant, Travis E.; et al." in s for s in lines)
    found = map(short_citation, ("Cappe_2008", "terBraak_2006"))
    assert list(found) == ["Cappé et al. 2008", "ter Braak 2006"]


def test_packages_are_cited_as_they_want_to_be():
    wanted = metadata("emcee").get_payload() or metadata("emcee")["Description"]
    emcee = entries()["ForemanMackey_2013"]
    assert emcee["doi"] in wanted
    assert emcee["pages"].replace("--", "-") in wanted
    shipped = (resources.files("arviz_base") / "references.bib").read_text(encoding="utf-8")
    for key in ("Martin_2026", "Vehtari_2021", "Vehtari_2017", "Vehtari_2024"):
        theirs = re.search(rf"@article\{{{key},.*?\n\}}", shipped, re.DOTALL)
        assert theirs is not None
        found = dict(re.findall(r"(\w+)\s*=\s*\{(.*)\},?", theirs[0]))
        for field in {"year", "volume", "number", "pages", "doi", "url"} & set(found):
            assert entries()[key].get(field, found[field]) == found[field], field


def test_only_what_is_cited_is_listed_and_all_of_it(published):
    bib = published.files["references.bib"]
    tex = "".join(t for p, t in published.files.items() if p.endswith(".tex"))
    used = {k for group in re.findall(r"\\cite\{(.*?)\}", tex) for k in group.split(",")}
    assert set(re.findall(r"@\w+\{(\w+),", bib)) == used
    assert {"He_2019", "ForemanMackey_2013", "Vehtari_2021", "Martin_2026", "calib"} <= used
    assert f"Version {version('terracalib')}" in bib
    for line in published.references:
        assert re.search(r"doi:10\.|https://jmlr|Version", line)
    assert "Version 7.7" in bibtex(["calib"], "7.7")


# Methods


def text_of(manifest: dict[str, Any], summary: dict[str, Any]) -> str:
    """The methods without references."""
    found = publication(manifest, summary)
    return " ".join(f"{heading}. {body}" for heading, body in found.methods).replace("\u00a0", " ")


@pytest.fixture(scope="module")
def text(he2019) -> str:
    return text_of(*he2019)


# What is no number: those are changed all at once below.
LEAVES: dict[str, Any] = {
    "command": ["calib"],
    "tasks rut_depth data sha256": "f" * 64,
    "tasks rut_depth data file": "data/other.csv",
    "tasks bulk_density priors sha256": "e" * 64,
    "tasks bulk_density priors source": "mine.toml",
    "tasks rut_depth model": "bekker",
    "models rut_depth data label": "",
    "models rut_depth sampling converged": False,
    "models rut_depth validation coverage 90": 0.0,
    "models bulk_density validation refitted": [1, 2, 3],
    "models drawbar_pull estimates": {},
}


@pytest.mark.parametrize("path", LEAVES)
def test_the_methods_follow_their_records(he2019, text, path):
    documents = copy.deepcopy(he2019)
    *keys, last = path.split()
    place = documents["models" in keys]
    for key in keys:
        place = place[key]
    assert last in place
    place[last] = LEAVES[path]
    assert text_of(*documents) != text


def test_no_number_is_remembered(he2019, text):
    """Change every number there is: what stays are the equations' numbers, and years of papers."""
    counter = itertools.count(7001)

    def other(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: other(v) for k, v in value.items()}
        if isinstance(value, list):
            # One more: a list is counted.
            return [*(other(v) for v in value), next(counter)]
        if isinstance(value, bool) or not isinstance(value, int | float):
            return value
        return type(value)(next(counter) * (1.0 if isinstance(value, int) else 1.0137))

    manifest, summary = (other(d) for d in he2019)
    manifest["command"] = ["calib"]
    manifest["versions"] = {k: f"{next(counter)}.71" for k in manifest["versions"]}
    for task in manifest["tasks"].values():
        for part in ("data", "priors"):
            task[part]["sha256"] = f"{next(counter):x}".rjust(64, "c")
    number = re.compile(r"(?<![\w.])\d+(?:\.\d+)*")
    before, after = (set(number.findall(t)) for t in (text, text_of(manifest, summary)))
    allowed = {e["year"] for e in entries().values()}
    allowed |= {"1", "2", "3", "12", "15", "18", "20", "21", "6", "9", "22"}  # Eqs, in C2 + x^2
    allowed |= {"50", "90", "95", "256"}  # levels of the bands, and of the hash
    assert before & after <= allowed
    # And they did change: the test would pass on an empty text.
    assert len(before - after) > 50


def test_what_a_methods_section_must_say(he2019, text):
    for words in (
        "The data are reconstructed",
        "Eqs 12\N{EN DASH}15 of the source",
        "logarithm of rut depth",
        "calib report --out 'a folder'",
        "The 14 rows at inflation pressure 30 psi were held out",
        "from all 42 rows",
    ):
        assert words in text, words
    for model in he2019[1]["models"].values():
        v, gate = model["validation"], model["sampling"]["gate"]
        hits = [str(round(share * v["n"])) for share in v["coverage"].values()]
        assert f"cover {hits[0]}, {hits[1]} and {hits[2]} of {v['n']}" in text
        assert f"R-hat at most {gate['largest_rhat']:.4f}" in text


def test_a_users_report_says_what_failed_and_nothing_published(users):
    manifest, summary = users
    found = publication(manifest, summary)
    text = text_of(manifest, summary)
    assert "must not be used: R-hat of n0 is 1.3" in text
    assert text.count("DID NOT MEET the convergence criteria") == 1
    assert not any("bulk_density" in path for path in found.files)
    assert "NOT CONVERGED" in found.files["tables/posterior_drawbar_pull.tex"]
    assert "NOT CONVERGED" not in found.files["tables/posterior_rut_depth.tex"]
    own = publication(manifest, {"models": {"rut_depth": summary["models"]["rut_depth"]}})
    text = "".join(own.files.values())
    assert "Table 6" not in text
    assert "econstructed" not in text
    assert "rows of data (`data/rut_depth.csv" in text.replace("\\texttt{", "`").replace(
        "\\allowbreak{}", ""
    ).replace("\\_", "_")


def test_noise_other_than_normal_is_described(he2019):
    manifest, told = copy.deepcopy(he2019)
    told["models"]["rut_depth"]["noise"] = {
        "family": "student_t", "correlated_along": None,
        "depends_on": {"column": "slip_ratio", "centre": 0.25, "spread": 0.125},
        "against_normal": {"sentence": "The data prefer Student-t noise that depends on slip."},
    }  # fmt: skip
    text = text_of(manifest, told)
    sigma, nu = "\N{GREEK SMALL LETTER SIGMA}", "\N{GREEK SMALL LETTER NU}"
    assert f"Student-t about the model with unknown degrees of freedom {nu} and an unknown" in text
    assert f"scale whose logarithm is linear in slip: that of {sigma} at 25 %" in text
    assert "The data prefer Student-t noise that depends on slip." in text


def test_text_and_latex_files(published):
    text = published.files["methods.txt"]
    assert all(len(line) <= 96 for line in text.splitlines())
    assert "\u00a0" not in text
    check(published.files["methods.tex"])
    assert r"\paragraph{Drawbar pull.}" in published.files["methods.tex"]


# Tables


def read(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


@pytest.fixture(scope="module")
def tables(published) -> dict[str, list[dict[str, str]]]:
    found = {path: read(text) for path, text in published.files.items() if path.endswith(".csv")}
    return {path[len("tables/") : -len(".csv")]: rows for path, rows in found.items()}


def latex(published) -> dict[str, str]:
    return {p: t for p, t in published.files.items() if p.startswith("tables/") and ".tex" in p}


def test_every_topic_has_both_forms(published, tables):
    topics = [topic.lower() for topic, *_ in published.tables]
    assert topics == list(TOPICS)
    assert sum(len(tex) for *_, tex in published.tables) == len(latex(published))
    for found in tables.values():
        assert found
        assert all(None not in row and None not in row.values() for row in found)


def test_posterior_is_the_summary_to_the_digits_that_it_warrants(he2019, tables):
    found = {(r["output"], r["parameter"]): r for r in tables["posterior"]}
    models = he2019[1]["models"]
    assert len(found) == sum(len(m["posterior"]) for m in models.values())
    for (key, name), row in found.items():
        s = models[key]["posterior"][name]
        unit = 10.0 ** last_place(s["sd"], s["mcse_mean"])
        for statistic in ("mean", "sd"):
            assert abs(float(row[statistic]) - s[statistic]) <= 0.5001 * unit
        for end in ("lower", "upper"):
            shown, exact = float(row[f"hdi95_{end}"]), s[f"hdi_{end}"]
            # To the Monte Carlo error's own size or to two digits of the sd, not to more.
            assert abs(shown - exact) <= max(0.51 * s["sd"], 10.0 * s[f"mcse_hdi_{end}"])


def test_estimates_beside_the_published_figures(he2019, published, tables):
    together = [r for r in tables["estimates"] if r["rows"] == "together"]
    rut = {(r["quantity"], r["method"]): r for r in together if r["output"] == "rut_depth"}
    found = he2019[1]["models"]["rut_depth"]["estimates"]["least_squares"]
    for name, figure in PUBLISHED.rut_depth.estimates.items():
        row, other = rut[name, "published_regression"], rut[name, "least_squares"]
        assert (row["published"], row["same_printed_digits"]) == (figure.text, "yes")
        assert float(row["value"]) == figure.value
        assert float(other["value"]) == pytest.approx(found[name], rel=1e-3)
        assert other["same_printed_digits"] == "no"
    # The printed goodness of fit is of another response.
    assert rut["rmse", "least_squares"]["published"] == ""
    alone = [r for r in tables["estimates"] if r["rows"].endswith(" psi")]
    assert {r["rows"] for r in alone} == {"18 psi", "30 psi", "42 psi"}
    best = [r for r in alone if r["method"] == "least_squares"]
    assert {(r["same_printed_digits"], r["published_in"]) for r in best} == {("yes", "Table 4")}
    # For people, what equals the source is ticked.
    shown = rows(published.files["tables/estimates_rut_depth.tex"])
    regression = [row[shown[0].index("Regr.")] for row in shown[1:4]]
    assert all(cell.endswith(r"\rlap{$^{\ast}$}") for cell in regression)


def test_scores_convergence_and_priors_are_the_summary(he2019, tables):
    manifest, summary = he2019
    for row in tables["validation"]:
        v = summary["models"][row["output"]]["validation"]
        assert int(row["n"]) == v["n"]
        assert row["unit"]
        assert float(row["rmse"]) == pytest.approx(v["rmse"], rel=6e-3)
        for level, share in v["coverage"].items():
            assert int(row[f"covered_{level}"]) == share * v["n"]
    by_output = {r["output"]: r for r in tables["validation"]}
    assert by_output["drawbar_pull"]["held_out"] == "inflation pressure 30 psi"
    assert by_output["bulk_density"]["method"] == "leave_one_out"
    assert by_output["bulk_density"]["elpd"]
    for row in tables["convergence"]:
        s = summary["models"][row["output"]]["sampling"]
        assert (row["passed"], int(row["steps"])) == ("yes", s["steps"])
        assert float(row["largest_rhat"]) == pytest.approx(s["gate"]["largest_rhat"], abs=6e-5)
    for row in tables["priors"]:
        prior = summary["models"][row["output"]]["priors"][row["parameter"]]
        assert (row["reason"], row["source"]) == (prior["reason"], prior["source"])
        assert row["file_sha256"] == manifest["tasks"][row["output"]]["priors"]["sha256"]


def test_latex_is_well_formed_booktabs(published, users):
    for path, text in (latex(published) | latex(publication(*users))).items():
        check(text)
        assert {r"\toprule", r"\midrule", r"\bottomrule"} <= set(re.findall(r"\\\w+", text)), path
        assert {len(row) for row in rows(text)} == {columns(text)}, path
    labels = re.findall(r"\\label\{(.*?)\}", "".join(latex(published).values()))
    assert len(labels) == len(set(labels)) == len(latex(published))
    head = rows(published.files["tables/estimates_by_pressure_drawbar_pull.tex"])[0]
    assert head[2:] == [r"$B$ (1/\%)", "$C$", "$D$ (kN)", "$E$", "Sum of squares (kN$^{2}$)"]
    shown = rows(published.files["tables/posterior_rut_depth.tex"])
    assert {row[0] for row in shown} >= {r"$z_\mathrm{ref}$ (mm)", r"$k$ (kPa/m$^{n}$)"}


def test_what_does_not_exist_is_left_out(he2019):
    manifest, summary = he2019
    failed = {"models": {key: {"model": "bekker", "error": "no"} for key in summary["models"]}}
    assert publication(manifest, failed).files == {}
    model = summary["models"]["drawbar_pull"]
    validation = model["validation"] | {"rmse": None, "crps": None, "max_relative_error": None}
    found = publication(manifest, {"models": {"drawbar_pull": model | {"validation": validation}}})
    assert read(found.files["tables/validation.csv"])[0]["rmse"] == ""
    assert "could not be scored" in found.files["methods.txt"]


def test_a_summary_is_read_back_as_it_was(he2019, rut):
    o = next(o for o in outputs(*he2019) if o.key == "rut_depth")
    for read_back, s in zip(o.posterior, rut.calibration.summary.values(), strict=True):
        assert (interval_text(read_back), read_back.mean) == (interval_text(s), s.mean)


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex on this machine")
def test_it_compiles(published, tmp_path):
    for path, text in published.files.items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(text, encoding="utf-8")
    inputs = [r"\input{methods}"]
    inputs += [rf"\input{{{path.removesuffix('.tex')}}}\clearpage" for path in latex(published)]
    (tmp_path / "paper.tex").write_text(
        "\n".join([
            r"\documentclass{article}", r"\usepackage[margin=10mm]{geometry}",
            r"\usepackage{booktabs}", r"\begin{document}", *inputs,
            r"\bibliographystyle{plain}", r"\bibliography{references}", r"\end{document}",
        ])
    )  # fmt: skip
    tex = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper"]
    for command in (tex, ["bibtex", "paper"], tex, tex):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-2000:]
    log = (tmp_path / "paper.log").read_text(errors="replace")
    assert "undefined" not in log
    # Tables fit a page of two columns, 190 mm wide.
    wide = [float(w) for w in re.findall(r"Overfull \\hbox \(([\d.]+)pt too wide\)", log)]
    assert max(wide, default=0.0) < 3.0
