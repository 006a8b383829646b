"""Every public function has an example, and examples give what they print."""

from __future__ import annotations

import doctest
import inspect

import pytest

import calib
from calib.shown import Shown

FUNCTIONS = [name for name in calib.__all__ if inspect.isfunction(getattr(calib, name))]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_has_an_example_that_runs(name):
    run_examples(getattr(calib, name), name)


@pytest.mark.parametrize("name", ["to_dataframe", "plot"])
def test_a_result_has_them_too(name):
    run_examples(getattr(Shown, name), name)


def run_examples(function, name):
    found = doctest.DocTestFinder(recurse=False).find(inspect.unwrap(function), name, globs={})
    examples = [example for test in found for example in test.examples]
    assert examples, "it has no example"
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    said: list[str] = []
    for test in found:
        runner.run(test, out=said.append)
    assert not runner.failures, "".join(said)
