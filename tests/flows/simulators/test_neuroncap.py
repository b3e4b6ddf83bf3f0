"""NeuroNCAP's protocol over a real connection: its five requests, every mistake refused, and nonsense survived."""

from __future__ import annotations

import http.client
import io
import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from PIL import Image

from benchmarks.common.claims import Claim
from benchmarks.exchange.neuroncap_client import NeuroncapClient
from benchmarks.exchange.service_fuzz import (
    measure_service_fuzz,
    service_fuzz_claims,
    service_fuzz_table,
)
from flows.simulators import neuroncap
from flows.simulators.image_request import ActorDescription, ActorPose, ImageRequest
from flows.simulators.neuroncap import ActorState, start_neuroncap
from flows.simulators.neuroncap_messages import (
    ImageMessage,
    Trajectory,
    describe_recorded,
    parse_trajectories,
    write_trajectories,
)
from flows.simulators.placed_actors import ActorPlacer
from flows.simulators.scene_renderer import SceneRenderer
from flows.simulators.service import RunningService, ServiceRequest
from flows.simulators.service_metrics import SilentMetrics
from genre_tasks.errors import ConfigError, ResourceError
from tests.flows.simulators.held_renders import hold_renders
from tests.waiting import wait_until

CAMERA = "front_camera"


@pytest.fixture(scope="module")
def service(renderer: SceneRenderer) -> Iterator[RunningService]:
    started = start_neuroncap(ServiceRequest({renderer.name: renderer}, "127.0.0.1", 0, SilentMetrics()))
    yield started
    started.close()


@pytest.fixture
def client(service: RunningService, renderer: SceneRenderer) -> NeuroncapClient:
    found = NeuroncapClient(service.address, renderer)
    found.send("POST /update_actors", found.samples["POST /update_actors"][0])
    return found


def ask(service: RunningService, verb: str, path: str, message: Any = None) -> tuple[int, bytes]:
    place = urlsplit(service.address)
    connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=60)
    body = message if isinstance(message, bytes) else json.dumps(message).encode()
    connection.request(verb, path, body=body)
    response = connection.getresponse()
    answer = response.status, response.read()
    connection.close()
    return answer


def image_message(renderer: SceneRenderer, row: int, **changes: Any) -> dict[str, Any]:
    times_s, poses = renderer.ego_trajectory()
    pose = poses[row] @ renderer.cameras[CAMERA].rig_SE3_camera
    message = {"pose": pose.tolist(), "timestamp": round(times_s[row] * 1e6), "camera_name": CAMERA}
    return message | {"image_format": "png"} | changes


def read_image(content: bytes) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.asarray(Image.open(io.BytesIO(content)))


def test_alive_and_start_time(service: RunningService, renderer: SceneRenderer) -> None:
    assert ask(service, "GET", "/alive") == (200, b"true")
    status, content = ask(service, "GET", "/start_time")
    assert (status, json.loads(content)) == (200, round(renderer.time_range_s[0] * 1e6))
    assert ask(service, "GET", "/update_actors")[0] == 405 and ask(service, "GET", "/nothing")[0] == 404


@pytest.mark.usefixtures("client")
def test_images_are_the_renderers(service: RunningService, renderer: SceneRenderer) -> None:
    message = image_message(renderer, 8)
    pose = np.array(message["pose"])
    time_s = message["timestamp"] / 1e6
    request = ImageRequest(renderer.cameras[CAMERA].lens, pose, pose, time_s, time_s, camera=CAMERA)
    expected = renderer.render(request)
    status, content = ask(service, "POST", "/render_image", message)
    assert status == 200 and np.abs(read_image(content).astype(int) - expected).max() <= 1
    status, content = ask(service, "POST", "/render_image", message | {"image_format": "jpeg"})
    assert status == 200 and content[:3] == b"\xff\xd8\xff"
    assert np.abs(read_image(content).astype(int) - expected).mean() < 6


