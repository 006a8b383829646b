"""`calib export --ro-crate`: what is packed, and that roc-validator accepts it."""

from __future__ import annotations

import json
import shutil
import subprocess
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from calib.batch.environment import sha256
from calib.models import example_csv
from tests.commands import Calib, assert_refused, calib  # noqa: F401

ROOT = Path(__file__).parents[2]
VALIDATOR = ROOT / ".venv-crates" / "bin" / "python"
pytest.importorskip("rocrate")


@pytest.fixture(scope="module")
def _made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("made") / "run"


@pytest.fixture
def run(calib: Calib, _made: Path) -> Path:  # noqa: F811
    if not _made.exists():
        Path("ruts.csv").write_text(example_csv("bekker"), encoding="utf-8")
        assert calib("fit", "ruts.csv", "--model", "bekker", "--out", _made).code == 0
    return Path(shutil.copytree(_made, "run"))


PACK = ("--ro-crate", "--license", "CC-BY-4.0")


def entities(crate: Path) -> dict[str, dict[str, object]]:
    graph = json.loads((crate / "ro-crate-metadata.json").read_bytes())["@graph"]
    return {entity["@id"]: entity for entity in graph}


def test_every_file_is_described_and_the_folder_checks_from_the_crate(
    calib: Calib, run: Path  # noqa: F811
) -> None:  # fmt: skip
    authors = ("--author", "Ada Lovelace 0000-0002-1825-0097", "--author", "B. C.")
    ran = calib("export", run, *PACK, *authors, "--out", "crate", "--json")
    assert ran.code == 0, ran.err
    crate = Path("crate")
    found = entities(crate)
    packed = {p.relative_to(crate).as_posix() for p in crate.rglob("*") if p.is_file()}
    assert set(json.loads(ran.out)["files"]) == packed - {"ro-crate-metadata.json"}
    for name in packed - {"ro-crate-metadata.json"}:
        assert found[name]["sha256"] == sha256((crate / name).read_bytes())
    for path in run.iterdir():
        assert (crate / "run" / path.name).read_bytes() == path.read_bytes()
    root = found["./"]
    assert root["license"] == {"@id": "https://spdx.org/licenses/CC-BY-4.0"}
    named = [found[a["@id"]]["name"] for a in root["author"]]  # type: ignore[attr-defined]
    assert named == ["Ada Lovelace", "B. C."]
    assert "https://orcid.org/0000-0002-1825-0097" in found
    assert [part["@id"] for part in found["#made"]["object"]] == [  # type: ignore[attr-defined]
        "run/data.csv", "run/priors.toml",
    ]  # fmt: skip
    record = json.loads((run / "run.json").read_bytes())
    assert found["#calib"]["version"] == record["versions"]["terracalib"]
    pins = (crate / "constraints.txt").read_text(encoding="utf-8")
    assert f"numpy=={record['versions']['numpy']}\n" in pins
    assert "calib check run" in (crate / "README.md").read_text(encoding="utf-8")
    checked = calib("check", "crate/run", "--quick")
    assert (checked.code, "NOTHING DIFFERENT" in checked.out) == (0, True)


def test_a_zip_holds_the_same(calib: Calib, run: Path) -> None:  # noqa: F811
    assert calib("export", run, *PACK, "--out", "crate").code == 0
    assert calib("export", run, *PACK, "--out", "run.zip").code == 0
    with zipfile.ZipFile("run.zip") as packed:
        names = set(packed.namelist())
    assert names == {
        p.relative_to("crate").as_posix() for p in Path("crate").rglob("*") if p.is_file()
    }


def test_reconstructed_data_are_called_so(calib: Calib) -> None:  # noqa: F811
    assert calib("data", "he2019", "--out", ".").code == 0
    assert calib("fit", "rut_depth.csv", "--model", "bekker", "--out", "ruts").code == 0
    assert calib("export", "ruts", *PACK, "--out", "crate").code == 0
    assert "They are not measurements" in str(entities(Path("crate"))["./"]["description"])


def test_what_nobody_should_publish_is_refused(calib: Calib, run: Path) -> None:  # noqa: F811
    pack = ("export", run, "--ro-crate", "--out", "crate")
    assert_refused(calib(*pack), ["needs a licence", "--license", "CC-BY-4.0"])
    data = run / "data.csv"
    data.write_text(data.read_text(encoding="utf-8").replace("1", "2"), encoding="utf-8")
    assert_refused(calib(*pack, "--license", "MIT"), ["not as its record says", "calib check run"])
    assert not Path("crate").exists()
    Path("crate").mkdir()
    assert_refused(calib(*pack, "--license", "MIT"), ["it exists already"])


@pytest.mark.skipif(not VALIDATOR.exists(), reason="no roc-validator here: `make crates`")
@pytest.mark.parametrize("out", ["crate", pytest.param("run.zip", marks=pytest.mark.slow)])
def test_roc_validator_accepts_it(calib: Calib, run: Path, out: str) -> None:  # noqa: F811
    assert calib("export", run, *PACK, "--out", out).code == 0
    spec = find_spec("rocrate")
    assert spec is not None
    assert spec.origin is not None
    context = Path(spec.origin).with_name("data") / "ro-crate.jsonld"
    asked = [VALIDATOR, Path(__file__).with_name("roc_validate.py"), context]
    accepted = subprocess.run([*asked, out], capture_output=True, text=True, check=False)
    assert accepted.returncode == 0, accepted.stdout + accepted.stderr
    if out == "crate":  # it would say what is wrong
        path = Path(out, "ro-crate-metadata.json")
        path.write_text(path.read_text().replace('"license"', '"licence"'), encoding="utf-8")
        refused = subprocess.run([*asked, out], capture_output=True, text=True, check=False)
        assert refused.returncode == 1
        assert "license" in refused.stdout
