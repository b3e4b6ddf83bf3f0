"""The live viewer: a real browser opens it, its controls move nodes and the camera, and it ends in order."""

from __future__ import annotations

import signal
import socket
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from flows.cli.view import PAGE_SPLATS
from flows.viewer.client_session import ClientSession, _describe_chunk
from flows.viewer.live_viewer import LiveViewer
from flows.viewer.local_server import find_free_port, start_server, stop_server
from flows.viewer.viewed_chunks import ViewedRun
from genre_tasks.errors import ConfigError, InputError
from tests.browser import needs_browser, open_page
from tests.flows.command_line import GENRE, environment
from tests.flows.small_simulation import make_run
from tests.flows.viewed_street import STEP_M, MadeUpRun, make_viewed

# The corners of viser's splats have two coordinates, and three.js misses the third where it computes a bounding sphere
# that nothing uses.
HARMLESS = "console: THREE.BufferGeometry.computeBoundingSphere(): Computed radius is NaN"


def wait_until(page: Any, condition: Callable[[], bool]) -> None:
    for _ in range(200):
        if condition():
            return
        page.wait_for_timeout(50)
    raise AssertionError("it did not happen")


@pytest.fixture
def viewer() -> Iterator[tuple[LiveViewer, MadeUpRun]]:
    run = MadeUpRun()
    with LiveViewer(cast(ViewedRun, run), make_viewed(), port=0) as started:
        yield started, run


def only_session(viewer: LiveViewer) -> ClientSession:
    (session,) = viewer.sessions.values()
    return session


def test_a_chunk_without_images_is_shown_without_their_panel() -> None:
    server = start_server("127.0.0.1", 0, "test")
    # What a session asks of a client, without a browser.
    client = SimpleNamespace(gui=server.gui, scene=server.scene, atomic=server.atomic, camera=SimpleNamespace())
    try:
        for images in ((), make_viewed().images):
            viewed = replace(make_viewed(), images=images)
            session = ClientSession(cast(Any, client), cast(ViewedRun, MadeUpRun()), viewed, with_range=False)
            session.frame.value = 5
            assert session.drawing.row == 5
            assert session._drive_folder.visible == bool(images)
    finally:
        stop_server(server)


def set_value(control: Any, value: Any) -> None:
    control.value = value


def test_the_name_of_a_log_is_no_html() -> None:
    heading = _describe_chunk(replace(make_viewed(), log="<iframe srcdoc='x'> 002"))
    assert heading.startswith(r"**\<iframe srcdoc\=\'x\'\> 002**")


@needs_browser
def test_a_browser_moves_actors_and_drives_along(viewer: tuple[LiveViewer, MadeUpRun]) -> None:
    live, run = viewer
    with open_page(live.address, 800, 600) as opened:
        page = opened.page
        wait_until(page, lambda: len(live.sessions) == 1)
        session = only_session(live)
        car = session.drawing.splats["car-1"]
        assert car.position[1] == pytest.approx(3.6)
        slider = page.get_by_role("slider").first
        slider.focus()
        for _ in range(4):
            slider.press("ArrowRight")
        wait_until(page, lambda: session.drawing.row == 4)
        assert car.position[1] == pytest.approx(3.6 - 4 * STEP_M)
        check_driving(page, session)
        check_another_stage(page, session, run)
        # A second browser starts at the beginning, and neither moves the other.
        second = page.context.browser.new_page()
        second.goto(live.address)
        wait_until(page, lambda: len(live.sessions) == 2)
        other = next(s for s in live.sessions.values() if s is not session)
        set_value(other.frame, 7)
        assert (session.drawing.row, other.drawing.row) == (4, 7)
        wait_until(page, lambda: session.drawing.range_lines is not None)
        assert [problem for problem in opened.problems if not problem.startswith(HARMLESS)] == []
    wait_until_closed(live)


def check_driving(page: Any, session: ClientSession) -> None:
    # The camera of the image at frame 3, carried on to frame 4 with the vehicle, two metres to the left.
    set_value(session.drive, True)
    set_value(session.offset, 2.0)
    camera = session._client.camera
    assert camera.position.tolist() == pytest.approx([2.0, 2.0, 1.5])
    assert (camera.look_at - camera.position).tolist() == pytest.approx([10.0, 0.0, 0.0])
    assert camera.fov == pytest.approx(0.9)
    assert not any(handle.visible for handle, _ in session.drawing.frusta)
    page.wait_for_timeout(300)
    # The browser has sent back where its camera is. A slow one first sends where it was before.
    wait_until(page, lambda: camera.position.tolist() == pytest.approx([2.0, 2.0, 1.5], abs=1e-3))


def check_another_stage(page: Any, session: ClientSession, run: MadeUpRun) -> None:
    set_value(session._switches["car-1"], False)
    assert not session.drawing.splats["car-1"].visible
    set_value(session._switches["recorded path"], False)
    session._choose(0, "initial")
    assert not session.drawing.path.visible
    assert run.asked == [(0, "initial")]
    # The moment, the place and the switches stay.
    assert session.drawing.viewed.stage == "initial"
    assert (session.drawing.row, session.drive.value, session.offset.value) == (4, True, 2.0)
    assert not session.drawing.splats["car-1"].visible
    assert session._client.camera.position.tolist() == pytest.approx([2.0, 2.0, 1.5], abs=1e-3)


