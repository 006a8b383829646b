"""One page for a reviewer of a folder: what was claimed, recomputed, differs, cannot be judged."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from calib.checking.check import Outcome
from calib.checking.compare import AUDIT, PAGE, SUMMARY, Item, Status
from calib.checking.folders import labels_in
from calib.data.files import inside, plain_number, read_json
from calib.errors import CalibError
from calib.inference.io import RUN, load_calibration
from calib.inference.joint_files import JOINT, load_joint
from calib.report.comparison import FILE as COMPARISON
from calib.report.labels import odds_text, percent, percent_range
from calib.report.page.template import template
from calib.report.verdict import joint_verdicts, kept_verdict

FILE = "review.json"
# Rows of a part of the page: it is one page, and `calib check --all` lists the rest.
_MOST = 15
type Rows = Iterator[tuple[str, ...]]


def review(folder: Path, outcome: Outcome) -> dict[str, Any]:
    """Say of a folder what it claims, what a check of it computed again, and what stays open.

    Returns
    -------
    dict
        The document of the page, schema `calib/review/1`: of each of its four parts `head`, `rows`
        and a `note`.

    Examples
    --------
    >>> import calib
    >>> review(Path("run"), calib.check(Path("run")))["verdict"]  # doctest: +SKIP
    'SAME, bit for bit: 254 numbers and files'
    """
    differing = ("what", "claimed", "computed again", "remark")
    different = [*map(_row, outcome.of(Status.DIFFERENT))]
    near = sorted(outcome.of(Status.WITHIN), key=lambda item: -(item.share or 0.0))[:3]
    nearest = [(*_row(i)[:3], f"{_percent(i.share)} of what is allowed") for i in near if i.share]
    note = "" if different else "Nothing differs." + " Nearest to it:" * bool(nearest)
    totals: dict[str, list[int]] = {}
    for name, (numbers, _) in outcome.groups.items():
        whose, _, what = name.rpartition(": ")
        kind = totals.setdefault("gaps" if whose == "gap" else what, [0] * len(Status))
        kind[:] = [total + n for total, n in zip(kind, numbers.values(), strict=True)]
    used = [i for i in range(len(Status)) if any(counts[i] for counts in totals.values())]
    counted = ("compared", *(str([*Status][i]) for i in used))
    counts = [(what, *(str(of[i] or "") for i in used)) for what, of in totals.items()]
    allowed = f"Allowed: {outcome.allowed}." if outcome.allowed else ""
    open_, label = [*_open(folder, outcome)], ", ".join(labels_in(folder))
    bad = outcome.exit_code or outcome.not_converged
    return {
        "schema": "calib/review/1", "of": f"the {outcome.kind} {folder.name}", "data_label": label,
        "verdict": outcome.verdict, "tone": "no" if bad else "care" if open_[1:] else "fine",
        "claimed": _part(("claim", "as stated"), [*_CLAIMS[outcome.kind](folder)]),
        "recomputed": _part(counted, counts, allowed),
        "differs": _part(differing, different or nearest, note),
        "not_judged": _part(("what", "why"), open_),
    }  # fmt: skip


def write_review(found: Mapping[str, Any], folder: Path, command: Sequence[str]) -> None:
    """Write the page and the document of a review into an existing folder."""
    text = json.dumps(found, indent=1, allow_nan=False)
    (folder / FILE).write_text(f"{text}\n", encoding="utf-8")
    page = template("review.html.j2").render(command=shlex.join(command), **found)
    (folder / PAGE).write_text(page, encoding="utf-8")


def _part(head: Sequence[str], rows: Sequence[Sequence[str]], note: str = "") -> dict[str, Any]:
    rest = len(rows) - _MOST
    said = [note, f"… and {rest} more, not shown here." if rest > 0 else ""]
    return {"head": list(head), "rows": [*map(list, rows[:_MOST])], "note": " ".join(said).strip()}


def _percent(share: float | None) -> str:
    return f"{plain_number(100.0 * share)} %" if share else ""


def _row(item: Item) -> tuple[str, str, str, str]:
    recorded, found = (
        plain_number(v, 6) if isinstance(v, float) else "" if v is None else str(v)[:24]
        for v in (item.recorded, item.found)
    )
    return item.name, recorded, found, item.note


def _open(folder: Path, outcome: Outcome) -> Rows:
    """What no check settles, what this one left out, and what the folder itself doubts."""
    yield "whether the measurements are true", "a check shows that the numbers follow from them"
    for label in labels_in(folder):
        yield "what measured data would show", f"the data are {label}"
    if outcome.quick:
        yield "the posterior", "sampling was left out (--quick)"
    for model in outcome.not_converged:
        yield model, "its posterior did not converge: not to be used"
    for run in (path.parent for path in (folder / RUN, *sorted(folder.glob(f"runs/*/{RUN}")))):
        judged = kept_verdict(run) if (run / RUN).is_file() else None
        for remark in () if judged is None else judged.warnings:
            yield f"assumptions of {run.name}", remark
    for place, one in joint_verdicts(folder).items() if (folder / JOINT).is_file() else ():
        for remark in one.warnings:
            yield f"assumptions of {place}", remark
    for name, found in inside(read_json(folder / SUMMARY), "models").items():
        for warning in inside(found).get("warnings", ()):
            yield f"assumptions of {name}", warning
        if inside(found, "validation").get("method") == "leave_one_out":
            yield f"prediction of {name}", "no rows were held out: each is predicted by the others"
    for warning in read_json(folder / "diagnosis.json").get("warnings", ()):
        yield "diagnosis", warning
    yield from ((item.name, item.note) for item in outcome.of(Status.UNJUDGED))


def _parameters(found: Mapping[str, Mapping[str, Any]]) -> Rows:
    for name, s in found.items():
        unit = "" if s["unit"] == "1" else f" {s['unit']}"
        middle, low, high = (plain_number(s[k]) for k in ("median", "hdi_lower", "hdi_upper"))
        yield name, f"{middle}{unit} (95 %: {low} to {high})"


def _of_run(folder: Path) -> Rows:
    if (judged := kept_verdict(folder)) is not None:
        yield "verdict", f"{judged.level.value}: {judged.headline}"
        yield "to be trusted", judged.trust
        yield "not to be trusted", judged.doubt
    try:
        calibration = load_calibration(folder)
        names = calibration.problem.names
        yield from _parameters({name: vars(calibration.summary[name]) for name in names})
    except CalibError as error:
        yield "posterior", error.message


def _of_joint(folder: Path) -> Rows:
    for place, judged in joint_verdicts(folder).items():
        yield place, f"{judged.level.value}: {judged.headline}"
    try:
        yield from _parameters({n: vars(s) for n, s in load_joint(folder).summary.items()})
    except CalibError as error:
        yield "posterior", error.message


def _of_report(folder: Path) -> Rows:
    for name, found in inside(read_json(folder / SUMMARY), "models").items():
        scores, sampled = inside(found, "validation"), inside(found, "priors")
        if "error" in found:
            yield name, f"failed: {found['error']}"
            continue
        covered = f"{percent(scores['coverage']['90'])} of {scores['n']} rows not fitted"
        rmse = f"RMSE {plain_number(scores['rmse'])}"
        yield name, f"{found['model']}: 90 % band covers {covered}, {rmse}"
        posterior = {k: s for k, s in found["posterior"].items() if k in sampled}
        yield "its posterior", "; ".join(f"{k} {text}" for k, text in _parameters(posterior))
    if counts := inside(read_json(folder / AUDIT), "counts"):
        yield "audit", ", ".join(f"{n} {verdict}" for verdict, n in counts.items())


def _of_comparison(folder: Path) -> Rows:
    found = read_json(folder / COMPARISON)
    yield "verdict", str(found.get("verdict"))
    for name, m in inside(found, "models").items():
        elpd, se, weight = (plain_number(m[k]) for k in ("elpd", "elpd_se", "weight"))
        yield (
            name,
            f"elpd {elpd} ± {se}, weight {weight}, 90 % band covers {percent(m['coverage_90'])}",
        )


def _of_diagnosis(folder: Path) -> Rows:
    found = read_json(folder / "diagnosis.json")
    yield "verdict", str(found.get("verdict"))
    for effect in (e for e in found.get("effects", ()) if e["probability"] >= 0.01):
        sizes = (f"{k} {plain_number(s['mean'])} ± {plain_number(s['sd'], 2)}"
                 for k, s in effect["parameters"].items())  # fmt: skip
        yield effect["name"], ", ".join((f"probability {odds_text(effect['probability'])}", *sizes))
    for output, s in inside(found, "shrink").items():
        yield (
            f"error of {output}",
            f"{percent(s['fraction'])} smaller ({percent_range(s['interval'])})",
        )


_CLAIMS: Mapping[str, Callable[[Path], Rows]] = {
    "run": _of_run, "report": _of_report, "comparison": _of_comparison, "diagnosis": _of_diagnosis,
    "joint": _of_joint,
}  # fmt: skip
