"""The command `doctor`, and `--json` for every command."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer

from calib.report.numbers import finite

# Extra of `pip install terracalib[...]` to the package that shows it is there, and what it is for.
_OPTIONAL = {
    "dashboard": ("bokeh", "Dask's page of what the workers do"),
    "docs": ("sphinx", "the documentation of a checkout"),
    "test": ("pytest", "the tests of a checkout"),
}


def doctor(
    report: Annotated[
        Path | None,
        typer.Option(help="Report to check; reports/he2019 of a checkout by default."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Check it without the sampling, in seconds.")
    ] = False,
    json: Json = False,
) -> None:
    """Say what is installed, on which processor, and whether the shipped report checks here.

    The report is computed again as `calib check` does, some 20 s on two cores; --quick leaves the
    sampling out.

    Ends with 0 where all is well, 1 where the report differs, 2 where it cannot be checked.
    """
    from calib.batch.environment import Environment
    from calib.cli.options import announce

    folder = report if report is not None else _shipped()
    if folder is not None and not quick:
        announce(f"computes {folder} again below, some 20 s; --quick leaves the sampling out")
    found: dict[str, Any] = {
        **Environment.here().document(),
        "optional": {name: _installed(package) for name, (package, _) in _OPTIONAL.items()},
        "registered": _registered(),
    }
    # What is known at once is said before the check.
    print(_text(found), flush=True)
    checked = None if folder is None else _checked(folder, quick=quick)
    print(
        "  none here: it is in the repository" if checked is None
        else f"  {checked['folder']}: {checked['verdict']}"
    )  # fmt: skip
    finish(0 if checked is None else checked["exit_code"], {**found, "report": checked})


def _installed(package: str) -> str | None:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _registered() -> dict[str, list[str]]:
    from calib.data.quantities import QUANTITIES
    from calib.gap.effects import EFFECTS
    from calib.models import MODELS

    return {"models": sorted(MODELS), "effects": sorted(EFFECTS), "quantities": sorted(QUANTITIES)}


def _shipped() -> Path | None:
    """Return the report that a checkout has; a wheel has none."""
    import calib

    folder = Path(calib.__path__[0]).parent / "reports" / "he2019"
    return folder if (folder / "manifest.json").is_file() else None


def _checked(folder: Path, *, quick: bool) -> dict[str, Any]:
    from calib.batch.pool import pool
    from calib.check.check import check
    from calib.cli.options import CORES, progress_bars

    with pool(1 if quick else CORES) as side, progress_bars() as tell:
        outcome = check(folder, quick=quick, progress=tell, pool=side)
    return {"folder": str(folder), "verdict": outcome.verdict, "exit_code": outcome.exit_code}


def _text(found: dict[str, Any]) -> str:
    lines = [
        "versions", *(f"  {name} {version}" for name, version in found["versions"].items()),
        "machine", *(f"  {name}: {value}" for name, value in found["machine"].items()),
        "optional",
        *(
            f"  {name}: {found['optional'][name] or 'not installed'} ({what})"
            for name, (_, what) in _OPTIONAL.items()
        ),
        "registered",
        *(f"  {len(names)} {kind}: {', '.join(names)}" for kind, names in
          found["registered"].items()),
        "shipped report",
    ]  # fmt: skip
    return "\n".join(lines)


class _Aside(io.TextIOBase):
    """An output that forgets what it is told, before the one that a program reads."""

    def __init__(self, output: TextIO) -> None:
        self.output = output

    def write(self, text: str) -> int:
        return len(text)


def _turn(ctx: typer.Context, wanted: bool) -> bool:
    """Keep words for people from the output, until the command has ended."""
    if wanted:
        ctx.with_resource(redirect_stdout(_Aside(sys.stdout)))
    return wanted


Json = Annotated[
    bool,
    typer.Option("--json", help="Print one JSON object in the place of words.", callback=_turn),
]


def finish(code: int, found: Mapping[str, Any] | Path, **more: Any) -> None:
    """Print what was found if JSON is asked for, and end with an exit code.

    It is a document, or the JSON file that holds it; `more` stands before it. What is not finite is
    null.
    """
    if isinstance(sys.stdout, _Aside):
        from calib.data.reader import SEEN

        document = found if isinstance(found, Mapping) else json.loads(found.read_bytes())
        data = {"data_label": ", ".join(SEEN)} if SEEN else {}
        whole = finite({"exit_code": code, **more, **data, **document})
        sys.stdout.output.write(json.dumps(whole, indent=1, allow_nan=False) + "\n")
    if code:
        raise typer.Exit(code)
