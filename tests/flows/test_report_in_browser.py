"""The report in a real browser: nothing is fetched, the slider works by keyboard, and it fits a phone and the dark."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flows.reconstruction.report.writing import write_report
from flows.reconstruction.run_summary import ChunkSummary, Origin, RangeSummary, RunSummary, StageSummary
from genre_tasks.effects.types import Decision
from storage.codecs.png import encode_png
from tests.browser import needs_browser, open_page

pytestmark = needs_browser

COLORS = {"gnet": (200, 30, 30), "enet": (30, 30, 200), "truth": (30, 160, 30)}
NAME = "3m_left_front_camera_04"
PHONE_PX = 390


def picture(stage: str) -> bytes:
    """Noise around one colour, so that it is stored as a photo."""
    noise = np.random.default_rng(0).integers(-20, 20, (90, 160, 3))
    return encode_png((np.array(COLORS[stage]) + noise).clip(0, 255).astype(np.uint8))


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of one chunk with everything that a report can have."""
    words = "a long sentence without an end that says why, " * 3
    decision = Decision("lens_distortion", "p", 4.5, "px", 1.0, "auto", "on", words, words)
    stages = []
    inputs: dict[str, str] = {"log": "0" * 64}
    for name in ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet", "evaluate/enet"):
        origin = Origin(dict(inputs), "d" * 64, 4096, "2026-01-02T03:04:05+00:00", "c" * 64)
        images = {NAME: picture(name), f"{NAME}.truth": picture("truth")} if name in COLORS else {}
        metrics = {"shift_3m/psnr": 24.0, "shift_3m/kernel": 0.1, "shift_3m/n": 30.0} if name in COLORS else {}
        curve = ((1.0, 20.0), (5.0, 24.0)) if name in COLORS else ()
        stages.append(StageSummary(name, "e" * 64, False, 9.5, 800.0, metrics, images, curve, origin=origin))
        inputs[name] = "e" * 64
    points = ((-2.0, 18.0, False), (0.0, 24.0, True), (2.0, 21.0, False))
    found = RangeSummary("enet", 1.9, 1.5, 2.0, 20.0, points)
    chunk = ChunkSummary(0, tuple(stages), (words,), (decision,), found)
    log = "pandaset:/" + "a/very/long/path/" * 12
    summary = RunSummary("0123456789ab", log, "demo", log, (chunk,), environment={"platform": log})
    return write_report(tmp_path_factory.mktemp("report") / "report.html", summary)


def color_at(png: bytes, fraction: float) -> np.ndarray:
    """The mean colour of the middle rows, at a fraction of the width."""
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), float)
    column = int(fraction * pixels.shape[1])
    # The handle in the middle is left out.
    rows = slice(pixels.shape[0] // 8, pixels.shape[0] // 4)
    return pixels[rows, column - 2 : column + 3].mean((0, 1))


def test_a_keyboard_moves_the_edge_between_the_pictures(report: Path) -> None:
    with open_page(report) as opened:
        stack = opened.page.locator(".stack")
        middle = stack.screenshot()
        assert np.abs(color_at(middle, 0.25) - COLORS["gnet"]).max() < 12
        assert np.abs(color_at(middle, 0.75) - COLORS["enet"]).max() < 12
        slider = opened.page.get_by_role("slider", name="Divider")
        slider.focus()
        for _ in range(35):
            opened.page.keyboard.press("ArrowRight")
        assert slider.input_value() == "85" and "85 % GNet" in (slider.get_attribute("aria-valuetext") or "")
        assert np.abs(color_at(stack.screenshot(), 0.75) - COLORS["gnet"]).max() < 12
        opened.page.locator("select[data-side=left]").select_option("Truth")
        assert np.abs(color_at(stack.screenshot(), 0.25) - COLORS["truth"]).max() < 12
        assert opened.problems == []


def test_a_mouse_moves_it_too(report: Path) -> None:
    with open_page(report) as opened:
        stack = opened.page.locator(".stack")
        stack.scroll_into_view_if_needed()
        box = stack.bounding_box()
        assert box is not None
        opened.page.mouse.click(box["x"] + 0.1 * box["width"], box["y"] + box["height"] / 2)
        assert np.abs(color_at(stack.screenshot(), 0.25) - COLORS["enet"]).max() < 12


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_can_be_read_in_light_and_dark(report: Path, scheme: str) -> None:
    """Contrast of 4.5 to 1, as WCAG 2 asks of text."""
    luminance = """(color) => { const [r, g, b] = color.match(/[0-9.]+/g).map((v) => v / 255)
        .map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
        return 0.2126 * r + 0.7152 * g + 0.0722 * b; }"""
    script = f"""() => {{ const luminance = {luminance};
        const ground = (element) => {{
            for (let e = element; e; e = e.parentElement) {{
                const color = getComputedStyle(e).backgroundColor;
                if (!/, 0\\)|transparent/.test(color)) return luminance(color); }}
            return 1; }};
        const worst = [];
        for (const element of document.querySelectorAll("h1, p, dt, dd, td, th, small, code, figcaption, .pill, li")) {{
            if (!element.innerText.trim()) continue;
            const [a, b] = [luminance(getComputedStyle(element).color), ground(element)];
            const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
            if (ratio < 4.5) worst.push(element.tagName + " " + element.innerText.slice(0, 30) + " " + ratio); }}
        return [worst, ground(document.body)]; }}"""
    with open_page(report, color_scheme=scheme) as opened:
        worst, ground = opened.page.evaluate(script)
        assert worst == []
        assert (ground < 0.1) == (scheme == "dark")


@pytest.mark.parametrize("width_px", [PHONE_PX, 320, 1280])
def test_the_page_is_as_wide_as_its_window(report: Path, width_px: int) -> None:
    with open_page(report, width_px=width_px) as opened:
        assert opened.page.evaluate("document.documentElement.scrollWidth") == width_px
        assert opened.problems == []


def test_everything_has_a_name(report: Path) -> None:
    with open_page(report) as opened:
        page = opened.page
        assert page.locator("img:not([alt])").count() == 0
        assert page.evaluate("[...document.querySelectorAll('.strip img')].every((i) => i.alt && i.naturalWidth > 0)")
        assert page.evaluate("[...document.querySelectorAll('svg')].every((s) => s.getAttribute('aria-label'))")
        assert page.evaluate("[...document.querySelectorAll('select')].every((s) => s.labels.length === 1)")
        assert page.evaluate("[...document.querySelectorAll('[tabindex]')].every((e) => e.ariaLabel)")


def test_without_scripts_and_on_paper_the_pictures_stand_side_by_side(report: Path) -> None:
    with open_page(report) as opened:
        opened.page.emulate_media(media="print")
        assert not opened.page.locator(".compare").is_visible()
        assert opened.page.locator(".strip img").first.is_visible()
    # As it stands in the file: only the script shows the slider.
    assert '<div class="compare" hidden>' in report.read_text()
