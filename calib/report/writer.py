"""Write a study as one folder: page, figures, numbers, posteriors, manifest. It only formats."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path, PurePath
from typing import Any

from markupsafe import Markup

from calib.batch.environment import Environment, sha256
from calib.batch.folders import fresh_folder
from calib.batch.pool import HERE
from calib.data import write_table
from calib.inference.estimators import GeneticSettings, method_name
from calib.inference.io import own_names, save_posterior
from calib.inference.prior_files import default_priors, whole_text
from calib.inference.sampler import SamplerSettings
from calib.models import MODELS, get_model
from calib.models.simulators.emulator import emulator_of, save_emulator
from calib.report.document import Output, outputs, page_facts, summarise
from calib.report.figures.collect import NARROW, Drawn, draw
from calib.report.labels import joined, plain
from calib.report.markup import prose, to_html
from calib.report.numbers import TIMES
from calib.report.page.template import equation, parametrisation, picture, template
from calib.report.publish import Publication, likelihood, publication
from calib.report.publish.tables import TICK, TOPICS, chains_table, parameters_table
from calib.report.sections import Report, Section, Target, emulation_words
from calib.report.study import OutputResult, Progress, Study, Task, silent
from calib.report.verdict import Level


def file_hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file below a folder but the manifest, by relative path."""
    return {
        path.relative_to(folder).as_posix(): sha256(path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.relative_to(folder).as_posix() != "manifest.json"
    }


def build_manifest(
    report: Report, settings: SamplerSettings, command: Sequence[str], title: str,
    environment: Environment, inputs: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:  # fmt: skip
    """Return what it takes to make a report again, its file hashes still to be added.

    `inputs` are for every output the files its data and priors were copied to, and their hashes.
    ``seconds`` is the one place of a report that holds durations, which no two runs share.
    """
    study = report.study
    return {
        "schema": "calib/manifest/2",
        "title": title,
        "command": list(command),
        "seed": study.seed,
        **environment.document(),
        "settings": json.loads(json.dumps(asdict(settings))),
        "genetic_algorithm": asdict(GeneticSettings()),
        "tasks": {key: _task(r.task, inputs[key]) for key, r in study.results.items()},
        "seconds": {
            "study": study.seconds,
            **{
                key: {**r.seconds, "methods": {e.method: e.seconds for e in r.estimates}}
                for key, r in study.successes.items()
            },
        },
    }


def _task(task: Task, inputs: Mapping[str, Any]) -> dict[str, Any]:
    held = None if task.held_out is None else asdict(task.held_out)
    return {"model": task.model, "held_out": held, "label": task.table.label, **inputs}


def write_report(
    report: Report,
    out: Path,
    *,
    settings: SamplerSettings,
    command: Sequence[str],
    title: str,
    overwrite: bool = False,
    posteriors: bool = True,
    views: bool = True,
    environment: Environment | None = None,
    pdf: bool = False,
    progress: Progress | None = None,
    pool: Executor = HERE,
) -> Path:
    """Write a report folder, whole or not at all, and return the path of its ``index.html``.

    Parameters
    ----------
    settings : SamplerSettings
        Of the study, for the manifest; so is the command line.
    posteriors : bool
        Whether to keep the netCDF files, which are megabytes; the manifest has their hashes.
    views : bool
        Whether to keep what follows from numbers and inputs: page, figures, tables, diagnoses of
        gaps. Without them durations go too, so that the rest can be kept under version control.
    environment : Environment, optional
        Where the manifest says the report was made: that of this process by default.
    pdf : bool
        Whether every figure also comes as PDF, for print.
    pool : Executor, optional
        Where figures are drawn.

    Raises
    ------
    CalibError
        If the folder exists, and an earlier report is not to be replaced, or cannot be written.
    """
    tell = progress or silent
    study, where = report.study, environment or Environment.here()
    with fresh_folder(out, overwrite=overwrite) as folder:
        (folder / "figures").mkdir()
        drawing = {key: pool.submit(draw, key, r, pdf=pdf) for key, r in study.successes.items()}
        kept = [pool.submit(_keep, key, r, folder) for key, r in study.successes.items()]
        manifest = build_manifest(
            report, settings, command, title, where, _copy_inputs(study, folder)
        ) | {"pdf": pdf}  # fmt: skip
        summary = summarise(study)
        for section, part in report.parts:
            if (numbers := section.summary(part)) is not None:
                summary[section.name] = numbers
        (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
        paper = publication(manifest, summary)
        for path, text in paper.files.items():
            (folder / path).parent.mkdir(exist_ok=True)
            (folder / path).write_text(text, encoding="utf-8")
        to = Target(folder, where.versions, pdf, pool, tell)
        more = [(section, section.view(part, to)) for section, part in report.parts]
        manifest |= {section.name: section.record(part) for section, part in report.parts}
        drawn = {}
        for i, (key, piece) in enumerate(drawing.items()):
            tell("drawing figures", i, len(drawing))
            drawn[key] = piece.result()
            for name, content in drawn[key].files.items():
                (folder / "figures" / name).write_bytes(content)
        tell("drawing figures", len(drawing), len(drawing))
        for netcdf in kept:
            netcdf.result()
        page = render_page(study, drawn, manifest=manifest, summary=summary, more=more, paper=paper)
        (folder / "index.html").write_text(page, encoding="utf-8")
        files = file_hashes(folder)
        left_out = [] if posteriors else [f"{key}.nc" for key in study.successes]
        manifest["views"] = views
        manifest["left_out"] = {name: files.pop(name) for name in left_out}
        if not views:
            del manifest["seconds"]
            files = {name: files[name] for name in files if _is_kept(name)}
        manifest["files"] = files
        _remove_all_but(files, folder)
        (folder / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n")
    return Path(out) / ("index.html" if views else "summary.json")


def _is_kept(name: str) -> bool:
    """Whether a file is numbers or input, not a view of them."""
    return name.startswith(("data/", "priors/", "emulators/")) or (
        "/" not in name and name.endswith(".json")
    )


def _remove_all_but(files: Collection[str], folder: Path) -> None:
    """Remove every other file, and the folders that this leaves empty."""
    for made in sorted(folder.rglob("*"), reverse=True):  # what is in a folder before it
        if made.is_dir():
            with suppress(OSError):  # not empty
                made.rmdir()
        elif made.relative_to(folder).as_posix() not in files:
            made.unlink()


def _keep(key: str, result: OutputResult, folder: Path) -> None:
    """Write the posterior of an output."""
    save_posterior(result.calibration, folder / f"{key}.nc")


def _copy_inputs(study: Study, folder: Path) -> dict[str, dict[str, Any]]:
    """Copy data and priors into the report, so that it can be computed again from itself."""
    (folder / "data").mkdir()
    (folder / "priors").mkdir()
    inputs = {}
    for key, result in study.results.items():
        task = result.task
        prior_path = task.prior_path or default_priors(task.model)
        write_table(folder / "data" / f"{key}.csv", task.table.whole())
        data = (folder / "data" / f"{key}.csv").read_bytes()
        priors = whole_text(prior_path, task.model).encode()
        (folder / "priors" / f"{key}.toml").write_bytes(priors)
        emulator = emulator_of(get_model(task.model))
        if emulator is not None:
            save_emulator(emulator, task.model, folder / "emulators" / f"{key}.npz")
        inputs[key] = {
            "data": {
                "file": f"data/{key}.csv",
                "sha256": sha256(data),
                "source": task.table.source,
                "source_sha256": task.table.sha256,
                **own_names(task.table),
                "ignored": list(task.table.ignored),
            },
            "priors": {
                "file": f"priors/{key}.toml",
                "sha256": sha256(priors),
                "source": prior_path.name,
                "shipped": task.prior_path is None,
            },
        }
    return inputs


# A shape beside every colour.
_MARKS = {Level.FINE: "\N{HEAVY CHECK MARK}", Level.CARE: "\N{BLACK UP-POINTING TRIANGLE}"}
_FAILED_MARK = "\N{HEAVY BALLOT X}"


def _cell(text: str, ticks: bool = False) -> Markup:
    """Write a cell for a page; beside cells with ticks it keeps room for one."""
    body, tick = to_html(text.removesuffix(TICK)), TICK if text.endswith(TICK) else ""
    return body + Markup('<span class="tick">{}</span>').format(tick) if ticks else body


def identified_words(o: Output) -> str:
    """Say in a line which sampled parameters the priors decide, and which they move."""
    known = o.found["prior_sensitivity"]["parameters"]
    sampled = [s.name for s in o.posterior if s.sd_ratio == s.sd_ratio and s.name in known]
    unknown, moved = (
        joined([plain(name) for name in sampled if known[name]["reading"] == reading])
        for reading in ("not identified", "data and prior")
    )
    said = [f"the data do not identify {unknown}, so their priors decide"] if unknown else []
    said += [f"the prior also moves {moved}"] if moved else []
    return "; ".join(said) or f"the data identify all {len(sampled)} parameters"


def _section(o: Output, result: OutputResult, drawn: Drawn | None) -> dict[str, Any]:
    """Return what the template shows of an output."""
    bound, verdict = result.calibration.problem.bound, o.facts["verdict"]
    names = [*bound.model.reported, *result.calibration.problem.priors.names]

    def said(text: str) -> Markup:
        return prose(text, names)

    return {
        "o": o,
        "said": said,
        "fit": o.found["validation"],
        "chains": o.found["sampling"],
        "mark": _MARKS.get(verdict.level, _FAILED_MARK),
        "tone": verdict.level.name.lower(),
        "equation": equation(bound.model.latex, bound.model.numbers),
        "likelihood": to_html(likelihood(o)),
        "parametrisation": said(parametrisation(bound.model.parametrisation, bound.references)),
        "tables": {name: topic.of_output(o) for name, topic in TOPICS.items()},
        "letters": to_html(bound.model.letters),
        "parameters": parameters_table(o),
        "derived": len(parameters_table(o).groups[-1]) > 0,
        "by_chain": chains_table(o),
        "identified": said(identified_words(o)),
        "methods": joined([method_name(m) for m in o.found["estimates"]]) or "none",
        "figures": {
            p.name: {
                **picture(
                    p,
                    drawn.files.get(f"{o.key}_{p.name}.png", b""),
                    said(p.caption),
                    drawn.files.get(f"{o.key}_{p.name}{NARROW}.png", b""),
                ),
                "alt": p.caption,
            }
            for p in drawn.plates
        }
        if drawn
        else {},
    }


def render_page(
    study: Study,
    drawn: Mapping[str, Drawn],
    *,
    manifest: Mapping[str, Any],
    summary: Mapping[str, Any],
    more: Sequence[tuple[Section[Any], str]] = (),
    paper: Publication | None = None,
) -> str:
    """Render the report, which makes no request: style and images are inside.

    Manifest, summary and paper are those beside the page; sections after the outputs have their
    pieces of the page as trusted HTML.
    """
    emulations = manifest.get("emulators", {})
    found = {}
    for o in outputs(manifest, summary):
        result, emulation = study.successes[o.key], emulations.get(o.model.name)
        facts = page_facts(result, (emulation or {}).get("reasons", ()))
        o = replace(o, facts={**facts, "emulation": emulation})
        found[o.key] = _section(o, result, drawn.get(o.key))
    return template("report.html.j2").render(
        outputs={key: found.get(key) for key in study.results},
        failures=study.failures,
        models=MODELS,
        known=manifest,
        more=[(s, Markup(html)) for s, html in more],
        paper=paper if paper is not None and paper.files else None,
        command=shlex.join(str(part) for part in manifest.get("command", ())),
        failed_mark=_FAILED_MARK,
        times=TIMES,
        html=to_html,
        cell=_cell,
        emulation_words=emulation_words,
        file_name=lambda path: PurePath(path).name,
        # The class of an exception says nothing to a reader of the page.
        reason=lambda e: re.sub(r"^(?:[A-Za-z_][\w.]*(?:Error|Exception): )+", "", e),
    )