def test_actors_come_back_and_can_be_moved(
    service: RunningService, client: NeuroncapClient, renderer: SceneRenderer
) -> None:
    actors = json.loads(ask(service, "GET", "/get_actors")[1])
    assert [actor["uuid"] for actor in actors] == [actor.track_id for actor in renderer.actors()]
    width, length, height = actors[0]["dims"]
    assert length > width and (length, width, height) == pytest.approx(renderer.actors()[0].size_m)
    before = read_image(ask(service, "POST", "/render_image", image_message(renderer, 2))[1])
    assert ask(service, "POST", "/update_actors", []) == (200, b"null")
    empty = read_image(ask(service, "POST", "/render_image", image_message(renderer, 2))[1])
    assert np.abs(before.astype(int) - empty).max() > 10
    assert json.loads(ask(service, "GET", "/get_actors")[1]) == []
    # The recorded actors, sent back, are what was recorded; so are those of an unknown time.
    assert ask(service, "POST", "/update_actors", actors)[0] == 200
    again = read_image(ask(service, "POST", "/render_image", image_message(renderer, 2))[1])
    assert np.abs(before.astype(int) - again).max() <= 1
    late = [actor | {"timestamps": [time + 10**9 for time in actor["timestamps"]]} for actor in actors]
    assert ask(service, "POST", "/update_actors", late)[0] == 200
    gone = read_image(ask(service, "POST", "/render_image", image_message(renderer, 2))[1])
    assert np.abs(empty.astype(int) - gone).max() <= 1


def test_recorded_actors_that_are_sent_back_are_at_each_cameras_own_moment(renderer: SceneRenderer) -> None:
    state = ActorState(renderer)
    message = ImageMessage.model_validate(image_message(renderer, 2))
    assert state.request_image(message).actors is None
    sent_back = parse_trajectories(json.dumps(write_trajectories(state.trajectories)).encode())
    # A change of some actors leaves the others where they were recorded.
    state.replace_all(sent_back[1:])
    request = state.request_image(message)
    assert request.actors == () and request.recorded_actors == tuple(actor.track_id for actor in sent_back[1:])
    shifted = replace(sent_back[0], world_SE3_box=sent_back[0].world_SE3_box + 1e-3)
    present = replace(shifted, times_us=tuple(message.timestamp + k for k in range(len(shifted.times_us))))
    state.replace_all((present, *sent_back[1:]))
    request = state.request_image(message)
    assert [actor.track_id for actor in request.actors or ()] == [present.track_id]
    assert request.recorded_actors == tuple(actor.track_id for actor in sent_back[1:])
    state.replace_all(sent_back[::-1])
    request = state.request_image(message)
    assert request.actors is None and request.recorded_actors == ()


