"""Verbs that write what to begin with: data, templates and priors."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from calib.cli import options as opt
from calib.errors import CalibError


def data(
    name: Annotated[str, typer.Argument(help="he2019 or he2019-gaps")],
    out: Annotated[Path | None, typer.Option(help="Folder to write; its name if none.")] = None,
    overwrite: opt.Overwrite = False,
) -> None:
    """Write the embedded, reconstructed data as CSV files, or as cases for `calib diagnose`."""
    writers = {"he2019": _write_he2019, "he2019-gaps": _write_he2019_gaps}
    if name not in writers:
        raise CalibError(
            f"there is no data set {name!r}", allowed=", ".join(writers), mend="use one of these"
        )  # fmt: skip
    folder = Path(name) if out is None else out
    try:
        written = writers[name](folder, overwrite)
    except OSError as error:
        raise CalibError(
            f"the folder cannot be written ({error.strerror})", where=str(folder),
            mend="choose another --out",
        ) from None  # fmt: skip
    for path in written:
        print(f"{path} (reconstructed from published results, not measured)")


def _write_he2019(out: Path, overwrite: bool) -> list[Path]:
    from calib.he2019.datasets import embedded

    existing = [f"{key}.csv" for key in embedded.tables() if (out / f"{key}.csv").exists()]
    if existing and not overwrite:
        raise CalibError(
            f"{', '.join(existing)} exist there already", where=str(out),
            mend="choose another --out, or pass --overwrite",
        )  # fmt: skip
    return embedded.write(out)


def _write_he2019_gaps(out: Path, overwrite: bool) -> list[Path]:
    from calib.he2019.gaps.cases import paper_gaps, write_cases

    return write_cases(paper_gaps(), out, overwrite=overwrite)


def template(
    model: Annotated[str, typer.Argument(help="See `calib models`.")],
    out: Annotated[Path | None, typer.Option(help="CSV to write; printed if none.")] = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
) -> None:
    """Write an example CSV of a model to fill in."""
    from calib.models import get_model, template_csv

    text = template_csv(get_model(model).name)
    _emit(text, out)
    if "run_order" in text:
        print("calib: run_order may be left out: number the rows as they were measured, or delete "
              "the column", file=sys.stderr)  # fmt: skip


def priors(
    model: Annotated[str, typer.Argument(help="See `calib models`.")],
    out: Annotated[Path | None, typer.Option(help="TOML to write; printed if none.")] = None,
    plugins: opt.Models = None,
    simulator: opt.Simulators = None,
) -> None:
    """Write the shipped priors of a model, to copy and edit."""
    from calib.inference.prior_files import default_priors
    from calib.models import get_model

    _emit(default_priors(get_model(model).name).read_text(encoding="utf-8"), out)


def _emit(text: str, out: Path | None) -> None:
    if out is None:
        sys.stdout.write(text)
        return
    from calib.batch.folders import write_whole

    try:
        if out.exists():
            raise CalibError("the file exists already", where=str(out), mend="choose another --out")
        write_whole(out, text)
    except OSError as error:
        raise CalibError(
            f"the file cannot be written ({error.strerror})", where=str(out),
            mend="choose another --out",
        ) from None  # fmt: skip
    print(out)
