"""The page of a report, from the documents of its outputs and their figures."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import Any

from markupsafe import Markup

from calib.models import MODELS
from calib.report.document import Output, outputs, page_facts
from calib.report.figures.collect import Drawn
from calib.report.markup import prose, to_html
from calib.report.numbers import TIMES
from calib.report.page.template import equation, parametrisation, picture, template
from calib.report.publish import Publication, likelihood
from calib.report.publish.tables import TICK, TOPICS
from calib.report.sections import Section, emulation_words
from calib.report.study import OutputResult, Study
from calib.report.verdict import Level

# A shape beside every colour.
_LOOKS: Mapping[str, tuple[str, str]] = {
    Level.FINE: ("\N{HEAVY CHECK MARK}", "fine"),
    Level.CARE: ("\N{BLACK UP-POINTING TRIANGLE}", "care"),
    Level.NO: ("\N{HEAVY BALLOT X}", "no"),
    Level.FAILED: ("\N{HEAVY BALLOT X}", "failed"),
}


def cell(text: str, ticks: bool = False) -> Markup:
    """Write a cell for a page; beside cells with ticks it keeps room for one."""
    body, tick = to_html(text.removesuffix(TICK)), TICK if text.endswith(TICK) else ""
    return body + Markup('<span class="tick">{}</span>').format(tick) if ticks else body


def section(o: Output, result: OutputResult, drawn: Drawn | None) -> dict[str, Any]:
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
        "mark": _LOOKS[verdict.level][0],
        "tone": _LOOKS[verdict.level][1],
        "equation": equation(bound.model.latex, bound.model.numbers),
        "likelihood": to_html(likelihood(o)),
        "parametrisation": said(parametrisation(bound.model.parametrisation, bound.references)),
        "tables": {name: topic.of_output(o) for name, topic in TOPICS.items()},
        "figures": {
            p.name: {
                **picture(p, drawn.files.get(f"{o.key}_{p.name}.png", b""), said(p.caption)),
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

    Parameters
    ----------
    drawn : mapping of str to Drawn
        Figures of every output that was worked out.
    manifest, summary : mapping
        The documents beside the page.
    more : sequence of (Section, str)
        Sections after the outputs, with their pieces of the page as trusted HTML.
    paper : Publication, optional
        Tables and methods beside the page.
    """
    emulations = manifest.get("emulators", {})
    found = {}
    for o in outputs(manifest, summary):
        result, emulation = study.successes[o.key], emulations.get(o.model.name)
        facts = page_facts(result, (emulation or {}).get("reasons", ()))
        o = replace(o, facts={**facts, "emulation": emulation})
        found[o.key] = section(o, result, drawn.get(o.key))
    return template("report.html.j2").render(
        outputs={key: found.get(key) for key in study.results},
        failures=study.failures,
        models=MODELS,
        known=manifest,
        more=[(s, Markup(html)) for s, html in more],
        paper=paper if paper is not None and paper.files else None,
        command=shlex.join(str(part) for part in manifest.get("command", ())),
        failed_mark=_LOOKS[Level.FAILED][0],
        times=TIMES,
        html=to_html,
        cell=cell,
        emulation_words=emulation_words,
        file_name=lambda path: PurePath(path).name,
        # The class of an exception says nothing to a reader of the page.
        reason=lambda e: re.sub(r"^(?:[A-Za-z_][\w.]*(?:Error|Exception): )+", "", e),
    )
