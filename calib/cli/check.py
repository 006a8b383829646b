"""The commands `check`, `validate`, `audit` and `doctor`."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from json import loads
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli import options as opt
from calib.cli.options import announce, finish, progress_bars, wide_console
from calib.errors import CalibError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from calib.checking.check import Outcome
    from calib.checking.compare import Item
    from calib.he2019.audit import Audit
    from calib.he2019.tables import PublishedTable

_Quick = Annotated[
    bool, typer.Option("--quick", help="Skip the sampling: hashes, inputs and estimates only.")
]


def check(
    folder: Annotated[
        Path, typer.Argument(help="Folder of `calib report`, `fit`, `compare` or `diagnose`.")
    ],
    quick: _Quick = False,
    every: Annotated[
        bool, typer.Option("--all", help="List every number, not only those that differ.")
    ] = False,
    effects: opt.EffectsFile = None,
    workers: opt.Workers = opt.CORES,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Compute a folder's results again from that folder alone and compare everything.

    Ends with 0 where all is the same, 1 where something differs, 2 where it cannot be checked.
    """
    try:
        outcome = run_check(folder, quick, workers, effects)
    except CalibError as error:
        reason = {"verdict": "cannot be checked", "reason": str(error), "exit_code": 2}
        finish(0, {"folder": str(folder), **reason})
        raise
    show(outcome, every=every)
    finish(outcome.exit_code, outcome.document())


def run_check(folder: Path, quick: bool, workers: int, effects: Path | None = None) -> Outcome:
    """Check a folder with a bar for each kind of work."""
    from calib.batch.pool import pool
    from calib.checking.check import check as check_folder
    from calib.models.simulators.files import load_files

    # A slow simulator is checked as it was emulated: nothing is run.
    load_files(sorted((folder / "emulators").glob("*.npz")))
    with pool(1 if quick else workers) as side, progress_bars() as tell:
        return check_folder(
            folder, quick=quick, effects=effects, progress=tell, pool=side, workers=workers
        )


def show(outcome: Outcome, *, every: bool) -> None:
    """Print what a check found: every number and file, or only those that are not the same."""
    from calib.checking.compare import Status

    console = wide_console()
    console.print(outcome.verdict, soft_wrap=True)
    console.print(_groups(outcome))
    for title, status in (("Different", Status.DIFFERENT), ("Not judged", Status.UNJUDGED)):
        _print_items(console, title, outcome.of(status), 40)
    if every:
        _print_items(console, "The same", outcome.of(Status.WITHIN, Status.IDENTICAL), sys.maxsize)
    if outcome.draws_differ:
        console.print(f"Allowed: {outcome.allowed}.", soft_wrap=True)
    if outcome.environment:
        console.print("It was made elsewhere:")
        for name, (there, here) in outcome.environment.items():
            console.print(f"  {name}: there {there[:60]}; here {here[:60]}", soft_wrap=True)
    elif outcome.draws_differ:
        console.print(
            "The draws are others although versions, code and processor are recorded as they are "
            "here: something that is not recorded rounds differently, or the record is not true.",
            soft_wrap=True,
        )


def _groups(outcome: Outcome) -> Table:
    """One row for each group: how many of its entries are what."""
    from rich.table import Table

    from calib.checking.compare import Status
    from calib.data.files import plain_number

    table = Table()
    table.add_column("compared")
    for heading in (*Status, "largest difference\nof what is allowed"):
        table.add_column(str(heading), justify="right")
    for name, (counts, largest) in outcome.groups.items():
        part = f"{plain_number(100.0 * largest)} %" if largest else ""
        table.add_row(name, *(str(n) if n else "" for n in counts.values()), part)
    return table


def _print_items(console: Console, title: str, items: Iterable[Item], most: int) -> None:
    from rich.table import Table

    listed = list(items)
    if not listed:
        return
    table = Table(title=title, title_justify="left")
    for heading in ("what", "recorded", "computed again", "allowed", "remark"):
        left = heading in ("what", "remark")
        table.add_column(heading, justify="left" if left else "right", overflow="fold")
    for item in listed[:most]:
        values = map(_short, (item.recorded, item.found, item.allowed))
        table.add_row(item.name, *values, item.note)
    console.print(table)
    if len(listed) > most:
        console.print(f"... and {len(listed) - most} more; --all or --json lists them")


