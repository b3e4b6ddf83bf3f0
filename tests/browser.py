"""A real browser for the tests of HTML pages: Chromium without a screen, which can reach no other machine."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium: run tests/install_browser.sh")

_FLAGS = (
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # Software rendering of WebGL.
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    # Every name resolves to nothing: a page that asks for the network fails its test.
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1",
)


@dataclass
class OpenPage:
    """A page in the browser.

    Attributes:
        page: playwright's page.
        problems: console errors, exceptions of scripts and failed requests so far.
    """

    page: Any
    problems: list[str] = field(default_factory=list)


@contextmanager
def open_page(
    address: Path | str, width_px: int = 1280, height_px: int = 800, color_scheme: str = "light"
) -> Iterator[OpenPage]:
    """Opens a file or a local address.

    Args:
        address: an HTML file, or a URL on this machine.
        width_px: of the window.
        height_px: of the window.
        color_scheme: ``light`` or ``dark``.
    """
    from playwright.sync_api import sync_playwright

    url = address.resolve().as_uri() if isinstance(address, Path) else address
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(_FLAGS))
        page = browser.new_page(viewport={"width": width_px, "height": height_px}, color_scheme=color_scheme)
        opened = OpenPage(page)
        page.on("console", lambda m: opened.problems.append(f"console: {m.text}") if m.type == "error" else None)
        page.on("pageerror", lambda error: opened.problems.append(f"script: {error}"))
        page.on("requestfailed", lambda r: opened.problems.append(f"request: {r.url} {r.failure}"))
        page.goto(url)
        yield opened
        browser.close()
