"""A quick wheel for the tests: pull from slip and load, in Python and as a program."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import numpy as np

from calib.models.simulators.simulator import Output, Runner, Simulator

PRIORS = """
[parameters.mu]
dist = "lognormal"
median = 0.5
sd_log = 0.4
unit = "1"
reason = "Friction of mineral soils"
source = "Wong (2008)"

[parameters.s0]
dist = "lognormal"
median = 0.1
sd_log = 0.8
unit = "1"
reason = "Full thrust within 5 to 30 % slip"
source = "Wong (2008)"

[parameters.sigma]
dist = "half_normal"
sd = 0.2
unit = "kN"
reason = "Readings of a load cell"
source = "Assumed"
"""

PROGRAM = """
import json, math, sys, time
given = json.load(open(sys.argv[1]))
p, x = given["parameters"], given["conditions"]
{extra}
pull = [1000 * w * p["mu"] * (1 - math.exp(-s / 100 / p["s0"])) for s, w in zip(x["s"], x["w"])]
json.dump({{"pull": pull}}, open(sys.argv[2], "w"))
"""


def pull(theta: np.ndarray, x: dict[str, np.ndarray]) -> np.ndarray:
    """Return the pull (kN), shape (k, n)."""
    return theta[:, :1] * x["normal_load_kn"] * (1.0 - np.exp(-x["slip_ratio"] / theta[:, 1:2]))


X = {"slip_ratio": np.array([0.1, 0.3]), "normal_load_kn": np.array([4.0, 5.0])}
THETA = np.array([0.6, 0.08])
EXACT = pull(THETA[None], X)[0]


def simulator(runner: Runner, **changes: object) -> Simulator:
    """Return a wheel that takes percent and gives newtons."""
    given = {
        "name": "wheel", "runner": runner, "parameters": ("mu", "s0"), "priors": "",
        "conditions": {"s": "slip_percent", "w": "normal_load_kn"},
        "outputs": (Output("drawbar_pull_n", "pull", ""),), "retries": 0,
    } | changes  # fmt: skip
    return Simulator(**given)  # type: ignore[arg-type]


def in_percent(theta: np.ndarray, x: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the pull as that wheel does."""
    own = {"slip_ratio": x["s"] / 100.0, "normal_load_kn": x["w"]}
    return {"pull": 1000.0 * pull(theta, own)}


def lab(rng: np.random.Generator, noise: float = 0.03) -> dict[str, np.ndarray]:
    """Return columns of a campaign."""
    slip, load = np.meshgrid([0.02, 0.05, 0.1, 0.2, 0.4, 0.6], [3.0, 4.0, 5.0], indexing="ij")
    x = {"slip_ratio": slip.ravel(), "normal_load_kn": load.ravel()}
    y = pull(np.array([[0.6, 0.08]]), x)[0]
    return x | {"drawbar_pull_kn": y + noise * rng.standard_normal(y.size)}


def write_program(folder: Path, *, extra: str = "", **keys: str) -> Path:
    """Write the program and its simulator file; return the file."""
    (folder / "wheel.py").write_text(PROGRAM.format(extra=extra))
    lines = {"name": '"wheel"', "run": f'"{sys.executable} wheel.py {{input}} {{output}}"'} | keys
    text = "\n".join(f"{key} = {value}" for key, value in lines.items() if value)
    text += '\n[conditions]\ns = "slip_percent"\nw = "normal_load_kn"\n'
    text += '[outputs]\npull = "drawbar_pull_n"\n' + PRIORS
    (folder / "wheel.toml").write_text(text)
    return folder / "wheel.toml"


class _Handler(BaseHTTPRequestHandler):
    """An UM-Bridge server in a few lines, with a mood that the model's name sets."""

    def do_POST(self) -> None:
        given = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        mood = given["name"]
        if mood == "slow":
            time.sleep(1.0)  # twice what it is given
        replies: dict[str, object] = {
            "nan": {"output": [[float("nan")]]},
            "error": {"error": {"message": "no soil"}},
            "more": {"output": [[1.0], [1.0]]},
            "number": {"output": [1.0]},
            "bool": {"output": [[True]]},
            "pair": {"output": [[1.0, 2.0]]},
        }
        body = json.dumps(replies.get(mood, {"output": [[1.0]]})).encode()
        self.send_response(500 if mood == "broken" else 200)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args: object) -> None:
        """Print nothing."""


@contextmanager
def serving() -> Iterator[str]:
    """Serve on this machine; yield the address."""
    server = HTTPServer(("127.0.0.1", 0), _Handler)
    # Looks often whether it is to stop: half a second by default.
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
