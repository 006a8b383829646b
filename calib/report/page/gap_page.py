"""Write the page of a diagnosis, drawn and rendered by the processes of a pool.

Where there are others this one never imports what that takes: it would, on one core, while they
wait.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from calib.batch.pool import HERE, Pool
from calib.gap.diagnose import Diagnosis
from calib.report.figures.plate import Plate

# Places of figures, in reading order, that take as long to draw as all others.
_HALF = (1, 2, 3)


def write_page(found: Diagnosis, folder: Path, manifest: Mapping[str, Any]) -> None:
    """Draw ``figures/*.png`` and write them and ``index.html`` into an existing folder.

    Of the manifest ``command`` and ``versions`` are shown, if they are there.
    """
    begin_page(found, manifest)(folder)


def begin_page(
    found: Diagnosis, manifest: Mapping[str, Any], *, pool: Pool = HERE
) -> Callable[[Path], None]:
    """Ask for the page of a diagnosis; return what waits for it and writes it into a folder."""
    # Once for all pieces: it takes longer than to hand it over. Here an effect of a script's own
    # may be in it, which cannot be pickled.
    packed = found if pool.here else pickle.dumps(found)
    halves = [pool.submit(_drawn, packed, half) for half in (True, False)]

    def write(folder: Path) -> None:
        by_place = halves[0].result() | halves[1].result()
        drawn = [by_place[place] for place in sorted(by_place)]
        images = {f"{plate.name}.png": image for plate, image in drawn if image}
        plates = [plate for plate, _ in drawn]
        page = pool.submit(_rendered, packed, plates, images, dict(manifest)).result()
        (folder / "figures").mkdir(exist_ok=True)
        for name, image in images.items():
            (folder / "figures" / name).write_bytes(image)
        (folder / "index.html").write_text(page, encoding="utf-8")

    return write


def _drawn(packed: Diagnosis | bytes, half: bool) -> dict[int, tuple[Plate, bytes]]:
    """Draw one half of the figures; return each by its place, without its canvas and as a file."""
    from dataclasses import replace

    from calib.report.figures.gap import GAP_FIGURES, gap_plates
    from calib.report.figures.style import png
    from calib.report.labels import units_of

    found = _unpacked(packed)
    places = {name: i for i, name in enumerate(GAP_FIGURES) if (i in _HALF) is half}
    with units_of(_headers(found)):
        plates = gap_plates(found, tuple(places))
    return {places[p.name]: (replace(p, figure=None), png(p)) for p in plates}


def _rendered(
    packed: Diagnosis | bytes,
    plates: Sequence[Plate],
    images: Mapping[str, bytes],
    manifest: Mapping[str, Any],
) -> str:
    from calib.report.labels import units_of
    from calib.report.page.diagnosis import render_diagnosis

    found = _unpacked(packed)
    with units_of(_headers(found)):
        return render_diagnosis(found, plates, images, manifest=manifest)


def _unpacked(packed: Diagnosis | bytes) -> Diagnosis:
    found: Diagnosis = pickle.loads(packed) if isinstance(packed, bytes) else packed
    return found


def _headers(found: Diagnosis) -> tuple[str, ...]:
    """Return the column names whose units the page has: those of the field first."""
    return (*found.data.case.field.header, *found.data.case.lab.header)