def wait_until_closed(live: LiveViewer) -> None:
    for _ in range(100):
        if not live.sessions:
            return
        time.sleep(0.05)
    raise AssertionError("sessions of closed browsers stay")


@needs_browser
def test_time_runs_while_a_client_plays(viewer: tuple[LiveViewer, MadeUpRun]) -> None:
    live, _ = viewer
    with open_page(live.address, 400, 300) as opened:
        wait_until(opened.page, lambda: len(live.sessions) == 1)
        session = only_session(live)
        live.tick(0.35)
        assert session.drawing.row == 0
        set_value(session.play, True)
        live.tick(0.35)
        assert session.drawing.row == 3
        live.tick(0.3)
        assert session.drawing.row == 6
        # After the last frame it begins again.
        live.tick(0.5)
        assert session.drawing.row == 0
        check_another_chunk(session)


def check_another_chunk(session: ClientSession) -> None:
    set_value(session.play, False)
    set_value(session.frame, 5)
    set_value(session._switches["car-1"], False)
    before = session.frame
    session._choose(1, None)
    # The controls are new, since frames, cameras and actors may be others; what fits stays.
    assert session.frame is not before
    assert (session.drawing.viewed.number, session.drawing.row, session.frame.value) == (1, 5, 5)
    assert not session.drawing.splats["car-1"].visible
    assert session.drawing.range_lines is not None


def test_a_taken_port_leads_to_the_next_and_a_foreign_address_is_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert find_free_port("127.0.0.1", port) > port
    # An address that is kept for documents.
    with pytest.raises(ConfigError, match=r"cannot listen at 192\.0\.2\.1"):
        find_free_port("192.0.2.1", 8080)


def test_without_viser_the_command_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    done = CliRunner().invoke(app, ["view", "4b1c"])
    assert isinstance(done.exception, ConfigError)
    assert "pip install 'genre[viewer]'" in str(done.exception)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--host", "my-machine"], "no address"),
        (["--port", "70000"], "out of range"),
        (["--max-splats", "3"], "out of range"),
        (["--html", "scene.pdf"], "ends with '.pdf'"),
    ],
)
def test_a_mistyped_option_is_refused_at_once(words: list[str], problem: str) -> None:
    done = CliRunner().invoke(app, ["view", "4b1c", *words])
    assert isinstance(done.exception, ConfigError | InputError)
    assert problem in str(done.exception)


@pytest.mark.parametrize(("words", "expected"), [([], PAGE_SPLATS), (["--max-splats", "300"], 300)])
def test_a_page_has_as_many_gaussians_as_the_guide_says(
    words: list[str], expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int | None] = []

    def stop(store: str, run: str, max_splats: int | None) -> None:
        asked.append(max_splats)
        raise InputError("stopped", remedy="None.")

    (tmp_path / "store").mkdir()
    monkeypatch.setattr("flows.viewer.viewed_chunks.ViewedRun", stop)
    page = ["--html", str(tmp_path / "scene.html")]
    done = CliRunner().invoke(app, ["view", "4b1c", "--store", str(tmp_path / "store"), *page, *words])
    assert isinstance(done.exception, InputError) and asked == [expected]
    guide = (Path(__file__).resolve().parents[3] / "docs/guides/viewer.md").read_text()
    assert f"A page has at most {PAGE_SPLATS:,} Gaussians" in guide


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("viewer")
    return folder, make_run(folder)


def test_a_run_is_read_by_chunk_and_stage(store: tuple[Path, str]) -> None:
    folder, name = store
    run = ViewedRun(str(folder), name[:6], max_splats=300)
    assert (run.name, run.chunk_numbers, run.list_stages(1)) == (name, (0, 1), ("initial",))
    assert run.select(None, None) == (0, "initial")
    with pytest.raises(InputError, match="no chunk 7"):
        run.select(7, None)
    with pytest.raises(InputError, match="no scene of the stage 'gnet'"):
        run.select(1, "gnet")
    viewed = run.load(1, "initial")
    assert run.load(1, "initial") is viewed
    assert len(viewed.scene) <= 300 and "are left out" in viewed.scene.losses[0]
    assert viewed.frames == tuple(range(6, 12))
    assert np.allclose(np.diff(viewed.times_s), 0.1)
    # Names are those of the whole run, so that an actor has one name in all its chunks.
    assert set(run.load(0, "initial").actor_names) & set(viewed.actor_names)
    assert {image.camera for image in viewed.images} == set(viewed.camera_names)


def test_the_command_serves_until_ctrl_c(store: tuple[Path, str]) -> None:
    folder, name = store
    command = [*GENRE, "view", name, "--store", str(folder), "--port", "0", "--no-range"]
    process = subprocess.Popen(
        command,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell that runs the tests in the background has them ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        address = line.split()[0]
        assert address.startswith("http://127.0.0.1:"), line
        with urllib.request.urlopen(address, timeout=20) as answer:
            assert b"<!doctype html>" in answer.read(100).lower()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 130
    assert out == ""
    assert "Traceback" not in err and err.endswith("stopped\n")