def _short(value: Any) -> str:
    if value is None:
        return ""
    text = f"{value:.10g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 24 else f"{text[:16]}..."


def validate(
    reference: Annotated[Path, typer.Argument(help="Run folder of `calib fit`, or a case folder.")],
    file: Annotated[
        Path | None, typer.Argument(help="CSV of your readings, of another campaign than the run.")
    ] = None,
    answer: Annotated[
        Path | None, typer.Option(help="The case's answer.json; needs a checkout.")
    ] = None,
    diagnosis: Annotated[
        Path | None, typer.Option(help="Folder with a diagnosis of the case; needs a checkout.")
    ] = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
    json: opt.Json = False,
) -> None:
    """Judge whether your readings are consistent with a reference campaign, or check a case.

    For a run, the exit code is 0 if they are, 1 if they are not, 2 if no row can be judged, and 3
    if the reference did not converge. For a case folder, every departure from the format is listed,
    those of the answer and the diagnosis included; the exit code is 0 if there is none, else 1.
    """
    if file is None:
        from calib.batch.environment import from_the_bench
        from calib.gap.validator import faults

        all_faults = faults(reference)
        if answer is not None or diagnosis is not None:
            with from_the_bench("calib validate --answer, --diagnosis"):
                from challenge.format import faults as of_others
            all_faults += of_others(reference, answer, diagnosis)
        wrong = [*map(str, all_faults)]
        print(*wrong, f"{reference}: {len(wrong) or 'no'} faults", sep="\n")
        finish(1 if wrong else 0, {"folder": str(reference), "faults": wrong})
        return
    if answer is not None or diagnosis is not None:
        raise CalibError(
            "--answer and --diagnosis apply to a case folder only",
            where=str(file),
            hint="leave FILE out",
        )
    from calib import consistency, load_calibration
    from calib.data import read_for_model
    from calib.report.verdict import kept_verdict

    calibration = load_calibration(reference)
    model = calibration.problem.bound.model
    table = read_for_model(file, (*model.conditions, model.output))
    found, judged = consistency(calibration, table), kept_verdict(reference)
    doubts = () if judged is None else judged.for_rows(table.columns)
    for doubt in doubts:
        announce(f"the reference: {doubt}")
    print(*found.lines, sep="\n")
    code = 3 if not found.converged else 1 if found.differs else 0
    finish(code, found.document(), doubts=list(doubts))


def audit(
    ctx: typer.Context,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for audit.json, audit.csv, figures and a page."),
    ] = None,
    number: Annotated[
        int | None,
        typer.Option("--table", help="Show this published table, recomputed.", min=1, max=6),
    ] = None,
    json: opt.Json = False,
    seed: opt.Seed = 2019,
    overwrite: opt.Overwrite = False,
) -> None:
    """Audit the published tables of He, Sandu & Osorio (2019): every figure and its verdict."""
    from calib.batch.folders import claimed, fresh_folder
    from calib.he2019.audit import audit_json, run_audit
    from calib.he2019.sections import write_audit_page
    from calib.he2019.tables import published_table

    if out is not None:
        ctx.with_resource(claimed(out, overwrite=overwrite))
    with progress_bars() as tell:
        found = run_audit(seed, progress=tell)
        if out is not None:
            tell("drawing figures", 0, 1)
            with fresh_folder(out, overwrite=overwrite) as folder:
                write_audit_page(found, folder, opt.command())
            tell("drawing figures", 1, 1)
    table = None if number is None else published_table(number, found)
    if table is None:
        _print_audit(found)
    else:
        _print_table(table)
    if out is not None:
        print(out / "index.html")
    finish(0, loads(audit_json(found)) if table is None else table.document())


