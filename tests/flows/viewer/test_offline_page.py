"""The offline page in a real browser: it plays, it moves actors, and it asks the network for nothing."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from flows.viewer.chunk_drawing import ChunkDrawing
from flows.viewer.local_server import start_server, stop_server
from flows.viewer.offline_page import write_offline_page
from flows.viewer.scene_nodes import SceneNodes
from genre_tasks.errors import InputError
from tests.browser import needs_browser, open_page
from tests.flows.viewed_street import SIDES, STEP_M, make_viewed

RED = 0
BLUE = 2


def take_picture(page: Any) -> NDArray[np.int16]:
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), np.int16)


def wait_for_color(page: Any, channel: int, least_px: float = 0.0, most_px: float = 1e9) -> float:
    """The middle of the columns in which a channel stands out, once it is between two columns."""
    others = [c for c in range(3) if c != channel]
    middle = -1.0
    for _ in range(60):
        picture = take_picture(page)
        stands_out = picture[..., channel] - picture[..., others].max(-1) > 180
        if stands_out.sum() > 200:
            middle = float(np.nonzero(stands_out)[1].mean())
            if least_px < middle < most_px:
                return middle
        page.wait_for_timeout(100)
    raise AssertionError(f"channel {channel} is at {middle}, not between {least_px} and {most_px}")


def go_to(page: Any, seconds: str) -> None:
    """Sets the time line, which also pauses it; until the recording is loaded, it plays on all the same."""
    time_field = page.locator("input").first
    for _ in range(60):
        time_field.fill(seconds)
        page.wait_for_timeout(300)
        if float(time_field.input_value()) == pytest.approx(float(seconds), abs=0.02):
            return
    raise AssertionError(f"the time line is at {time_field.input_value()}, not at {seconds}")


@needs_browser
def test_the_time_line_moves_an_actor_and_the_console_is_empty(tmp_path: Path) -> None:
    file = tmp_path / "new/scene.html"
    size = write_offline_page(file, make_viewed(), SIDES, "log <1>, chunk 0")
    assert size == file.stat().st_size < 2_000_000
    with open_page(file, 800, 500) as opened:
        page = opened.page
        page.locator("input").first.wait_for()
        # A time that is set before the recording is loaded is forgotten.
        wait_for_color(page, RED)
        # The red block drives from the left to the right, and is gone at the last frame, where a blue one is there.
        go_to(page, "0.05")
        start = wait_for_color(page, RED, most_px=390)
        go_to(page, "0.85")
        wait_for_color(page, RED, least_px=430)
        go_to(page, "0.95")
        wait_for_color(page, BLUE)
        picture = take_picture(page)
        assert (picture[..., RED] - picture[..., 1:].max(-1) > 180).sum() < 200
        # Back again: the recording can be played in any order.
        go_to(page, "0.05")
        assert wait_for_color(page, RED, most_px=390) == pytest.approx(start, abs=3)
        assert page.title() == "log <1>, chunk 0"
        body = page.inner_text("body")
        assert "reliable: 2.0 m to the left, 1.5 m to the right" in body
        assert "7 Gaussians are left out" in body
        assert not opened.problems


def test_an_earlier_page_stays_until_the_new_one_is_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "scene.html"
    file.write_text("before")
    monkeypatch.setattr(Path, "write_bytes", lambda self, data: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_offline_page(file, make_viewed(), None, "title")
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.html"]
    assert file.read_text() == "before"


def test_a_scene_without_gaussians_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no Gaussians"):
        write_offline_page(tmp_path / "x.html", replace(make_viewed(), scene=SceneNodes((), ())), None, "title")


def test_only_poses_follow_the_time() -> None:
    viewed = make_viewed()
    server = start_server("127.0.0.1", 0, "test")
    try:
        drawing = ChunkDrawing.draw(server.scene, viewed)
        drawing.draw_range(server.scene, SIDES)
        drawing.show_row(5)
        assert drawing.splats["car-1"].position.tolist() == pytest.approx([12.0, 3.6 - 5 * STEP_M, 0.0])
        assert drawing.splats["car-1"].visible and not drawing.splats["bus-2"].visible
        shown = {frame for handle, frame in drawing.frusta if handle.visible}
        # There are images at every third frame.
        assert shown == {3}
        drawing.hide("car-1", True)
        drawing.show_frusta("all frames")
        assert not drawing.splats["car-1"].visible
        assert all(handle.visible for handle, _ in drawing.frusta)
        drawing.show_row(9)
        assert drawing.splats["bus-2"].visible
        drawing.hide("car-1", False)
        assert not drawing.splats["car-1"].visible, "it does not exist at this frame"
        drawing.remove()
    finally:
        stop_server(server)
