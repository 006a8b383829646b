"""Well-specified cases keep design, kind and size of others; a hypothesis draws their readings."""

from __future__ import annotations

import csv
import json
import tomllib
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from calib.errors import CalibError
from calib.gap.batch import case_folders, diagnose_cases
from calib.gap.campaigns import campaigns
from calib.gap.case import read_case
from calib.gap.noise import Noise
from calib.gap.ranking import calibrate_lab
from calib.gap.well_specified import SIZE_RATIO, draw_from_hypothesis, well_specified_case
from challenge.files import OUTPUT_COLUMNS
from challenge.redraw import redraw
from challenge.score import score
from challenge.seal import open_answers
from tests.gap.cases import campaigns_of, make_case, write_case


@pytest.fixture(scope="module")
def blind(blind_test) -> tuple[Path, Path]:
    return blind_test.cases, blind_test.key


@pytest.fixture(scope="module")
def believed(believed_test) -> tuple[Path, Path]:
    return believed_test.cases, believed_test.key


def answers(cases: Path, folder: Path) -> dict[str, dict]:
    return {name: a.model_dump() for name, a in open_answers(cases, folder).items()}


def drawn(blind: tuple[Path, Path], root: Path, **options: int) -> dict[str, str]:
    draw = partial(well_specified_case, 1)
    return redraw(*blind, root / "cases", root / "answers", draw, seed=1, **options)


def cells(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_design_and_kind_are_those_of_the_case(blind, believed):
    cases, theirs = (answers(*pair) for pair in (blind, believed))
    assert list(theirs) == list(cases)
    for name, entry in theirs.items():
        assert (entry["tier"], entry["truth"]) == (cases[name]["tier"], cases[name]["truth"])
        both = [root / name / "case.toml" for root in (blind[0], believed[0])]
        said = [tomllib.loads(path.read_text()) for path in both]
        assert said[0].pop("answer_sha256") != said[1].pop("answer_sha256")
        assert said[0] == said[1]
        both = [path.with_name("fresh.csv").read_text() for path in both]
        assert both[0] == both[1]
        for file in ("lab.csv", "field.csv"):
            ours, others = cells(believed[0] / name / file), cells(blind[0] / name / file)
            assert list(ours[0]) == list(others[0])
            readings = {OUTPUT_COLUMNS[o] for o in entry["noise_sd"]}
            for one, other in zip(ours, others, strict=True):
                assert {c for c in one if one[c] != other[c]} <= readings
                assert any(one[c] != other[c] for c in readings)


def test_the_gap_has_the_size_of_the_cases(blind, believed):
    cases, theirs = (answers(*pair) for pair in (blind, believed))
    for name, entry in theirs.items():
        squares = []
        for output, sd in entry["noise_sd"].items():
            truth, without = (np.array(entry[k][output]) for k in ("field_truth", "field_without"))
            # Rut depth and density have noise that is relative: on the logarithm it is sd/truth.
            log = output != "drawbar_pull"
            gap = np.log(truth / without) if log else truth - without
            squares.append(np.square(gap / (np.array(sd) / (truth if log else 1.0))))
        rms = float(np.sqrt(np.mean(np.concatenate(squares))))
        assert rms == pytest.approx(entry["gap_over_noise"], abs=1e-9)
        wanted = cases[name]["gap_over_noise"]
        assert wanted / SIZE_RATIO <= rms <= wanted * SIZE_RATIO


def test_readings_are_the_truth_with_noise(believed):
    """Standardised differences have unit variance over all readings of all cases."""
    z = []
    for name, entry in answers(*believed).items():
        rows = cells(believed[0] / name / "field.csv")
        for output, sd in entry["noise_sd"].items():
            read = np.array([float(row[OUTPUT_COLUMNS[output]]) for row in rows])
            truth, sd = np.array(entry["field_truth"][output]), np.array(sd)
            log = output != "drawbar_pull"
            z.append(np.log(read / truth) / (sd / truth) if log else (read - truth) / sd)
    z = np.concatenate(z)
    assert abs(z.mean()) < 4.0 / np.sqrt(z.size)
    assert abs(z.var() - 1.0) < 4.0 * np.sqrt(2.0 / z.size)


@pytest.mark.slow  # with one, the command line's are compared in every run
def test_the_same_seed_gives_the_same_cases_on_any_number_of_workers(blind, believed, tmp_path):
    drawn(blind, tmp_path, workers=2)
    for root in believed:
        for path in filter(Path.is_file, root.rglob("*")):
            assert (tmp_path / root.name / path.relative_to(root)).read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_they_are_diagnosed_and_scored_as_any_case(believed, tmp_path):
    folders = case_folders(believed[0])
    assert diagnose_cases(folders[:2], tmp_path / "results", 1) == {}
    found = score(believed[0], tmp_path / "results", believed[1])
    assert len(found.answers) == len(folders)
    assert [answer.problem == "" for answer in found.answers] == [True] * 2 + [False] * 4


def test_a_key_of_other_cases_is_refused(blind, tmp_path):
    wrong = tmp_path / "answers"
    (wrong / "case-000").mkdir(parents=True)
    answer = json.dumps({"schema": "calib/answer/1", "truth": "none"})
    (wrong / "case-000" / "answer.json").write_text(answer)
    with pytest.raises(CalibError, match="SHA-256"):
        drawn((blind[0], wrong), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_truth_that_the_design_cannot_show_is_refused(blind):
    data = campaigns(read_case(next(p for p in sorted(blind[0].iterdir()) if p.is_dir())))
    lab_mode, noise = calibrate_lab(data, 1)
    with pytest.raises(CalibError, match="not tested on this design"):
        draw_from_hypothesis(data, lab_mode, noise, "no_such_effect", 3.0, np.random.default_rng(0))


def test_cases_that_cannot_be_drawn_are_named_and_a_key_is_not_overwritten(blind, tmp_path):
    def refuse(folder: Path, truth: str, size: float) -> tuple[dict[str, str], dict[str, object]]:
        if truth != "none":
            raise CalibError(f"not {truth}")
        return {"case.toml": ""}, {"gap_over_noise": size}

    truths = {name: e["truth"] for name, e in answers(*blind).items()}
    without = redraw(*blind, tmp_path / "cases", tmp_path / "answers", refuse, seed=1)
    assert without == {name: f"not {truth}" for name, truth in truths.items() if truth != "none"}
    with pytest.raises(CalibError, match="not empty"):
        redraw(*blind, tmp_path / "more", tmp_path / "answers", refuse, seed=1)


LAB = {"drawbar_pull": Noise(0.03, 1.0), "rut_depth": Noise(0.05)}


def draw(truth: str, size: float, seed: int = 1):
    data = campaigns_of(None)
    mode = {o.name: np.array([p.loc for p in o.priors.free]) for o in data.outputs}
    found = draw_from_hypothesis(data, mode, LAB, truth, size, np.random.default_rng(seed))
    for name, part in found.forward.theta_slices.items():
        np.testing.assert_array_equal(found.psi[:, part], mode[name][None])
    return data, found


def test_a_design_without_new_conditions_is_refused(tmp_path):
    folder = write_case(make_case(None), tmp_path / "design")
    with pytest.raises(CalibError, match=r"there is no fresh\.csv"):
        well_specified_case(1, folder, "none", 0.0)
