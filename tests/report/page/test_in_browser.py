"""What pages do in a browser: tables sort, keys reach everything, faults are seen."""

from __future__ import annotations

import base64
from io import BytesIO
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from PIL import Image

from calib.report.figures.style import png_bytes
from calib.report.page.template import data_uri, template
from tests.browser import AXE, LAPTOP, PHONE, Browser, faults

BODY = """
<h1>Test</h1>
<nav><ul><li><a href="#last">To the last</a></li></ul></nav>
<table id="rows"><thead><tr><th scope="col">Name</th><th scope="col">Number</th></tr></thead>
<tbody><tr><td>b</td><td>below 1 %</td></tr><tr><td>a</td><td>1,200</td></tr>
<tr><td>d</td><td>8&times;10⁻¹¹</td></tr><tr><td>c</td><td>&minus;3 ± 0.1</td></tr>
<tr><td>e</td><td>&ndash;</td></tr></tbody></table>
<table id="headed"><thead><tr><th scope="col">Name</th><th scope="col">Size</th></tr></thead>
<tbody><tr><th scope="rowgroup" colspan="2">Above</th></tr>
<tr><td>b</td><td>1</td></tr><tr><td>a</td><td>2</td></tr></tbody>
<tbody><tr><th scope="rowgroup" colspan="2">Below</th></tr>
<tr><td>d</td><td>1</td></tr><tr><td>c</td><td>2</td></tr></tbody></table>
<table id="whole"><thead><tr><th scope="col">Name</th><th scope="col">Where</th></tr></thead>
<tbody><tr><td>b</td><td>1</td></tr><tr><td colspan="2">of b</td></tr></tbody>
<tbody><tr><td>a</td><td>2</td></tr><tr><td colspan="2">of a</td></tr></tbody></table>
<figure><div class="frame"><img alt="A pixel"
src="data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="></div></figure>
<p style="height: 200vh"></p><h2 id="last">Last</h2><p style="height: 200vh"></p>
"""
BAD = """
<div style="width: 2000px">wide</div><a href="#nowhere">lost</a><img src="data:," >
<p style="color: #777; background: #888">grey</p><script>console.error("broken")</script>
<img alt="outside" src="http://127.0.0.1:9/picture.png">
"""


def written(folder: Path, body: str) -> Path:
    page = folder / "page.html"
    html = template("base.html.j2").render(title="Test")
    page.write_text(html.replace("<body>", f"<body>{body}"), encoding="utf-8")
    return page


@pytest.fixture
def opened(browser: Browser, tmp_path: Path) -> Browser:
    browser.open(written(tmp_path, f"<main>{BODY}</main>"), PHONE)
    return browser


def cells(browser: Browser, table: str, column: int = 0) -> str:
    return browser.run(
        f"return [...document.querySelectorAll('#{table} tbody tr')]"
        f".map(r => (r.cells[{column}] ?? r.cells[0]).innerText).join(' ')"
    )


def click(browser: Browser, table: str, column: int = 0) -> str | None:
    """Click a head; return how the column says that it is sorted."""
    head = f"document.querySelectorAll('#{table} th[scope=col]')[{column}]"
    return browser.run(f"{head}.querySelector('button').click(); return {head}.ariaSort")


def test_a_click_sorts_up_down_and_back(opened: Browser) -> None:
    assert click(opened, "rows") == "ascending"
    assert cells(opened, "rows") == "a b c d e"
    assert click(opened, "rows") == "descending"
    assert cells(opened, "rows") == "e d c b a"
    assert click(opened, "rows") is None
    assert cells(opened, "rows") == "b a d c e"


def test_numbers_sort_as_numbers_and_what_is_none_comes_last(opened: Browser) -> None:
    click(opened, "rows", 1)
    assert cells(opened, "rows") == "c d b a e"
    click(opened, "rows", 1)
    assert cells(opened, "rows") == "a b d c e"
    assert click(opened, "rows", 0) == "ascending"
    assert opened.run("return document.querySelectorAll('#rows [aria-sort]').length") == 1


