"""HTML pages in a real browser without the network: their size, what the console says, and whether they move."""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim

MOST_BYTES = 15e6
LEAST_MOVED = 0.001

_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_FLAGS = (
    "--no-sandbox",
    "--disable-background-networking",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    # Every name resolves to nothing: a page that asks for the network is found out.
    "--host-resolver-rules=MAP * ~NOTFOUND",
)
_SIZE_PX = (960, 600)
_MOST_SECONDS = 120.0
# Less than this is noise of compositing; a level of 255.
_LEAST_LEVELS = 24

Action = Callable[[Any], None]
"""What is done to a page of playwright before it is looked at."""


def measure_page(html: Path, before: Action, after: Action) -> Row:
    """Opens a page from disk and compares what it shows after two actions.

    Args:
        html: the file.
        before: takes the page to its first state, such as :func:`seek_start`.
        after: takes it to the second one, such as :func:`seek_end`.

    Returns:
        ``bytes``, ``problems`` (console errors, exceptions and failed requests), ``moved`` (part of the pixels that
        differ between both states) and ``seconds`` until the first one stands still.

    Raises:
        NotMeasuredError: there is no browser.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError as error:
        raise NotMeasuredError("playwright is not installed") from error
    browser_path = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser_path is None:
        raise NotMeasuredError(f"there is no browser: {', '.join(_BROWSERS)}")
    problems: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browser_path, args=list(_FLAGS))
        page = browser.new_page(viewport={"width": _SIZE_PX[0], "height": _SIZE_PX[1]})
        page.set_default_timeout(1000 * _MOST_SECONDS)
        page.on("console", lambda m: problems.append(f"console: {m.text}") if m.type == "error" else None)
        page.on("pageerror", lambda error: problems.append(f"script: {error}"))
        page.on("requestfailed", lambda request: problems.append(f"request: {request.url}"))
        start_s = time.perf_counter()
        page.goto(html.resolve().as_uri())
        before(page)
        first = _take_still_picture(page)
        seconds = time.perf_counter() - start_s
        after(page)
        second = _take_still_picture(page)
        browser.close()
    differs = np.abs(first - second).max(-1) > _LEAST_LEVELS
    return {
        "page": html.name,
        "bytes": html.stat().st_size,
        "problems": problems,
        "moved": float(differs.mean()),
        "seconds": seconds,
    }


def seek_start(page: Any) -> None:
    """Stops the time line of an offline viewer near its start.

    Args:
        page: of playwright.
    """
    _seek(page, 0.1)


def seek_end(page: Any) -> None:
    """Stops the time line of an offline viewer near its end.

    Args:
        page: of playwright.
    """
    _seek(page, 0.9)


def _seek(page: Any, part: float) -> None:
    # The first field of the viewer is the time. Its slider knows how long the recording is, by a thumb that is hidden.
    time_field = page.locator("input").first
    time_field.wait_for()
    duration_s = float(page.locator("[role=slider]").first.get_attribute("aria-valuemax"))
    time_field.fill(f"{part * duration_s:.2f}")


def _take_still_picture(page: Any) -> NDArray[np.int16]:
    # Software rendering takes seconds, in which pictures differ; two equal ones in a row are the last word.
    end_s = time.monotonic() + _MOST_SECONDS
    picture = _take_picture(page)
    equal = 0
    while equal < 2 and time.monotonic() < end_s:
        page.wait_for_timeout(500)
        following = _take_picture(page)
        equal = equal + 1 if np.array_equal(picture, following) else 0
        picture = following
    return picture


def _take_picture(page: Any) -> NDArray[np.int16]:
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), np.int16)


def pages_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that pages are small, move, and ask for nothing that is not in them.

    Args:
        rows: see :func:`measure_page`.
    """
    names = ", ".join(row["page"] for row in rows) or "no page"
    count = len(rows)
    largest = max((row["bytes"] for row in rows), default=None)
    problems = sum(len(row["problems"]) for row in rows) if rows else None
    least = min((row["moved"] for row in rows), default=None)
    yield claim("exchange.page_bytes", largest, "<=", MOST_BYTES, "bytes", f"the largest of {names}", count)
    note = f"console errors, exceptions and failed requests in Chromium without the network; {names}"
    yield claim("exchange.page_problems", problems, "<=", 0, "count", note, count)
    note = f"pixels that differ between two states of a page, the least of {names}"
    yield claim("exchange.page_moved", least, ">=", LEAST_MOVED, "part", note, count)


def pages_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each page.

    Args:
        rows: see :func:`measure_page`.
    """
    yield "| page | size | console errors and failed requests | pixels that move | shown after, software rendering |"
    yield "|---|---|---|---|---|"
    for row in rows:
        size = f"{row['bytes'] / 1e6:.1f} MB"
        yield f"| {row['page']} | {size} | {len(row['problems'])} | {row['moved']:.1%} | {row['seconds']:.0f} s |"