def test_recorded_actors_that_are_sent_back_by_name_give_the_same_image(
    service: RunningService, client: NeuroncapClient, renderer: SceneRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A street names its actors as its log does, by other numbers; real logs have ids that are no names.
    names = {actor.track_id: f"named-{actor.name}" for actor in renderer.actors()}
    placer = ActorPlacer(renderer.scenes, renderer._facts.chunks_by_track, names)
    monkeypatch.setattr(renderer, "_placer", placer)
    # Between two frames, where an actor would be elsewhere by the times of the message.
    message = image_message(renderer, 2)
    message["timestamp"] += 30_000
    before = read_image(ask(service, "POST", "/render_image", message)[1])
    actors = json.loads(ask(service, "GET", "/get_actors")[1])
    named = [actor | {"uuid": names[actor["uuid"]]} for actor in actors]
    assert ask(service, "POST", "/update_actors", named)[0] == 200
    assert np.array_equal(read_image(ask(service, "POST", "/render_image", message)[1]), before)
    # Whoever asks finds the actors by the names that were sent.
    answer = json.loads(ask(service, "GET", "/get_actors")[1])
    assert [actor["uuid"] for actor in answer] == list(names.values())
    state = ActorState(renderer)
    sent_back = parse_trajectories(json.dumps(named).encode())
    asked = ImageMessage.model_validate(message)
    state.replace_all(sent_back)
    assert state.request_image(asked).actors is None
    moved = replace(sent_back[0], world_SE3_box=sent_back[0].world_SE3_box + 1e-3)
    state.replace_all((moved, *sent_back[1:]))
    assert state.request_image(asked).recorded_actors == tuple(names)[1:]


def test_trajectories_are_interpolated() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 8.0
    start_us = 1_700_060_000_000_000
    trajectory = Trajectory("car-0", (start_us, start_us + 400), poses, (1.8, 4.5, 1.5))
    pose = trajectory.pose_at(start_us + 100)
    assert isinstance(pose, ActorPose) and pose.start_world_SE3_box[0, 3] == 2.0
    assert trajectory.pose_at(start_us - 1) is None and trajectory.pose_at(start_us + 401) is None


def test_recorded_actors_exist_half_a_frame_around_their_frames() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 8.0
    driving = ActorDescription("a", "car-1", "Car", (4.5, 1.8, 1.5), np.array([3.0, 3.1]), poses)
    once = ActorDescription("b", "car-2", "Car", (4.5, 1.8, 1.5), np.array([0.02]), poses[1:])
    first, second = describe_recorded((driving, once), 0.1)
    assert first.times_us == (2_950_000, 3_000_000, 3_100_000, 3_150_000)
    assert first.world_SE3_box[:, 0, 3] == pytest.approx([-4.0, 0.0, 8.0, 12.0])
    # No time of the protocol is negative.
    assert second.times_us == (0, 20_000, 70_000)
    pose = second.pose_at(0)
    assert pose is not None and pose.start_world_SE3_box[0, 3] == 8.0
    at_zero = describe_recorded((replace(once, times_s=np.zeros(1)),), 0.1)[0]
    assert at_zero.times_us == (0, 50_000) and len(at_zero.world_SE3_box) == 2


def test_recorded_actors_are_there_at_the_start_time(renderer: SceneRenderer) -> None:
    start_us = round(renderer.time_range_s[0] * 1e6)
    first_s = renderer.ego_trajectory()[0][0]
    from_first = [actor.times_s[0] == first_s for actor in renderer.actors()]
    described = describe_recorded(renderer.actors(), renderer.frame_s)
    assert any(from_first)
    assert [trajectory.pose_at(start_us) is not None for trajectory in described] == from_first


MISTAKES: dict[str, tuple[str, Any, int, str]] = {
    "raw": ("/render_image", {"image_format": "raw"}, 406, "pickle"),
    "camera": ("/render_image", {"camera_name": "CAM_FRONT"}, 422, "no camera 'CAM_FRONT'"),
    "time": ("/render_image", {"timestamp": 5}, 422, "outside of the run"),
    "time as text": ("/render_image", {"timestamp": "soon"}, 422, "timestamp"),
    "large time": ("/render_image", {"timestamp": 10**30}, 422, "timestamp"),
    "rows": ("/render_image", {"pose": [[1, 2], [3]]}, 422, "pose"),
    "not finite": ("/render_image", {"pose": [[float("nan")] * 4] * 4}, 422, "finite"),
    "zeros": ("/render_image", {"pose": [[0.0] * 4] * 4}, 422, "no rigid transform"),
    "no object": ("/render_image", b"[1]", 422, "object"),
    "no JSON": ("/render_image", b"\xff\x00", 422, "JSON"),
    "deep": ("/update_actors", b"[" * 100_000, 422, "JSON"),
    "unknown actor": ("/update_actors", [{"uuid": "x", "poses": [], "timestamps": [], "dims": [1, 1, 1]}], 422, "'x'"),
    "counts": ("/update_actors", [{"uuid": "x", "poses": [], "timestamps": [1], "dims": [1, 1, 1]}], 422, "0 poses"),
    "order": (
        "/update_actors",
        [{"uuid": "x", "poses": [np.eye(4).tolist()] * 2, "timestamps": [2, 1], "dims": [1, 1, 1]}],
        422,
        "do not rise",
    ),
    "large": ("/update_actors", b" " * (neuroncap.MAX_BODY_BYTES + 1), 413, "bytes"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_refused_with_a_sentence(name: str, service: RunningService, renderer: SceneRenderer) -> None:
    path, message, status, words = MISTAKES[name]
    if isinstance(message, dict):
        message = image_message(renderer, 2, **message)
    found, content = ask(service, "POST", path, message)
    assert found == status and words in json.loads(content)["detail"]


def test_the_protocols_default_format_is_refused(service: RunningService, renderer: SceneRenderer) -> None:
    message = image_message(renderer, 2)
    del message["image_format"]
    assert ask(service, "POST", "/render_image", message)[0] == 406


def test_a_busy_renderer_says_so(
    service: RunningService, renderer: SceneRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(request: ImageRequest) -> None:
        raise ResourceError("the renderer is busy", remedy="Ask again later.")

    monkeypatch.setattr(renderer, "render", refuse)
    status, content = ask(service, "POST", "/render_image", image_message(renderer, 2))
    assert status == 503 and b"busy" in content


def test_nobody_renders_for_a_client_that_has_gone(
    service: RunningService, renderer: SceneRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = hold_renders(renderer, monkeypatch)
    message = image_message(renderer, 2)
    place = urlsplit(service.address)
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(ask, service, "POST", "/render_image", message)
        try:
            wait_until(lambda: renderer.queue_length == 1, "the first request does not come")
            hasty = http.client.HTTPConnection(place.hostname or "", place.port, timeout=60)
            hasty.request("POST", "/render_image", body=json.dumps(message).encode())
            wait_until(lambda: renderer.queue_length == 2, "the second request does not come")
            hasty.close()
            # The server hears of it a moment later.
            time.sleep(1.5)
        finally:
            held.release.set()
        assert first.result(60)[0] == 200
    wait_until(lambda: renderer.queue_length == 0, "the second request does not end")
    assert held.rendered == [1]


def test_one_service_has_one_run(renderer: SceneRenderer, service: RunningService) -> None:
    with pytest.raises(ConfigError, match="2 runs"):
        start_neuroncap(ServiceRequest({"a": renderer, "b": renderer}, "127.0.0.1", 0, SilentMetrics()))
    port = urlsplit(service.address).port
    assert port is not None
    with pytest.raises(ConfigError, match="cannot listen"):
        start_neuroncap(ServiceRequest({"a": renderer}, "127.0.0.1", port, SilentMetrics()))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(path=st.sampled_from(["/render_image", "/update_actors"]), body=st.binary(max_size=400))
def test_any_bytes_are_refused(service: RunningService, path: str, body: bytes) -> None:
    # An empty list of actors is sound.
    assume(b"".join(body.split()) != b"[]")
    status, content = ask(service, "POST", path, body)
    assert status == 422 and json.loads(content)["detail"]


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=9), inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(field=st.sampled_from(["pose", "timestamp", "camera_name", "image_format"]), value=JSON_VALUES)
def test_any_value_of_a_field_is_refused_or_answered(
    service: RunningService, renderer: SceneRenderer, field: str, value: Any
) -> None:
    status, content = ask(service, "POST", "/render_image", image_message(renderer, 2, **{field: value}))
    assert status == 422 and json.loads(content)["detail"]


def test_many_odd_requests_leave_the_service_alive(client: NeuroncapClient) -> None:
    row = measure_service_fuzz(client, requests=250, seed=3)
    assert row["faults"] == 0, row["first_faults"]
    assert sum(row["by_status"].values()) == 250 and {"200", "422"} <= set(row["by_status"])
    claims: list[Claim] = list(service_fuzz_claims([row]))
    assert all(made.holds for made in claims) and len(list(service_fuzz_table([row]))) == 3
    broken = row | {"faults": 1, "alive": False, "silent_refusals": 2}
    assert not any(made.holds for made in service_fuzz_claims([broken]))
