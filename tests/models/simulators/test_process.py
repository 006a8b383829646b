"""Programs are run without a shell, and end with what they started."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

from calib.errors import CalibError
from calib.models.simulators.base import Failure
from calib.models.simulators.process import run_program


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def test_what_it_prints_comes_back(tmp_path: Path) -> None:
    assert run_program(python("print('pull', 3)"), tmp_path, 20.0) == "pull 3\n"


def test_no_shell_reads_its_arguments(tmp_path: Path) -> None:
    code = "import sys; print(sys.argv[1])"
    found = run_program([*python(code), "$(touch made); `touch made` > made"], tmp_path, 20.0)
    assert found == "$(touch made); `touch made` > made\n"
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("code", "kind", "word"),
    [
        ("import sys; print('no soil'); sys.exit(4)", "exit", "exit code 4"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "exit", "SIGSEGV"),
    ],
)
def test_a_failure_has_its_reason(tmp_path: Path, code: str, kind: str, word: str) -> None:
    found = run_program(python(code), tmp_path, 20.0)
    assert isinstance(found, Failure)
    assert (found.kind, word in found.reason) == (kind, True)


def test_the_tail_of_what_it_printed_is_kept(tmp_path: Path) -> None:
    found = run_program(
        python("print('x' * 9000, 'diverged'); raise SystemExit(1)"), tmp_path, 20.0
    )
    assert isinstance(found, Failure)
    assert found.printed.endswith("diverged\n")
    assert len(found.printed) < 700


def test_what_would_steer_a_terminal_is_left_out(tmp_path: Path) -> None:
    code = "import sys; sys.stdout.buffer.write(b'\\x1b[31mred\\x00\\xff\\n'); sys.exit(1)"
    found = run_program(python(code), tmp_path, 20.0)
    assert isinstance(found, Failure)
    assert found.printed == "\ufffd[31mred\ufffd\ufffd\n"


def test_a_program_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CalibError, match="no-such-wheel cannot be started"):
        run_program(["no-such-wheel"], tmp_path, 1.0)


@pytest.mark.skipif(sys.platform == "win32", reason="process groups are POSIX's")
@pytest.mark.parametrize("ending", ["time.sleep(60)", "pass"])
def test_children_end_with_it(tmp_path: Path, ending: str) -> None:
    code = (
        "import subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "open('pid', 'w').write(str(child.pid))\n" + ending
    )
    found = run_program(python(code), tmp_path, 20.0 if ending == "pass" else 1.0)
    assert isinstance(found, Failure) is (ending != "pass")
    pid = int((tmp_path / "pid").read_text())
    assert _ends(pid)


@pytest.mark.skipif(sys.platform != "linux", reason="where processes are listed in /proc")
@pytest.mark.parametrize("ending", ["time.sleep(60)", "pass"])
def test_so_do_those_that_left_its_group(tmp_path: Path, ending: str) -> None:
    code = (
        "import os, time\n"
        "if os.fork() == 0:\n"
        "    os.setsid()\n"
        "    open('pid.part', 'w').write(str(os.getpid()))\n"
        "    os.rename('pid.part', 'pid')\n"
        "    time.sleep(60)\n"
        "while not os.path.exists('pid'): time.sleep(0.01)\n" + ending
    )
    run_program(python(code), tmp_path, 20.0 if ending == "pass" else 1.0)
    assert _ends(int((tmp_path / "pid").read_text()))


def test_what_the_kernel_cannot_end_is_not_waited_for_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such a process stays listed, whatever it is sent; here one that is gone is said to be."""
    asked = []

    def there(mark: str) -> list[int]:
        asked.append(mark)
        return [2**22 + 1]  # beyond the largest id of a process

    monkeypatch.setattr("calib.models.simulators.process._marked", there)
    monkeypatch.setattr("calib.models.simulators.process._GIVE_UP", 0.2)
    assert run_program(python("print('done')"), tmp_path, 20.0) == "done\n"
    assert len(asked) > 1


def test_the_end_alone_is_read_if_asked_for(tmp_path: Path) -> None:
    found = run_program(python("print('x' * 9_000_000, 'done')"), tmp_path, 20.0, whole=False)
    assert isinstance(found, str)
    assert found.endswith("x done\n")
    assert len(found) < 5000


def _ends(pid: int) -> bool:
    """Whether a process is gone, or dead and not yet collected, within some seconds."""
    for _ in range(100):
        try:
            os.kill(pid, 0)
            state = Path(f"/proc/{pid}/stat")
            if state.exists() and state.read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False
