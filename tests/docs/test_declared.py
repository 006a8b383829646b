"""Pages made from declarations, without building the documentation."""

from __future__ import annotations

import importlib
import re

import pytest

from calib.gap.effects import EFFECTS
from tests.docs.pages import DOCS


def test_the_page_of_every_effect_shows_what_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    declared = importlib.import_module("declared_effects")
    pictures, pages = declared.pictures(), declared.pages()
    assert set(pages) == set(EFFECTS)
    for name, page in pages.items():
        alt, file = re.findall(r"!\[(.+)\]\((.+\.png)\)", page)[0]
        assert file in pictures
        drawn = sum(f"{o} over" in alt for o in ("drawbar pull", "rut depth", "density"))
        assert drawn == len(EFFECTS[name].outputs)
    assert pictures[file]().startswith(b"\x89PNG")
