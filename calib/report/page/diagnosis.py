"""The files of a diagnosis: pure functions of its document."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from calib.gap.constants import LEFT, MIN_EFFECT_SIZE, MIN_EFFECT_SIZE_IN_PAIR, MOST_LEFT
from calib.gap.document import Explanation, GapDocument
from calib.gap.files import program_files
from calib.report.gap_words import Tone, Words, short_name, tied
from calib.report.labels import units_of
from calib.report.markup import prose
from calib.report.page.template import equation, parametrisation, picture, template

if TYPE_CHECKING:
    from calib.report.figures.style import Plate

# A shape beside every colour.
TONE_MARKS = {
    Tone.FINE: "\N{HEAVY CHECK MARK}",
    Tone.CARE: "\N{BLACK UP-POINTING TRIANGLE}",
    Tone.NO: "?",
}


def render_diagnosis(d: GapDocument) -> dict[str, bytes]:
    """Render the files of a diagnosis from its document alone, by name.

    They are ``index.html``, ``figures/*.png``, and those for programs of `calib.gap.files.FILES`.
    The document is from `calib.gap.document.load_document`, or of a diagnosis just made.
    """
    return {**_page_files(d), **program_files(d)}


def write_page(d: GapDocument, folder: Path) -> None:
    """Write the page and the figures of a diagnosis into an existing folder."""
    (folder / "figures").mkdir(exist_ok=True)
    for name, content in _page_files(d).items():
        (folder / name).write_bytes(content)


def _page_files(d: GapDocument) -> dict[str, bytes]:
    from calib.report.figures.gap import gap_plates
    from calib.report.figures.style import png, said_of_points, stack

    plates = gap_plates(d)
    images = {p.name: png(p) for p in plates if p.figure is not None}
    plates = [
        p if p.figure is None else replace(p, points=said_of_points(p.figure)) for p in plates
    ]
    narrow = {
        p.name: png(p)
        for p in plates
        if p.name == "corrected" and p.figure is not None and stack(p.figure)
    }
    return {
        "index.html": render_page(d, plates, images, narrow).encode(),
        **{f"figures/{name}.png": image for name, image in images.items()},
        **{f"figures/{name}_narrow.png": image for name, image in narrow.items()},
    }


def render_page(
    d: GapDocument,
    plates: Sequence[Plate],
    images: Mapping[str, bytes],
    narrow: Mapping[str, bytes] = MappingProxyType({}),
) -> str:
    """Render the page, which makes no request: style and images are inside.

    Images are PNG files by the names of the plates, those for narrow screens too.
    """
    with units_of(d.headers):
        words = Words(d)
        verdict = words.verdict()
        return template("diagnosis.html.j2").render(
            d=d,
            n=words.n,
            say=words,
            title=f"Sim-to-real gap: {d.name}",
            data_label=d.label,
            verdict=verdict,
            mark=TONE_MARKS[verdict.tone],
            figures={
                p.name: picture(p, images.get(p.name, b""), p.caption, narrow.get(p.name, b""))
                for p in plates
            },
            groups=hypothesis_groups(d),
            name=short_name,
            relevance=(LEFT, MOST_LEFT, MIN_EFFECT_SIZE, MIN_EFFECT_SIZE_IN_PAIR),
            equations={name: equation(latex, "") for name, latex in d.equations.items()},
            simulators=[
                {
                    "title": o.title,
                    "equation": equation(o.latex, o.numbers),
                    "parameters": prose(
                        parametrisation(o.parametrisation, o.references), o.parameters
                    ),
                }
                for o in d.outputs
            ],
            command=shlex.join(d.command),
        )


def hypothesis_groups(d: GapDocument) -> dict[str, list[Explanation]]:
    """Group the explanations by how probable they are; sets that are ruled out come last."""
    best = tied(d)
    best += [e for e in d.explanations[len(best) :] if e.probability >= 0.2 * d.best.probability]
    rest = d.explanations[len(best) :]
    out = [e for e in rest if e.probability < 0.01]
    groups: dict[str, Any] = {
        "best": best,
        "less": [e for e in rest if e not in out],
        "out": [e for e in out if "+" not in e.name],
        "sets": [e for e in out if "+" in e.name],
    }
    return {name: members for name, members in groups.items() if members}