def test_headings_stay_and_bodies_move_whole(opened: Browser) -> None:
    click(opened, "headed")
    assert cells(opened, "headed") == "Above a b Below c d"
    click(opened, "whole")
    assert cells(opened, "whole") == "a of a b of b"


def test_keys_reach_links_heads_and_what_scrolls(opened: Browser) -> None:
    from selenium.webdriver.common.keys import Keys

    def press(key: str) -> tuple[str, bool]:
        opened.driver.switch_to.active_element.send_keys(key)
        return tuple(opened.run(
            "const e = document.activeElement; return [e.className || e.innerText,"
            " e.matches(':focus-visible') && getComputedStyle(e).outlineStyle !== 'none'];"
        ))  # fmt: skip

    reached = [press(Keys.TAB) for _ in range(8)]
    names = ("To the last", "Name", "Number", "Name", "Size", "Name", "Where", "frame")
    assert reached == [(name, True) for name in names]
    opened.run("document.querySelector('#rows button').focus()")
    press(Keys.ENTER)
    assert cells(opened, "rows") == "a b c d e"


@pytest.mark.parametrize("dark", [False, True])
def test_a_shadow_says_that_there_is_more_on_the_right(
    browser: Browser, tmp_path: Path, dark: bool
) -> None:
    wide = '<div class="scroll"><p style="width: 50rem; height: 9rem"></p></div>'
    browser.open(written(tmp_path, wide), PHONE, dark=dark)

    def shaded() -> tuple[bool, bool]:
        """Whether the left and the right edge differ from the middle."""
        box = browser.run("return document.querySelector('.scroll').getBoundingClientRect()")
        seen = Image.open(BytesIO(base64.b64decode(browser.do("Page.captureScreenshot")["data"])))
        y = box["top"] + box["height"] / 2
        left, middle, right = (
            seen.getpixel((int(x), int(y)))
            for x in (box["left"] + 1, box["left"] + box["width"] / 2, box["right"] - 2)
        )
        return left != middle, right != middle

    assert shaded() == (False, True)
    browser.run("document.querySelector('.scroll').scrollLeft = 9999")
    assert shaded() == (True, False)


@pytest.mark.parametrize("width", [700, 1000, LAPTOP])
def test_what_is_said_of_points_lies_over_the_picture(
    browser: Browser, tmp_path: Path, width: int
) -> None:
    shown = {"uri": data_uri(png_bytes(Figure(figsize=(8, 3)))), "size": (2400, 900)}
    made = template("macros.html.j2").module.frame(
        {**shown, "narrow": "", "points": [(0, 0, "")]}, ""
    )
    browser.open(written(tmp_path, f"<figure>{made}</figure>"), width)
    place = "return document.querySelector('figure {}').getBoundingClientRect().toJSON()"
    assert browser.run(place.format("img")) == browser.run(place.format("svg"))


def test_contents_lead_where_they_say(opened: Browser) -> None:
    opened.run("document.querySelector('nav a').click()")
    top = opened.run("return document.getElementById('last').getBoundingClientRect().top")
    assert 0 <= top < 60


def test_faults_are_seen(browser: Browser, tmp_path: Path) -> None:
    found = "\n".join(faults(browser, written(tmp_path, BAD)))
    for what in (
        '390 px dark: too wide: DIV  "wide"', "1280 px: too wide: the page", "broken",
        "no such place: #nowhere", "image: data:,", "asked for http://127.0.0.1:9/picture.png",
    ):  # fmt: skip
        assert what in found


@pytest.mark.skipif(not AXE.exists(), reason="no axe-core here: `make browser`")
def test_what_some_cannot_read_is_seen(browser: Browser, tmp_path: Path) -> None:
    found = "\n".join(faults(browser, written(tmp_path, BAD)))
    assert "1280 px: serious color-contrast" in found
    assert "critical image-alt" in found


def test_what_is_too_large_or_not_dark_is_seen(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text(f"<body style='background: white; color: black'>{' ' * 5_000_001}</body>")
    assert {"5.0 MB", "390 px dark: not dark"} <= set(faults(browser, page))
