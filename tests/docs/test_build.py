"""The documentation builds without a warning, asks for nothing outside, has all declarations."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path

import pytest

from calib.data.quantities import QUANTITIES
from calib.gap.effects import EFFECTS
from calib.models import MODELS
from tests.browser import Browser, faults
from tests.docs.pages import DOCS, ROOT

NEEDED = ("sphinx", "myst_nb", "ipykernel", "furo")
ABSENT = [name for name in NEEDED if find_spec(name) is None]
pytestmark = pytest.mark.skipif(
    bool(ABSENT), reason=f"{', '.join(ABSENT)} not installed: pip install -e '.[docs]'"
)
# What a browser fetches by itself.
FETCHED = {
    "script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src",
    "object": "data", "embed": "src", "video": "src", "audio": "src", "input": "src",
}  # fmt: skip


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a copy: what is made from the declarations is not written among the sources."""
    root = tmp_path_factory.mktemp("checkout")
    ignored = shutil.ignore_patterns("declared", "__pycache__")
    shutil.copytree(DOCS, root / "docs", ignore=ignored)
    for beside in ("calib", "tests", "reports"):
        (root / beside).symlink_to(ROOT / beside)
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html",
         "-d", root / "trees", root / "docs", root / "out"],
        capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return root / "out"


class Page(HTMLParser):
    """What a page fetches, and the texts of its images."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.alt: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if FETCHED.get(tag) in found:
            self.fetched.append(found[FETCHED[tag]] or "")
        if tag == "img":
            self.alt.append(found.get("alt") or "")


def outside(address: str) -> bool:
    return bool(re.match(r"[a-z][a-z+.-]*:|//", address, flags=re.I)) and not address.startswith(
        "data:"
    )


@pytest.mark.slow  # `make docs` builds them with warnings as errors
def test_no_page_asks_for_anything_outside(built: Path) -> None:
    pages = list(built.rglob("*.html"))
    assert len(pages) > len(MODELS) + len(EFFECTS) + len(QUANTITIES)
    for path in pages:
        page = Page(path.read_text(encoding="utf-8"))
        assert [address for address in page.fetched if outside(address)] == [], path
        assert all(page.alt), path
    for path in built.rglob("*.css"):
        text = path.read_text(encoding="utf-8")
        fetched = re.findall(r"url\(\s*['\"]?([^'\")]+)|@import\s+['\"]([^'\"]+)", text)
        assert [a + b for a, b in fetched if outside(a + b)] == [], path


@pytest.mark.slow  # `make docs` builds them with warnings as errors
def test_pages_hold_in_a_browser(built: Path, browser: Browser) -> None:
    for page in ("index", "formats/inputs", "declared/quantities/index"):
        assert faults(browser, built / f"{page}.html") == [], page


@pytest.mark.slow
def test_all_pages_hold_in_a_browser(built: Path, browser: Browser) -> None:
    for page in built.rglob("*.html"):
        assert faults(browser, page) == [], page


def test_what_is_outside_is_seen() -> None:
    page = Page(
        '<script src="https://cdn.example/x.js"></script><a href="https://doi.org">d</a>'
        '<link rel="stylesheet" href="//fonts.example/a.css"><img src="a.png" alt="A">'
    )
    assert [outside(a) for a in page.fetched] == [True, True, False]
    assert page.alt == ["A"]


@pytest.mark.slow  # `make docs` builds them with warnings as errors
def test_every_declaration_has_its_page(built: Path) -> None:
    for folder, declared in (("models", MODELS), ("effects", EFFECTS), ("quantities", QUANTITIES)):
        pages = {path.stem for path in (built / "declared" / folder).glob("*.html")}
        assert pages == {*declared, "index"}
    for model in MODELS.values():
        text = (built / "declared" / "models" / f"{model.name}.html").read_text(encoding="utf-8")
        assert "<math" in text
        assert all(name in text for name in (*model.parameters, "sigma", *model.conditions))


@pytest.mark.slow  # `make docs` builds them with warnings as errors
def test_the_schemas_can_be_downloaded(built: Path) -> None:
    found = {path.name: json.loads(path.read_text()) for path in built.rglob("_downloads/*/*.json")}
    inputs = {"priors", "plan", "simulator", "case"}
    results = {"manifest", "run", "comparison", "summary", "diagnosis", "sbc", "check", "campaign"}
    assert set(found) == {f"{name}.json" for name in inputs | results}
    assert {"model", "likelihood", "parameters"} == set(found["priors.json"]["properties"])
    assert {"fit", "diagnose"} < set(found["plan.json"]["properties"])
