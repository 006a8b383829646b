"""Render a study as one self-contained page."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from markupsafe import Markup

from calib.report.figures import Plate
from calib.report.page.content import failed_section, section
from calib.report.page.template import template
from calib.report.publish import Publication
from calib.report.sections import Written
from calib.report.study import OutputResult, Study


def render_page(
    study: Study,
    plates: Mapping[str, Sequence[Plate]],
    images: Mapping[str, bytes],
    *,
    manifest: Mapping[str, Any],
    title: str,
    reconstructed: bool,
    more: Sequence[Written] = (),
    paper: Publication | None = None,
) -> str:
    """Render the report, which makes no request: style and images are inside.

    Parameters
    ----------
    plates : mapping of str to sequence of Plate
        Figures of every output that was worked out.
    images : mapping of str to bytes
        PNG files by name, ``{output}_{plate.name}.png``.
    reconstructed : bool
        Whether any data were reconstructed from published results.
    more : sequence of Written
        Sections after the outputs, as trusted HTML.
    paper : Publication, optional
        Tables and methods beside the page.
    """
    sections = [
        section(key, result, plates.get(key, ()), images)
        if isinstance(result, OutputResult)
        else failed_section(key, result)
        for key, result in study.results.items()
    ]
    return template("report.html.j2").render(
        title=title,
        sections=sections,
        reconstructed=reconstructed,
        more=[{**asdict(s), "html": Markup(s.html)} for s in more],
        paper=paper if paper is not None and paper.files else None,
        seed=study.seed,
        command=shlex.join(str(part) for part in manifest.get("command", ())),
        versions=manifest.get("versions", {}),
        settings=manifest.get("settings", {}),
        tasks=manifest.get("tasks", {}),
    )
