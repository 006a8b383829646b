"""Tables: the numbers of the summary, in the digits of the page, as CSV and as LaTeX."""

from __future__ import annotations

import csv
import io
import re
import shutil
import subprocess

import pytest

from calib.he2019.published import PUBLISHED
from calib.inference.calibration import ParameterSummary
from calib.report.numbers import interval_text, last_place
from calib.report.page.tables import posterior_rows
from calib.report.publish import publication
from calib.report.publish.records import outputs
from tests.report.publish.reader import check, columns, rows

SUPER = str.maketrans("\N{SUPERSCRIPT MINUS}⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


def read(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


@pytest.fixture(scope="module")
def tables(published) -> dict[str, list[dict[str, str]]]:
    return {
        path.removeprefix("tables/").removesuffix(".csv"): read(text)
        for path, text in published.files.items()
        if path.endswith(".csv")
    }


def latex(published) -> dict[str, str]:
    return {p: t for p, t in published.files.items() if p.startswith("tables/") and ".tex" in p}


def test_every_topic_has_both_forms(published):
    topics = {topic: (path, tex) for topic, path, tex in published.tables()}
    assert set(topics) == {"Posterior", "Estimates", "Validation", "Convergence", "Priors"}
    for path, tex in topics.values():
        assert path in published.files
        assert tex
    assert sum(len(tex) for _, tex in topics.values()) == len(latex(published))


def test_csv_is_rectangular_ascii_numbers(published, tables):
    for rows_ in tables.values():
        assert rows_
        for row in rows_:
            assert None not in row
            assert None not in row.values()
    for row in tables["posterior"]:
        for name in ("mean", "sd", "median", "hdi95_lower", "hdi95_upper", "mcse_mean"):
            assert row[name].isascii()
            float(row[name])


def test_posterior_is_the_summary_to_the_digits_that_it_warrants(he2019, tables):
    _, summary = he2019
    found = {(r["output"], r["parameter"]): r for r in tables["posterior"]}
    assert len(found) == sum(len(m["posterior"]) for m in summary["models"].values())
    for key, model in summary["models"].items():
        for name, s in model["posterior"].items():
            row = found[key, name]
            assert row["unit"] == s["unit"]
            unit = 10.0 ** last_place(s["sd"], s["mcse_mean"])
            for statistic in ("mean", "sd"):
                assert abs(float(row[statistic]) - s[statistic]) <= 0.5001 * unit
            for end in ("lower", "upper"):
                shown, exact = float(row[f"hdi95_{end}"]), s[f"hdi_{end}"]
                # To the Monte Carlo error's own size or to two digits of the sd, not to more.
                assert abs(shown - exact) <= max(0.51 * s["sd"], 10.0 * s[f"mcse_hdi_{end}"])


def test_page_and_latex_show_the_same_digits(published, drawbar):
    by_symbol = {str(r["symbol"]): r for r in posterior_rows(drawbar)}
    shown = rows(published.files["tables/posterior_drawbar_pull.tex"])[1:]
    assert len(shown) == len(by_symbol)
    for row, page in zip(shown, by_symbol.values(), strict=True):
        for cell, text in ((row[1], page["value"]), (row[2], page["hdi"])):
            assert _digits(cell) == _digits(text)


def _digits(text: str) -> str:
    """A cell without what sets it: signs, digits and points."""
    text = text.translate(SUPER).replace("\N{MINUS SIGN}", "-")
    text = text.replace("$^{", "").replace(r"\times", "x").replace("\N{MULTIPLICATION SIGN}", "x")
    return re.sub(r"[^\dx.()-]", "", text)


def test_estimates_beside_the_published_figures(he2019, tables):
    _, summary = he2019
    together = [r for r in tables["estimates"] if r["rows"] == "together"]
    rut = {(r["quantity"], r["method"]): r for r in together if r["output"] == "rut_depth"}
    for name, figure in PUBLISHED.rut_depth.estimates.items():
        row = rut[name, "published_regression"]
        assert row["published"] == figure.text
        assert row["same_printed_digits"] == "yes"
        assert float(row["value"]) == figure.value
        other = rut[name, "least_squares"]
        exact = summary["models"]["rut_depth"]["estimates"]["least_squares"][name]
        assert float(other["value"]) == pytest.approx(exact, rel=1e-3)
        assert other["same_printed_digits"] == "no"
    # The printed goodness of fit is of another response.
    assert rut["rmse", "least_squares"]["published"] == ""


def test_estimates_of_single_pressures(tables):
    alone = [r for r in tables["estimates"] if r["rows"].endswith(" psi")]
    assert {r["rows"] for r in alone} == {"18 psi", "30 psi", "42 psi"}
    best = [r for r in alone if r["method"] == "least_squares"]
    assert {r["same_printed_digits"] for r in best} == {"yes"}
    assert {r["published_in"] for r in best} == {"Table 4"}


def test_validation_and_convergence_are_the_summary(he2019, tables):
    _, summary = he2019
    for row in tables["validation"]:
        v = summary["models"][row["output"]]["validation"]
        assert int(row["n"]) == v["n"]
        assert float(row["rmse"]) == pytest.approx(v["rmse"], rel=6e-3)
        for level, share in v["coverage"].items():
            assert int(row[f"covered_{level}"]) == share * v["n"]
    by_output = {r["output"]: r for r in tables["validation"]}
    assert by_output["drawbar_pull"]["held_out"] == "inflation pressure 30 psi"
    assert by_output["bulk_density"]["method"] == "leave_one_out"
    assert by_output["bulk_density"]["elpd"]
    for row in tables["convergence"]:
        s = summary["models"][row["output"]]["sampling"]
        assert row["passed"] == "yes"
        assert int(row["steps"]) == s["steps"]
        assert float(row["largest_rhat"]) == pytest.approx(s["gate"]["largest_rhat"], abs=6e-5)


def test_priors_carry_reason_source_and_hash(he2019, tables):
    manifest, summary = he2019
    for row in tables["priors"]:
        prior = summary["models"][row["output"]]["priors"][row["parameter"]]
        assert (row["reason"], row["source"]) == (prior["reason"], prior["source"])
        assert row["file_sha256"] == manifest["tasks"][row["output"]]["priors"]["sha256"]


def test_latex_is_well_formed_booktabs(published):
    for path, text in latex(published).items():
        check(text)
        for rule in (r"\toprule", r"\midrule", r"\bottomrule"):
            assert rule in text, path
        assert r"\hline" not in text
        assert {len(row) for row in rows(text)} == {columns(text)}
    labels = re.findall(r"\\label\{(.*?)\}", "".join(latex(published).values()))
    assert len(labels) == len(set(labels)) == len(latex(published))


def test_headers_have_their_units(published):
    head = rows(published.files["tables/estimates_by_pressure_drawbar_pull.tex"])[0]
    assert head[2:] == [r"$B$ (1/\%)", "$C$", "$D$ (kN)", "$E$", "Sum of squares (kN$^{2}$)"]
    shown = rows(published.files["tables/posterior_rut_depth.tex"])
    assert {row[0] for row in shown} >= {r"$z_\mathrm{ref}$ (mm)", r"$k$ (kPa/m$^{n}$)"}
    assert all(r["unit"] for r in read(published.files["tables/validation.csv"]))


def test_a_users_tables_have_nothing_published_and_say_what_failed(users):
    manifest, summary = users
    own = publication(manifest, {"models": {"rut_depth": summary["models"]["rut_depth"]}})
    text = "".join(own.files.values())
    assert "Table 6" not in text
    assert "reconstructed" not in text
    found = publication(manifest, summary)
    assert not any("bulk_density" in path for path in found.files)
    assert "NOT CONVERGED" in found.files["tables/posterior_drawbar_pull.tex"]
    assert "NOT CONVERGED" not in found.files["tables/posterior_rut_depth.tex"]
    for path, content in latex(found).items():
        check(content)
        assert {len(row) for row in rows(content)} == {columns(content)}, path


def test_nothing_is_published_of_a_study_that_failed(he2019):
    manifest, summary = he2019
    failed = {"models": {key: {"model": "bekker", "error": "no"} for key in summary["models"]}}
    assert publication(manifest, failed).files == {}


def test_numbers_that_do_not_exist_are_left_out(he2019):
    manifest, summary = he2019
    model = summary["models"]["drawbar_pull"]
    validation = model["validation"] | {"rmse": None, "crps": None, "max_relative_error": None}
    told = {"models": {"drawbar_pull": model | {"validation": validation}}}
    found = publication(manifest, told)
    assert read(found.files["tables/validation.csv"])[0]["rmse"] == ""
    assert "could not be scored" in found.files["methods.txt"]


def test_times_are_left_out_so_that_files_repeat(he2019):
    manifest, summary = he2019
    other = {
        **summary, "seconds": 99.0,
        "models": {
            key: {**m, "sampling": m["sampling"] | {"seconds": 77.7}}
            for key, m in summary["models"].items()
        },
    }  # fmt: skip
    assert publication(manifest, other) == publication(manifest, summary)


def test_a_summary_is_read_back_as_it_was(he2019, rut):
    o = next(o for o in outputs(*he2019) if o.key == "rut_depth")
    for read_back, s in zip(o.posterior, rut.calibration.summary.values(), strict=True):
        assert isinstance(read_back, ParameterSummary)
        assert interval_text(read_back) == interval_text(s)
        assert read_back.mean == s.mean


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
    assert "Warning" not in (tmp_path / "paper.blg").read_text()
