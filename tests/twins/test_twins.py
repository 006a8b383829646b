"""Twins keep design, kind and size of a blind case; their readings come from the hypotheses."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from calib.challenge.files import OUTPUT_COLUMNS
from calib.challenge.score import score
from calib.challenge.seal import open_key
from calib.errors import CalibError
from calib.gap.batch import case_folders, diagnose_cases
from calib.gap.case import campaigns, read_case
from calib.gap.which import calibrate_lab
from calib.twins import make_twins
from calib.twins.draw import SIZE_RATIO, draw_twin


@pytest.fixture(scope="module")
def blind(blind_test) -> tuple[Path, Path]:
    return blind_test.cases, blind_test.key


@pytest.fixture(scope="module")
def twins(blind, tmp_path_factory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("twins")
    without = make_twins(*blind, root / "cases", root / "key.json", seed=1)
    assert without == {}
    return root / "cases", root / "key.json"


def cells(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_twin_has_the_design_and_the_kind_of_its_case(blind, twins):
    cases, theirs = (open_key(*pair)["cases"] for pair in (blind, twins))
    assert list(theirs) == list(cases)
    for name, entry in theirs.items():
        assert (entry["tier"], entry["truth"]) == (cases[name]["tier"], cases[name]["truth"])
        for file in ("case.toml", "fresh.csv"):
            assert (blind[0] / name / file).read_text() == (twins[0] / name / file).read_text()
        for file in ("lab.csv", "field.csv"):
            ours, others = cells(twins[0] / name / file), cells(blind[0] / name / file)
            assert list(ours[0]) == list(others[0])
            readings = {OUTPUT_COLUMNS[o] for o in entry["noise_sd"]}
            for one, other in zip(ours, others, strict=True):
                assert {c for c in one if one[c] != other[c]} <= readings
                assert any(one[c] != other[c] for c in readings)


def test_the_gap_has_the_size_of_the_cases(blind, twins):
    cases, theirs = (open_key(*pair)["cases"] for pair in (blind, twins))
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


def test_readings_are_the_truth_with_noise(twins):
    """Standardised differences have unit variance over all readings of all twins."""
    z = []
    for name, entry in open_key(*twins)["cases"].items():
        rows = cells(twins[0] / name / "field.csv")
        for output, sd in entry["noise_sd"].items():
            read = np.array([float(row[OUTPUT_COLUMNS[output]]) for row in rows])
            truth, sd = np.array(entry["field_truth"][output]), np.array(sd)
            log = output != "drawbar_pull"
            z.append(np.log(read / truth) / (sd / truth) if log else (read - truth) / sd)
    z = np.concatenate(z)
    assert abs(z.mean()) < 4.0 / np.sqrt(z.size)
    assert abs(z.var() - 1.0) < 4.0 * np.sqrt(2.0 / z.size)


def test_the_same_seed_gives_the_same_twins_on_any_number_of_workers(blind, twins, tmp_path):
    make_twins(*blind, tmp_path / "cases", tmp_path / "key.json", seed=1, workers=2)
    assert (tmp_path / "key.json").read_bytes() == twins[1].read_bytes()
    for path in twins[0].rglob("*.csv"):
        assert (tmp_path / "cases" / path.relative_to(twins[0])).read_bytes() == path.read_bytes()


def test_twins_are_diagnosed_and_scored_as_any_case(twins, tmp_path):
    folders = case_folders(twins[0])
    assert diagnose_cases(folders[:2], tmp_path / "results", 1) == {}
    found = score(twins[0], tmp_path / "results", twins[1])
    assert len(found.answers) == len(folders)
    assert [answer.problem == "" for answer in found.answers] == [True] * 2 + [False] * 4


def test_a_key_of_other_cases_is_refused(blind, tmp_path):
    wrong = tmp_path / "key.json"
    wrong.write_text(json.dumps({"schema": "calib/challenge-key/1", "cases": {}}))
    with pytest.raises(CalibError, match="SHA-256"):
        make_twins(blind[0], wrong, tmp_path / "out", tmp_path / "twin.json", seed=1)
    assert not (tmp_path / "out").exists()


def test_a_truth_that_the_design_cannot_show_has_no_twin(blind):
    data = campaigns(read_case(next(p for p in sorted(blind[0].iterdir()) if p.is_dir())))
    lab_mode, noise = calibrate_lab(data, 1)
    with pytest.raises(CalibError, match="not tested on this design"):
        draw_twin(data, lab_mode, noise, "no_such_effect", 3.0, np.random.default_rng(0))
