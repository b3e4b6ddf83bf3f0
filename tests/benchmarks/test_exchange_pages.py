"""The benchmark of pages sees what moves, and what goes wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.exchange.pages import measure_page, pages_claims, pages_table
from tests.browser import needs_browser

PAGE = """
<html><body style="margin:0"><div id="block" style="position:absolute;width:96px;height:60px;background:red"></div>
<script>{script}</script></body></html>
"""


def move_block(page: Any) -> None:
    page.evaluate("document.getElementById('block').style.left = '400px'")


WRONG = "console.error('lost'); new Image().src = 'https://example.org/x.png'; throw new Error('broken')"


@needs_browser
@pytest.mark.parametrize(
    ("script", "problems"),
    [("", set()), (WRONG, {"console: lost", "script: broken", "request: https://example.org/x.png"})],
)
def test_a_page_is_measured(tmp_path: Path, script: str, problems: set[str]) -> None:
    file = tmp_path / "page.html"
    file.write_text(PAGE.format(script=script))
    row = measure_page(file, lambda page: page.wait_for_timeout(300), move_block)
    # The block leaves one place and fills another.
    assert row["moved"] == pytest.approx(2 * 96 * 60 / (960 * 600), rel=0.02)
    assert row["bytes"] == file.stat().st_size
    # The browser itself reports the failed request on the console as well.
    assert {found for found in row["problems"] if "Failed to load resource" not in found} == problems


def test_claims_count_the_worst_page() -> None:
    good = {"page": "a.html", "bytes": 2_000_000, "problems": [], "moved": 0.1, "seconds": 3.0}
    bad = {"page": "b.html", "bytes": 20_000_000, "problems": ["console: lost"], "moved": 0.0, "seconds": 3.0}
    assert [claim.holds for claim in pages_claims([good])] == [True, True, True]
    assert [claim.holds for claim in pages_claims([good, bad])] == [False, False, False]
    assert [claim.n for claim in pages_claims([])] == [0, 0, 0]
    assert list(pages_table([bad]))[-1] == "| b.html | 20.0 MB | 1 | 0.0% | 3 s |"
