"""Whatever a file holds, it is read or refused with a `CalibError`: thousands of mutilated files.

`make test` tries 15 of each kind, `make test-slow` 30,000 together, and says how many.
Command lines as well: each ends in an exit code and words, never in a traceback.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Sequence
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from calib.batch.campaign import read_plan
from calib.cli.app import app
from calib.data import read_table
from calib.data.quantities import QUANTITIES
from calib.errors import CalibError
from calib.gap.campaigns import campaigns
from calib.gap.case import read_case
from calib.inference.prior_files import default_priors, parse_priors, read_priors
from calib.inference.problem import build_problem
from calib.models import MODELS, example_csv
from calib.models.simulators.declaration import models_of
from calib.models.simulators.files import read_simulator
from tests.models.simulators.examples import PROGRAM, write_program

FEW, MANY = 15, 5_000

# What turns up in files, by accident or by malice.
TOKENS = (
    "", " ", ",", ";", "\t", '"', "'", "\\", "\n", "\r\n", "\x00", "\ufeff", "é", "\U0001d51b", "%",
    "#", "nan", "NaN", "inf", "-inf", "1e300", "-1e300", "1e-300", "1e999", "0", "-0.0", "-1",
    "1,5", "1.5e", "0x10", "1_000", "١٢", "-999", "true", "null", "[]", "{}", "[[fit]]",
    "[parameters]", "= 1", 'model = "bekker"', "/etc/passwd", "../lab.csv", "C:\\x", "=cmd()",
    "A" * 3000, "slip_ratio", "slip_percent", "drawbar_pull_kn", "drawbar_pull_n", "rut_depth_mm",
    'dist = "uniform"', 'dist = "fixed"', "sd = 1e300", "sd_log = 1e300", "lower = 5", "upper = -5",
)  # fmt: skip


@st.composite
def mutilated(draw: st.DrawFn, texts: Sequence[str]) -> str:
    """Return a text with up to six edits: tokens put in, pieces taken out, doubled or swapped."""
    text = draw(st.sampled_from(texts))
    for _ in range(draw(st.sampled_from((0, 1, 1, 2, 3, 6)))):
        i, j = sorted(draw(st.lists(st.integers(0, len(text)), min_size=2, max_size=2)))
        token = draw(st.sampled_from(TOKENS) | st.text(max_size=8))
        j = min(j, i + draw(st.sampled_from((0, 1, 4, 40, 4000))))
        text = draw(
            st.sampled_from(
                (text[:i] + token + text[i:], text[:i] + text[j:], text[:j] + text[i:],
                 text[:i] + token + text[j:])
            )
        )  # fmt: skip
        text = text[:20_000]
    return text


def everything(count: int) -> Callable[[Callable[..., None]], Callable[..., None]]:
    return settings(
        max_examples=count, deadline=None, database=None, suppress_health_check=list(HealthCheck)
    )


def read_or_refused(work: Callable[[], object]) -> str:
    """Return what came of it; anything but a result or a `CalibError` fails the test."""
    # Floating-point warnings on absurd numbers are no defect; what comes of them is looked at.
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            work()
        except CalibError:
            return "refused"
    return "read"


PULL = example_csv("magic_formula_pressure")
# Other rows of the same kind.
FIELD = "\n".join(line.replace("5", "6") for line in PULL.splitlines()) + "\n"
CSVS = tuple(example_csv(name) for name in sorted(MODELS))
# With what every prior file may ask for of the noise.
NOISE = """
[likelihood]
family = "student_t"
noise_depends_on = "slip"

