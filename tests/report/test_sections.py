"""What a report says of emulated simulators."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from calib.report.sections import SECTIONS, EmulatorSection, Target, coverage_words, emulation_words

GOOD: dict[str, Any] = {
    "runs": 60, "nodes": 12, "between_nodes_error_in_noise_sds": 0.0123, "simulator_noise_sd": 0.0,
    "passed": True, "reasons": [], "failed": [],
    "held_out": {"runs": 20, "rmse_in_noise_sds": 0.0456, "covered_90": 0.95,
                 "pit": [0.1, 0.2, 0.3, 0.9, 1.0]},
}  # fmt: skip
CRASHES = [
    {"parameters": [1.0, 2.5e6], "kind": "exit", "reason": f"exit code {i}", "printed": "<no> mesh"}
    for i in range(25)
]
BAD: dict[str, Any] = {
    **GOOD, "passed": False, "reasons": ["too few runs", "too coarse"], "simulator_noise_sd": 0.3,
    "held_out": None, "failed": CRASHES,
}  # fmt: skip


def test_emulators_and_failed_runs_are_listed() -> None:
    documents = {"good": GOOD, "bad": BAD}
    html = EmulatorSection(documents).view(documents, Target(Path(), {}))
    tables = [
        [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row) for row in re.findall(r"<tr>(.*?)</tr>", t)]
        for t in re.findall(r"<table>(.*?)</table>", html, re.DOTALL)
    ]
    emulators, failed = tables
    assert emulators[1:] == [
        ["good", "60", "12", "0.0456 on 20",
         "95 % (95 % interval 62 to 100 %): as they should be", "40 %, 20 %, 0 %, 40 %",
         "0.0123", "none", "good enough"],
        ["bad", "60", "12", "none left", "", "none", "0.0123", "0.300", "too few runs; too coarse"],
    ]  # fmt: skip
    assert "25 runs of bad failed" in html
    assert "The first 20:" in html
    assert failed[1:] == [
        ["1, 2.5e+06", "exit", f"exit code {i}", "&lt;no&gt; mesh"] for i in range(20)
    ]


@pytest.mark.parametrize(
    ("share", "n", "words"),
    [
        (0.77, 200, "77 % (95 % interval 71 to 82 %): too narrow"),
        (0.84, 20, "84 % (95 % interval 65 to 96 %): as they should be"),
        (1.0, 200, "100 % (95 % interval 99 to 100 %): wider than necessary"),
    ],
)
def test_the_coverage_of_an_emulator_is_judged(share: float, n: int, words: str) -> None:
    assert coverage_words(share, n) == words


def test_a_verdict_says_what_stood_in_for_a_simulator() -> None:
    said = emulation_words(GOOD)
    assert "made from 60 runs" in said
    assert "off by 0.046 noise sds (rms) on 20 runs" in said
    assert emulation_words(BAD).endswith("no run was left to check it on")


def test_the_record_makes_the_section_again() -> None:
    found = EmulatorSection({"bad": BAD})
    assert found.summary(found.documents) is None
    again = SECTIONS.get("emulators").again
    assert again(found.record(found.documents)) == EmulatorSection({"bad": BAD})
    for none in (None, [], {"bad": 3}):
        with pytest.raises(ValueError, match="no record"):
            again(none)
