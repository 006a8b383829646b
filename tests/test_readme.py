"""The README's Python block runs as it is printed."""

import json
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.commands import calib as run  # noqa: F401
from tests.extension.test_simulators import as_before, field, write_table  # noqa: F401
from tests.models.simulators.examples import lab

README = Path(__file__).resolve().parents[1] / "README.md"


def test_python_block_runs_as_printed(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.S)
    assert len(blocks) == 1
    names = {}
    exec(compile(blocks[0], "README.md", "exec"), names)
    assert names["bands"].median.shape == (14,)
    assert "D_lo" in capsys.readouterr().out


WHEEL = """#!{python}
import json, math, sys
given = json.load(open(sys.argv[1]))
p, x = given["parameters"], given["conditions"]
rows = zip(x["slip"], x["load"])
pull = [1000 * w * p["mu"] * (1 - math.exp(-s / p["s0"])) for s, w in rows]
json.dump({{"pull": pull}}, open(sys.argv[2], "w"))
"""


@pytest.mark.parametrize(
    "lines", [1, pytest.param(2, marks=pytest.mark.slow)], ids=["fit", "fit and diagnose"]
)
@pytest.mark.skipif(os.name != "posix", reason="the program is a script with a first line")
def test_a_simulator_from_file_to_verdict_as_printed(run, lines):  # noqa: F811
    section = README.read_text(encoding="utf-8").split("## Your own simulator")[1]
    (file,) = re.findall(r"```toml\n(.*?)```", section, flags=re.S)[:1]
    commands = re.findall(r"```console\n(.*?)```", section, flags=re.S)[0].splitlines()
    assert len(file.splitlines()) + len(commands) < 15
    Path("wheel.toml").write_text(file)
    Path("wheel").write_text(WHEEL.format(python=sys.executable))
    Path("wheel").chmod(0o755)
    write_table("lab.csv", lab(np.random.default_rng(3)))
    write_table("field.csv", field(np.random.default_rng(4)))
    for command in commands[:lines]:
        done = run(*command.split()[1:])
        assert done.code == 0, done.err
    assert len(list(Path("wheel.runs").rglob("*-[01].json"))) < 100 * lines
    if lines == 2:
        assert "slip_zero_shift" in done.out.splitlines()[2]
    else:
        assert json.loads(Path("run/run.json").read_text())["gate"]["passed"]
