"""What a result says of where it was made."""

from __future__ import annotations

import getpass
import json
import platform
import re
from dataclasses import replace
from pathlib import Path

import pytest

import calib.batch.environment as environment_module
from calib.batch.environment import Environment


def test_it_says_what_decides_the_bits_and_nothing_of_whose_computer_it_is() -> None:
    here = Environment.here()
    document = here.document()
    assert set(document) == {"versions", "machine", "code"}
    assert {"python", "numpy", "matplotlib", "terracalib"} <= set(here.versions)
    assert here.machine["processor"] == platform.machine()
    assert here.machine["simd"]
    text = json.dumps(document)
    assert "/" not in text
    for private in (platform.node(), getpass.getuser()):
        assert not re.search(rf"\b{re.escape(private)}\b", text)
    assert re.fullmatch("[0-9a-f]{64}", here.code)
    assert json.loads(text) == document


def test_differences_are_named() -> None:
    here = Environment.here()
    there = replace(here, versions={**here.versions, "numpy": "1.0"}, code="0")
    assert here.differences(here) == {}
    assert there.differences(here) == {
        "numpy": ("1.0", here.versions["numpy"]), "code": ("0", here.code),
    }  # fmt: skip
    older = replace(here, machine={})
    assert older.differences(here)["simd"] == ("none", here.machine["simd"])


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({"versions": {"python": "3.99"}}, True),
        ({"versions": {"terracalib": "0.1.dev1"}}, True),  # the code's fingerprint says which it is
        ({"machine": {"simd": "none"}}, True),
        ({"versions": {"matplotlib": "0"}}, False),
        ({"versions": {"jinja2": "0"}}, False),
        ({"code": "0"}, False),
    ],
)
def test_the_processor_does_not_decide_how_equal_numbers_are_written(change, same: bool) -> None:
    here = Environment.here()
    merged = {
        key: {**getattr(here, key), **value} if isinstance(value, dict) else value
        for key, value in change.items()
    }
    assert replace(here, **merged).same_program(here) is same


def test_another_line_of_code_or_another_prior_is_another_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def code(text: bytes, prior: bytes = b"sd = 1\n", folder: str = "priors") -> str:
        package = tmp_path / folder.replace("/", "_") / "calib"
        (package / "sub").mkdir(parents=True, exist_ok=True)
        (package / "sub" / "module.py").write_bytes(text)
        (package / "notes.txt").write_bytes(text)
        effects = package.parent / folder / "effects"
        effects.mkdir(parents=True, exist_ok=True)
        (effects / "one.toml").write_bytes(prior)
        module = package / "batch" / "environment.py"
        monkeypatch.setattr(environment_module, "__file__", str(module))
        return environment_module.code_sha256.__wrapped__()

    one = code(b"x = 1\ny = 2\n")
    assert code(b"x = 1\r\ny = 2\r\n") == one
    assert code(b"x = 1\ny = 3\n") != one
    assert code(b"x = 1\ny = 2\n", b"sd = 2\n") != one
    # A wheel has the same priors inside.
    assert code(b"x = 1\ny = 2\n", folder="calib/_priors") == one
