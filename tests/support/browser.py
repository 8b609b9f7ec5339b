"""Debian's Chromium without a screen, which must ask nobody but the page's own server for anything."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from support.missing import skip_but_fail_in_ci

#: As root there is no sandbox; WebGL is drawn by the processor.
_OPTIONS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
#: What a page may take on a busy machine, ms.
PATIENCE_MS = 120_000


@contextmanager
def browsing(width: int = 1200, height: int = 800) -> Iterator[Any]:
    """Yield an empty page; on leaving, fail if it has complained or asked another host for something."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        skip_but_fail_in_ci("no chromium is installed")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        skip_but_fail_in_ci("playwright is not installed")
    complaints: list[str] = []
    asked: list[str] = []
    with sync_playwright() as driver, driver.chromium.launch(executable_path=program, args=_OPTIONS) as browser:
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(PATIENCE_MS)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else None)
        page.on("request", lambda request: asked.append(request.url))
        page.allowed = []  # a part of each complaint that a test provokes
        yield page
        strangers = {url for url in asked if urlsplit(url).hostname not in (None, "127.0.0.1")}
        left = [text for text in complaints if not any(part in text for part in page.allowed)]
    assert not strangers, strangers
    assert not left, left


def click(page: Any, pane: str, x: int, y: int) -> None:
    """Click a pixel of a pane."""
    canvas = page.locator(f"#{pane} canvas").first
    box, (width, height) = canvas.bounding_box(), page.evaluate("viewer.about.size")
    page.mouse.click(box["x"] + (x + 0.5) * box["width"] / width, box["y"] + (y + 0.5) * box["height"] / height)


def drag(page: Any, pane: str, start: tuple[int, int], end: tuple[int, int]) -> None:
    """Drag from a pixel of a pane to another one."""
    canvas = page.locator(f"#{pane} canvas").first
    box, (width, height) = canvas.bounding_box(), page.evaluate("viewer.about.size")
    for (x, y), act in ((start, page.mouse.down), (end, page.mouse.up)):
        page.mouse.move(box["x"] + (x + 0.5) * box["width"] / width, box["y"] + (y + 0.5) * box["height"] / height)
        act()