def _print_table(found: PublishedTable) -> None:
    from rich.table import Table

    table = Table(title=f"Table {found.number} of He, Sandu & Osorio (2019), reconstructed data")
    for heading in found.HEAD:
        left = heading in ("figure", "judgement")
        table.add_column(heading, justify="left" if left else "right")
    for row in found.rows:
        table.add_row(*row.cells)
    console = wide_console()
    console.print(table)
    for f in found.findings:
        console.print(f"{f.key}: {f.verdict.value}: {f.evidence}", soft_wrap=True)


def _print_audit(found: Audit) -> None:
    from rich.table import Table

    from calib.he2019.sections import AUDIT_MARKS

    table = Table(title="Audit of He, Sandu & Osorio (2019)", show_lines=True)
    for heading in ("verdict", "where", "claim or reading", "evidence"):
        table.add_column(heading)
    for f in found.findings:
        where = f"{f.where}\n[reconstructed data]" if f.reconstructed else f.where
        table.add_row(f"{AUDIT_MARKS[f.verdict]} {f.verdict.value}", where, f.claim, f.evidence)
    wide_console().print(table)
    counts = ", ".join(f"{n} {verdict.value}" for verdict, n in found.counts.items())
    print(f"{len(found.findings)} findings: {counts}")
    print(
        "Verdicts marked [reconstructed data] show what a method does with such data and prove "
        "nothing about the measured ones."
    )


def doctor(
    report: Annotated[
        Path | None,
        typer.Option(help="Report to check; reports/he2019 of a checkout by default."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Check it without the sampling, in seconds.")
    ] = False,
    json: opt.Json = False,
) -> None:
    """Say what is installed, on which processor, and whether the shipped report checks here.

    The report is computed again as `calib check` does, some 20 s on two cores; --quick leaves the
    sampling out.

    Ends with 0 where all is well, 1 where the report differs, 2 where it cannot be checked.
    """
    from importlib.metadata import PackageNotFoundError, version

    import calib
    from calib.batch.environment import Environment
    from calib.data.quantities import QUANTITIES
    from calib.gap.effects import EFFECTS
    from calib.models import MODELS

    def installed(package: str) -> str | None:
        try:
            return version(package)
        except PackageNotFoundError:
            return None

    # A checkout has a report, a wheel has none.
    shipped = Path(calib.__path__[0]).parent / "reports" / "he2019"
    folder = report or (shipped if (shipped / "manifest.json").is_file() else None)
    if folder is not None and not quick:
        announce(f"computes {folder} again below, some 20 s; --quick leaves the sampling out")
    environment = Environment.here().document()
    # By the extra of `pip install terracalib[...]` the package that shows it is there, and its use.
    extras = {
        "crate": ("rocrate", "`calib export --ro-crate`"),
        "dashboard": ("bokeh", "Dask's page of what the workers do"),
        "docs": ("sphinx", "the documentation of a checkout"),
        "fmu": ("fmpy", "simulators that are FMUs"),
        "import": ("python-calamine", "workbooks and Parquet for `calib import`"),
        "test": ("pytest", "the tests of a checkout"),
    }
    optional = {extra: installed(package) for extra, (package, _) in extras.items()}
    registered = {
        "models": sorted(MODELS), "effects": sorted(EFFECTS), "quantities": sorted(QUANTITIES),
    }  # fmt: skip
    lines = ["versions", *(f"  {name} {v}" for name, v in environment["versions"].items())]
    lines += ["machine", *(f"  {name}: {v}" for name, v in environment["machine"].items())]
    lines.append("optional")
    for extra, (_, use) in extras.items():
        lines.append(f"  {extra}: {optional[extra] or 'not installed'} ({use})")
    lines.append("registered")
    lines += [f"  {len(names)} {kind}: {', '.join(names)}" for kind, names in registered.items()]
    # What is known at once is said before the check.
    print(*lines, "shipped report", sep="\n", flush=True)
    checked, code = None, 0
    if folder is None:
        print("  none here: it is in the repository")
    else:
        outcome = run_check(folder, quick, opt.CORES)
        code = outcome.exit_code
        checked = {"folder": str(folder), "verdict": outcome.verdict, "exit_code": code}
        print(f"  {folder}: {outcome.verdict}")
    found = {**environment, "optional": optional, "registered": registered, "report": checked}
    finish(code, found)