[parameters.nu]
dist = "gamma"
shape = 2.0
rate = 0.1
lower = 1.0
unit = "1"
reason = "r"
source = "s"
"""
PRIORS = {name: default_priors(name).read_text(encoding="utf-8") for name in sorted(MODELS)}
WITH_NOISE = tuple(
    text + NOISE for name, text in PRIORS.items() if "slip_ratio" in MODELS[name].conditions
)
PLAN = """seed = 3
[[fit]]
name = "ruts"
data = ["*.csv"]
models = ["bekker"]
[[diagnose]]
name = "sites"
cases = ["site"]
[[sbc]]
name = "ranks"
simulations = 3
draw_seed = 2019
"""
CASE = """calibration = "lab.csv"
field = "field.csv"
predict = "fresh.csv"
[models]
drawbar_pull = "magic_formula_pressure"
"""


def scratch() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="calib-fuzz-")


def try_csv(text: str) -> str:
    with scratch() as folder:
        path = Path(folder) / "my.csv"
        path.write_bytes(text.encode("utf-8", "surrogatepass"))

        def work() -> None:
            table = read_table(path)
            for name, values in table.columns.items():
                assert np.isfinite(values).all(), name
            known = {q.canonical: q for q in QUANTITIES.values()}
            for model in MODELS.values():
                if model.output in table and all(c in table for c in model.conditions):
                    problem = build_problem(model.name, table)
                    assert np.isfinite(problem.response).all()
            assert set(table.columns) <= set(known)

        return read_or_refused(work)


def try_priors(text: str) -> str:
    with scratch() as folder:
        path = Path(folder) / "mine.toml"
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        name = next((n for n, shipped in PRIORS.items() if text[:200] == shipped[:200]), "bekker")
        table_file = Path(folder) / "my.csv"
        table_file.write_text(example_csv(name), encoding="utf-8")
        names = (*MODELS[name].parameters, "sigma")
        rng = np.random.default_rng(1)

        def work() -> None:
            priors = read_priors(path, name, names, {})
            drawn = priors.sample(rng, 20)
            assert np.isfinite(drawn).all()
            assert not np.isnan(priors.log_prob(drawn)).any()
            problem = build_problem(name, read_table(table_file), path)
            assert not np.isnan(problem.log_prob(problem.priors.sample(rng, 20))).any()

        return read_or_refused(work)


def try_plan(text: str) -> str:
    with scratch() as folder:
        path = Path(folder) / "plan.toml"
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        (Path(folder) / "my.csv").write_text(example_csv("bekker"), encoding="utf-8")
        (Path(folder) / "site").mkdir()
        (Path(folder) / "site" / "case.toml").write_text(CASE, encoding="utf-8")
        for name in ("lab.csv", "field.csv", "fresh.csv"):
            (Path(folder) / "site" / name).write_text(PULL, encoding="utf-8")
        return read_or_refused(lambda: read_plan(path))


def try_case(toml: str, lab: str, field: str) -> str:
    with scratch() as root:
        folder = Path(root) / "case"
        folder.mkdir()
        for name, text in (("case.toml", toml), ("lab.csv", lab), ("field.csv", field),
                           ("fresh.csv", field)):  # fmt: skip
            (folder / name).write_bytes(text.encode("utf-8", "surrogatepass"))
        return read_or_refused(lambda: campaigns(read_case(folder)))


with scratch() as _folder:
    SIMULATOR = write_program(Path(_folder)).read_text(encoding="utf-8")
SIMULATOR += """
[emulator]
runs = 30
[ranges]
s = [0.0, 90.0]
"""


def try_simulator(text: str) -> str:
    with scratch() as folder:
        path = Path(folder) / "wheel.toml"
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        (Path(folder) / "wheel.py").write_text(PROGRAM.format(extra=""), encoding="utf-8")

        def work() -> None:
            for model in models_of(read_simulator(path).simulator):
                parse_priors(model.priors, "wheel", "wheel", (*model.parameters, "sigma"), {})

        return read_or_refused(work)


# On files that are not there, so that nothing is worked out. Not `report` and `sbc`: without files
# they have data of their own.
WORDS = (
    "fit none.csv --model bekker --out out --seed 3 --max-steps 400 --workers 1",
    "predict none --at new.csv --out bands.csv --level 0.9",
    "diagnose none --out out --effects mine.py --seed 1 --json",
    "diagnose --run none --field field.csv --simulator wheel.toml --out out",
    "check none --quick --workers 2",
    "compare bekker reece none.csv --out out",
    "campaign none.toml --out out --workers 2",
    "template none --out t.csv", "models bekker", "effects slip_zero_shift --json",
    "quantities slip", "priors none --from-tir t.tir",
    "export none --at inflation_pressure_psi=30 --out t.tir --draws 3 --each",
)  # fmt: skip


def try_words(text: str) -> str:
    words = [word.replace("\x00", "") for word in text.split(" ")]
    with scratch() as folder, chdir(folder):
        done = CliRunner().invoke(app, words)
        assert isinstance(done.exception, SystemExit | None), (words, done.exception)
        assert done.exit_code in (0, 1, 2, 3), (words, done.output)
        assert "Traceback" not in done.output
        assert done.exit_code == 0 or done.output.strip(), words
    return "refused" if done.exit_code else "read"


KINDS: dict[str, tuple[Callable[..., str], tuple[Sequence[str], ...]]] = {
    "csv": (try_csv, (CSVS,)),
    "priors": (try_priors, ((*PRIORS.values(), *WITH_NOISE),)),
    "plan": (try_plan, ((PLAN,),)),
    "case": (try_case, ((CASE,), (PULL,), (FIELD,))),
    "simulator": (try_simulator, ((SIMULATOR,),)),
    "words": (try_words, (WORDS,)),
}


def run(kind: str, count: int) -> dict[str, int]:
    """Try the whole files of a kind and so many mutilated; return how many were read or refused."""
    work, texts = KINDS[kind]
    seen = {"read": 0, "refused": 0}

    @everything(count)
    @given(st.tuples(*(mutilated(t) for t in texts)))
    def each(files: tuple[str, ...]) -> None:
        seen[work(*files)] += 1

    for text in texts[0]:
        each = example((text, *(others[0] for others in texts[1:])))(each)
    each()
    return seen


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_a_mutilated_file_is_read_or_refused(kind: str, count: int) -> None:
    seen = run(kind, count)
    print(f"{kind}: {seen}")
    assert sum(seen.values()) >= count
    assert min(seen.values()) > 0, seen
