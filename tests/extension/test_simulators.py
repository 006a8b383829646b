"""A simulator of a user's own, from file to verdict: slow, fallible, in another language."""

from __future__ import annotations

import csv
import json
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.batch.folders import check_folder
from calib.gap.case import Case
from calib.models import MODELS
from calib.models.simulators.declaration import SIMULATED
from calib.models.simulators.files import read_simulator
from calib.models.simulators.simulator import Failure
from tests.commands import Calib
from tests.models.simulators.examples import PRIORS, lab, pull, write_program
from tests.registered import forgotten

FEW = ["--max-steps", 400]


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    """Forget what a test registers."""
    with forgotten(MODELS, SIMULATED):
        yield


def write_table(path: str, columns: dict[str, np.ndarray]) -> None:
    with Path(path).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(v.tolist() for v in columns.values()), strict=True))


def field(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return a campaign whose recorded slip is 0.03 too large: another rolling radius."""
    columns = lab(rng, 0.0)
    true = columns | {"slip_ratio": 1.0 - (1.0 - columns["slip_ratio"]) / 0.97}
    y = pull(np.array([[0.6, 0.08]]), true)[0] + 0.03 * rng.standard_normal(18)
    return columns | {"drawbar_pull_kn": y}


def closed_form() -> str:
    """Register the closed form itself; return the name of its model."""
    name = f"closed_{len(MODELS)}"
    calib.register(
        calib.from_callable(
            pull,
            parameters=PRIORS,
            conditions=["slip_ratio", "normal_load_kn"],
            output="drawbar_pull_kn",
            name=name,
        )
    )
    return name


def exact(path: str) -> calib.Calibration:
    """Return the posterior of the closed form itself."""
    problem = calib.build_problem(closed_form(), calib.read_table(path))
    return calib.calibrate(problem, seed=2019)


def same_posterior(run: str, truth: calib.Calibration) -> None:
    found = calib.load_calibration(Path(run))
    for name, s in truth.summary.items():
        e = found.summary[name]
        assert abs(e.mean - s.mean) < 0.05 * s.sd + 3.0 * (e.mcse_mean + s.mcse_mean), name
        assert abs(e.sd / s.sd - 1.0) < 0.1, name


@pytest.mark.slow
def test_a_slow_command_that_fails_now_and_then_gives_the_same(run: Calib) -> None:
    # A delay, and one run in twenty that dies whatever the parameters.
    trouble = (
        "import random; time.sleep(0.02)\nif random.random() < 0.05: print('lost licence'); "
        "sys.exit(3)"
    )
    own = ["--simulator", write_program(Path.cwd(), extra=trouble, retries="3")]
    write_table("lab.csv", lab(np.random.default_rng(1)))
    write_table("field.csv", field(np.random.default_rng(2)))
    fitted = run("fit", "lab.csv", "--model", "wheel", *own, "--out", "run", "--workers", 1, *FEW)
    assert fitted.code == 0, fitted.err
    assert "wheel: emulated from" in fitted.out
    check_folder(Path("run"), overwrite=True)
    same_posterior("run", exact("lab.csv"))
    made = len(list(Path("wheel.runs").rglob("*-[01].json")))
    assert made <= 100
    predicted = run("predict", "run", "--at", "field.csv", *own)
    assert predicted.code == 0, predicted.err
    write_table(
        "far.csv", {"slip_ratio": np.array([0.2, 0.2]), "normal_load_kn": np.array([4.0, 1e3])}
    )
    far = run("predict", "run", "--at", "far.csv", *own)
    assert "no value (nan) at 1 of 2 rows; an emulator ends where its runs do" in far.err
    # Nothing is run to check: the emulator is in the folder.
    checked = run("check", "run", *own, "--workers", 1)
    assert checked.code == 0, checked.out
    found = run("diagnose", "--run", "run", "--field", "field.csv", *own, "--out", "gap",
                "--workers", 1)  # fmt: skip
    assert found.code == 0, found.err
    assert len(list(Path("wheel.runs").rglob("*-[01].json"))) <= made + 100
    corrected = run("predict", "gap", "--at", "field.csv", *own)
    assert corrected.code == 0, corrected.err
    # As the closed form is diagnosed.
    case = Case(
        "case", calib.read_table("lab.csv"), calib.read_table("field.csv"),
        {"drawbar_pull": closed_form()},
    )  # fmt: skip
    truth = calib.diagnose(case).ranking
    told = {line.split()[1]: line.split()[0] for line in found.out.splitlines()[2:6]}
    assert next(iter(told)) == truth.order[0]
    assert abs(float(told[truth.order[0]].lstrip("<>")) - truth.probability[truth.order[0]]) < 0.2
    assert "could not be drawn" not in Path("gap/index.html").read_text()


@pytest.mark.slow
def test_a_report_and_its_check(run: Calib) -> None:
    own = ["--simulator", write_program(Path.cwd())]
    write_table("lab.csv", lab(np.random.default_rng(1)))
    made = run("report", "lab.csv", "--model", "wheel", *own, "--out", "report", "--workers", 1,
               *FEW)  # fmt: skip
    assert made.code == 0, made.err
    assert json.loads(Path("report/summary.json").read_text())["models"]["drawbar_pull"]
    page = Path("report/index.html").read_text()
    assert "Emulators of slow simulators" in page
    record = json.loads(Path("report/manifest.json").read_text())["emulators"]["wheel"]
    check_folder(Path("report"), overwrite=True)
    assert record["passed"]
    assert record["held_out"]["runs"] == 20
    checked = run("check", "report", *own, "--workers", 1)
    assert checked.code == 0, checked.out
    assert checked.out.startswith("SAME")


@pytest.mark.slow
def test_simulators_are_compared(run: Calib) -> None:
    """Two that say the same of other parameters cannot be told apart."""
    own: list[object] = []
    for name, extra in (("wheel", ""), ("twin", "p['s0'] *= 2")):
        Path(name).mkdir()
        own += ["--simulator", write_program(Path(name), name=f'"{name}"', extra=extra)]
    write_table("lab.csv", lab(np.random.default_rng(1)))
    made = run("compare", "wheel", "twin", "lab.csv", *own, "--out", "c", "--workers", 1, *FEW)
    assert made.code == 0, made.err
    assert "twin: emulated from" in made.out
    assert "The data cannot tell" in made.out
    checked = run("check", "c", *own, "--workers", 1)
    assert checked.code == 0, checked.out
    told = run("predict", "c", "--at", "lab.csv", *own, "--out", "bands.csv")
    assert told.code == 0, told.err


def test_a_data_folder_runs_no_command(run: Calib) -> None:
    Path("case").mkdir()
    write_program(Path("case"), extra="open('/dev/null'); open('ran', 'w')")
    write_table("case/lab.csv", lab(np.random.default_rng(1)))
    write_table("case/field.csv", field(np.random.default_rng(2)))
    Path("case/case.toml").write_text(
        'calibration = "lab.csv"\nfield = "field.csv"\n[models]\ndrawbar_pull = "wheel"\n'
    )
    refused = run("diagnose", "case", "--out", "gap", "--workers", 1)
    assert refused.code == 2
    assert "there is no model 'wheel'" in refused.err
    assert not (Path("case") / "wheel.runs").exists()


C_PROGRAM = r"""
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
/* reads: mu s0 n, then n rows of slip and load; writes the pull as CSV */
int main(int argc, char **argv) {
  double mu, s0, s[512], w[512]; char line[256]; int n = 0;
  FILE *in = argc > 2 ? fopen(argv[1], "r") : NULL, *out;
  if (!in) { fprintf(stderr, "no input\n"); return 2; }
  if (!fgets(line, sizeof line, in)) return 3;
  while (n < 512 && fscanf(in, "%lf,%lf,%lf,%lf", &mu, &s0, &s[n], &w[n]) == 4) n++;
  fclose(in);
  if (!(out = fopen(argv[2], "w"))) return 4;
  fprintf(out, "row,pull\n");
  for (int i = 0; i < n; i++)
    fprintf(out, "%d,%.12g\n", i, 1000 * w[i] * mu * (1 - exp(-s[i] / 100 / s0)));
  fclose(out);
  return n ? 0 : 5;
}
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler (cc)")
def test_a_compiled_program_from_file_to_verdict(run: Calib) -> None:
    Path("wheel.c").write_text(C_PROGRAM)
    subprocess.run(["cc", "-O2", "-o", "wheel", "wheel.c", "-lm"], check=True)
    file = write_program(
        Path.cwd(), run='"./wheel {input} {output}"', input='"csv"', output='"csv"'
    )
    own = ["--simulator", file]
    write_table("lab.csv", lab(np.random.default_rng(3)))
    write_table("field.csv", field(np.random.default_rng(4)))
    fitted = run("fit", "lab.csv", "--model", "wheel", *own, "--out", "run", "--workers", 1, *FEW)
    assert fitted.code == 0, fitted.err
    check_folder(Path("run"), overwrite=True)
    same_posterior("run", exact("lab.csv"))
    found = run("diagnose", "--run", "run", "--field", "field.csv", *own, "--out", "gap",
                "--workers", 1)  # fmt: skip
    assert found.code == 0, found.err
    assert "slip_zero_shift" in found.out.splitlines()[2]


SERVER = """
import math
import umbridge

class Wheel(umbridge.Model):
    def __init__(self): super().__init__("forward")
    def get_input_sizes(self, config): return [2]
    def get_output_sizes(self, config): return [len(config.get("s", [0]))]
    def supports_evaluate(self): return True
    def __call__(self, parameters, config):
        (mu, s0), = parameters
        rows = zip(config["s"], config["w"])
        return [[1000 * w * mu * (1 - math.exp(-s / 100 / s0)) for s, w in rows]]

umbridge.serve_models([Wheel()], PORT)
"""


@pytest.mark.slow
def test_a_model_behind_a_server(run: Calib) -> None:
    pytest.importorskip("umbridge", reason="there is no umbridge to serve a model with")
    port = _free_port()
    Path("server.py").write_text(SERVER.replace("PORT", str(port)))
    server = subprocess.Popen(
        [sys.executable, "server.py"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        _wait_for(f"http://127.0.0.1:{port}/Info", server)
        file = write_program(
            Path.cwd(), run="", url=f'"http://127.0.0.1:{port}"', model='"forward"', limit="20"
        )
        write_table("lab.csv", lab(np.random.default_rng(5)))
        fitted = run("fit", "lab.csv", "--model", "wheel", "--simulator", file, "--out", "run",
                     "--workers", 1, *FEW)  # fmt: skip
    finally:
        server.kill()
        server.wait()
    assert fitted.code == 0, fitted.err
    check_folder(Path("run"), overwrite=True)
    same_posterior("run", exact("lab.csv"))
    # With the server gone the message says so, and the runs that were made are kept.
    kept = len(list(Path("wheel.runs").rglob("*-0.json")))
    write_table("lab.csv", {k: v[:12] for k, v in lab(np.random.default_rng(5)).items()})
    refused = run("fit", "lab.csv", "--model", "wheel", "--simulator", file, "--out", "run2",
                  "--workers", 1)  # fmt: skip
    assert refused.code == 2
    assert "is not there" in refused.err
    assert len(list(Path("wheel.runs").rglob("*-0.json"))) == kept


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _wait_for(url: str, server: subprocess.Popen[bytes]) -> None:
    for _ in range(200):
        assert server.poll() is None, "the server has ended"
        try:
            urllib.request.urlopen(url, timeout=1.0).close()
        except OSError:
            time.sleep(0.1)
        else:
            return
    raise AssertionError("the server does not answer")


EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "chrono_scm"
# Stands for the rig: it reads the soil by the names of SetSoilParameters.
PROGRAM = """#!{python}
import csv
import sys
rows = list(csv.DictReader(open(sys.argv[1])))
print("pull,torque,sinkage")
for row in rows:
    load, slip, friction, kphi = (float(row[k]) for k in ("load", "slip", "friction", "Kphi"))
    print(load * slip * friction / 30, 0, load / kphi, sep=",")
"""


def test_chronos_parameters_have_its_order_and_units(tmp_path: Path) -> None:
    (tmp_path / "scm").mkdir()
    shutil.copy(EXAMPLE / "scm.toml", tmp_path / "scm")
    program = tmp_path / "scm" / "chrono_wheel"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    simulator = read_simulator(tmp_path / "scm" / "scm.toml").simulator
    assert simulator.parameters == ("Kphi", "Kc", "n", "cohesion", "friction", "janosi")
    theta = np.array([2e6, 0.0, 1.1, 100.0, 30.0, 0.01])
    x = {"slip_ratio": np.array([0.1, 0.2]), "normal_load_kn": np.array([4.0, 5.0])}
    found = simulator.run(theta, x)
    assert not isinstance(found, Failure), found
    np.testing.assert_allclose(found["drawbar_pull_kn"], [0.4, 1.0])
    np.testing.assert_allclose(found["rut_depth_mm"], [2.0, 2.5])
