"""Pages in a real browser: Chromium without a window, driven by Selenium; axe-core looks on.

`make browser` installs both. Without Chromium the tests are skipped and say so; without axe-core
they are done without its findings, and the test that it finds something is skipped.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

AXE = Path(__file__).parent.parent / "node_modules" / "axe-core" / "axe.min.js"
PHONE, LAPTOP = 390, 1280
# Between the margins of an A4 page, at 96 dots per inch.
PRINT = 703
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip

# What makes the page wider than what it is shown on; what scrolls in a frame of its own does not.
_TOO_WIDE = """
const edge = document.documentElement.clientWidth;
if (document.documentElement.scrollWidth <= edge) return [];
const framed = e => e !== document.body
  && (getComputedStyle(e).overflowX !== 'visible' || framed(e.parentElement));
return ['the page', ...[...document.querySelectorAll('body *')]
  .filter(e => e.getBoundingClientRect().right > edge + 1 && !framed(e.parentElement))
  .map(e => `${e.tagName} ${e.className} "${e.textContent.trim().slice(0, 40)}"`).slice(0, 5)];
"""
_DEAD_LINKS = """
return [...document.querySelectorAll('a[href^="#"]')].map(a => a.getAttribute('href').slice(1))
  .filter(id => id && !document.getElementById(decodeURIComponent(id)));
"""
_BAD_IMAGES = """
return [...document.images].filter(i => !i.alt.trim() || !i.complete || !i.naturalWidth)
  .map(i => i.alt || i.src.slice(0, 60));
"""
_SERIOUS = """
const done = arguments[arguments.length - 1];
axe.run({preload: false}).then(r => done(r.violations
  .filter(v => ['serious', 'critical'].includes(v.impact))
  .map(v => `${v.impact} ${v.id}: ${v.nodes.length} of ${v.nodes[0].html.slice(0, 160)}`)));
"""


@dataclass(frozen=True)
class Browser:
    """A browser and what is asked of it."""

    driver: Any

    def open(self, page: Path, width: int = LAPTOP, *, dark: bool = False, media: str = "") -> None:
        """Open a page as wide as a device; ``media`` is "print" for paper."""
        self.do("Emulation.setDeviceMetricsOverride", width=width, height=844,
                deviceScaleFactor=1, mobile=width == PHONE)  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        still = {"name": "prefers-reduced-motion", "value": "reduce"}
        self.do("Emulation.setEmulatedMedia", media=media, features=[scheme, still])
        self.driver.get(page.resolve().as_uri())

    def do(self, command: str, **arguments: Any) -> Any:
        """Give a command of the DevTools."""
        return self.driver.execute_cdp_cmd(command, arguments)

    def run(self, script: str, *arguments: Any) -> Any:
        """Run JavaScript in the page; return what it returns."""
        return self.driver.execute_script(script, *arguments)

    def asked(self) -> set[str]:
        """Return the addresses asked for since the last call."""
        events = (json.loads(e["message"])["message"] for e in self.driver.get_log("performance"))
        return {e["params"]["request"]["url"] for e in events
                if e["method"] == "Network.requestWillBeSent"}  # fmt: skip

    def complaints(self) -> list[str]:
        """Return what the console said since the last call."""
        return [e["message"] for e in self.driver.get_log("browser") if e["level"] != "INFO"]

    def serious(self) -> list[str]:
        """Return what axe-core finds serious or critical; nothing where it is not installed."""
        if not AXE.exists():
            return []
        self.run(AXE.read_text(encoding="utf-8"))
        return self.driver.execute_async_script(_SERIOUS)


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser for all pages of a process."""
    webdriver = pytest.importorskip("selenium.webdriver")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no Chromium here: `make browser`")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    with webdriver.Chrome(options, webdriver.ChromeService(driver)) as started:
        started.get("about:blank")
        started.get_log("performance")  # the page that a browser opens by itself
        yield Browser(started)


def faults(browser: Browser, page: Path) -> list[str]:
    """Return what is wrong with a page on a phone, a laptop, in the dark and on paper."""
    found: list[str] = []
    if page.stat().st_size > 5e6:
        found.append(f"{page.stat().st_size / 1e6:.1f} MB")
    for width, dark, media in ((PHONE, True, ""), (LAPTOP, False, ""), (PRINT, False, "print")):
        browser.open(page, width, dark=dark, media=media)
        where = f"{width} px{' dark' if dark else ''} {media}".strip()
        found += [f"{where}: too wide: {what}" for what in browser.run(_TOO_WIDE)]
        if media != "print":
            found += [f"{where}: {what}" for what in browser.serious()]
        back, fore = (_brightness(browser, what) for what in ("backgroundColor", "color"))
        if (back < fore) != dark:
            found.append(f"{where}: not {'dark' if dark else 'light'}")
    found += [f"asked for {a}" for a in browser.asked() if not a.startswith(("file:", "data:"))]
    found += [f"console: {line}" for line in browser.complaints()]
    found += [f"no such place: #{anchor}" for anchor in browser.run(_DEAD_LINKS)]
    found += [f"image: {what}" for what in browser.run(_BAD_IMAGES)]
    return found


def _brightness(browser: Browser, what: str) -> float:
    colour = browser.run(f"return getComputedStyle(document.body).{what}")
    return sum(float(part) for part in colour[colour.index("(") + 1 : -1].split(",")[:3])
