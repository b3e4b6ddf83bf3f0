"""Images for simulators: equal to renders at recorded poses, right with moved actors and shutters, clear errors."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from flows.simulation.edited_runs import write_edited_run
from flows.simulation.run_scenes import RunScenes
from flows.simulators.image_request import ActorPose, ImageRequest, RenderLimits
from flows.simulators.placed_actors import ActorPlacer
from flows.simulators.render_queue import RenderQueue
from flows.simulators.scene_renderer import SceneRenderer
from genre_tasks.errors import InputError, ResourceError
from genre_tasks.logs.types import Float64, Lens, RollingShutter
from genre_tasks.render import render_views
from genre_tasks.rollout.chunk_layout import ChunkLayout
from genre_tasks.rollout.rig import RolloutView
from genre_tasks.scene.chunk import View
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene_edits.chunk_scene import ChunkScene
from genre_tasks.scene_edits.edits import EditList, Move, Remove
from storage.codecs.png import to_pixels
from tests.waiting import wait_until

Image = np.ndarray[Any, np.dtype[np.uint8]]


def difference(one: Image, other: Image) -> int:
    return int(np.abs(one.astype(int) - other).max())


def recorded(chunk_scene: ChunkScene, view: View) -> ImageRequest:
    pose = chunk_scene.chunk.world_SE3_chunk @ view.chunk_SE3_camera
    return ImageRequest(view.lens, pose, pose, view.timestamp_s, view.timestamp_s, camera=view.camera)


def request_at(renderer: SceneRenderer, served: tuple[str, str], frame: int, camera: str) -> ImageRequest:
    scenes = RunScenes(*served)
    for number in scenes.chunk_numbers:
        for view in scenes.load(number).chunk.views:
            if (view.frame, view.camera) == (frame, camera):
                return recorded(scenes.load(number), view)
    raise AssertionError(frame)


def recorded_actors(renderer: SceneRenderer, time_s: float) -> tuple[ActorPose, ...]:
    found = []
    for actor in renderer.actors():
        for row in np.flatnonzero(np.abs(actor.times_s - time_s) < 1e-4):
            found.append(ActorPose(actor.track_id, actor.world_SE3_box[row], actor.world_SE3_box[row]))
    return tuple(found)


def test_recorded_views_are_those_of_genre_render(renderer: SceneRenderer, served: tuple[str, str]) -> None:
    scenes = RunScenes(*served)
    for number in scenes.chunk_numbers:
        loaded = scenes.load(number)
        views = {(v.frame, v.camera): v for v in loaded.chunk.views}
        # The frames at both ends too, where the next chunk begins.
        for novel in place_novel_views(loaded.chunk, (0.0,), frames=[loaded.chunk.frames[k] for k in (0, 3, -1)]):
            with torch.no_grad():
                expected = to_pixels(render_views(loaded.scene, [novel]).color)[0]
            request = recorded(loaded, views[novel.frame, novel.camera])
            assert difference(renderer.render(request), expected) <= 1
            placed = replace(request, actors=recorded_actors(renderer, request.start_s))
            assert difference(renderer.render(placed), expected) <= 1


def test_the_background_is_that_of_the_lane_that_the_vehicle_drives_in(
    renderer: SceneRenderer, served: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = renderer.ego_trajectory()[1][:6]
    # As if the second chunk led back, 3 m to the left.
    positions = np.concatenate([out[:, :2, 3], (out[:, :2, 3] + 3.0 * out[:, :2, 1])[::-1]])
    facings = np.concatenate([out[:, :2, 0], -out[::-1, :2, 0]])
    layout = ChunkLayout((0, 1), (0, 6), (5, 11), np.arange(12.0), positions, facings)
    monkeypatch.setattr(renderer, "_layout", layout)
    request = request_at(renderer, served, 2, "front_camera")
    pose = request.start_world_SE3_camera.copy()
    pose[:3, 3] += 2.5 * out[2, :3, 1]

    def find_background(camera: str | None) -> int:
        asked = replace(request, start_world_SE3_camera=pose, end_world_SE3_camera=pose, camera=camera)
        return renderer._find_scene(asked, pose, 2.0, request.start_s).chunk.index

    assert find_background("front_camera") == 0
    # A camera that is not of the rig may look anywhere: the nearest place counts.
    assert find_background(None) == 1


def test_a_batch_is_its_images_in_order(renderer: SceneRenderer, served: tuple[str, str]) -> None:
    requests = [
        request_at(renderer, served, frame, camera)
        for frame, camera in ((7, "front_camera"), (2, "front_left_camera"), (7, "front_left_camera"))
    ]
    small = requests[0].lens.resized(32, 18)
    requests += [replace(requests[0], lens=small), replace(requests[0], actors=())]
    images = renderer.render_batch(requests)
    assert [image.shape for image in images] == [(36, 64, 3)] * 3 + [(18, 32, 3), (36, 64, 3)]
    for image, request in zip(images, requests, strict=True):
        assert difference(image, renderer.render(request)) <= 1
    assert renderer.render_batch([]) == []


def test_actors_are_where_they_are_wanted_and_no_others(renderer: SceneRenderer, served: tuple[str, str]) -> None:
    request = request_at(renderer, served, 2, "front_camera")
    empty = renderer.render(replace(request, actors=()))
    assert difference(empty, renderer.render(request)) > 10
    # An actor that only the other chunk has seen, ahead of the camera.
    box = np.eye(4)
    camera = request.start_world_SE3_camera
    box[:3, 3] = camera[:3, 3] + 4.0 * camera[:3, 2]
    walker = next(actor for actor in renderer.actors() if len(actor.times_s) == 6)
    shown = renderer.render(replace(request, actors=(ActorPose(walker.name, box, box),)))
    changed = np.argwhere(np.abs(shown.astype(int) - empty).max(-1) > 10)
    # Inside of the box as the camera sees it: 1.6 m high and 0.8 m wide, at a focal length of 66 px.
    assert len(changed) > 20
    assert np.abs(changed - (18, 32)).max(0).tolist() <= [15, 8]
    assert abs(changed.mean(0)[1] - 32) < 4
    again = renderer.render(replace(request, actors=(ActorPose(walker.track_id, box, box),)))
    assert difference(again, shown) == 0


class FreshScenes:
    """Reads a chunk anew whenever it is asked for, and counts; a ``SceneSource``."""

    def __init__(self, scenes: RunScenes) -> None:
        self._scenes = scenes
        self.loads: list[int] = []
        self.chunk_numbers = scenes.chunk_numbers

    def load(self, number: int) -> ChunkScene:
        self.loads.append(number)
        return replace(self._scenes.load(number))


def test_actors_of_other_chunks_are_read_once(renderer: SceneRenderer, served: tuple[str, str]) -> None:
    """A source that has dropped a chunk gives it as another object with the same values."""
    source = FreshScenes(RunScenes(*served))
    chunks_by_track = renderer._facts.chunks_by_track
    placer = ActorPlacer(source, chunks_by_track, renderer._facts.names)
    wanted = [track_id for track_id, numbers in chunks_by_track.items() if 0 not in numbers]
    assert wanted
    extended = placer.gather(source.load(0), wanted)
    assert {actor.track_id for actor in extended.scene.actors} >= set(wanted)
    assert placer.gather(source.load(0), wanted) is extended
    assert source.loads == [0, 1, 0]
    # Other scenes of the same chunk have other actors; only the latest stay in memory.
    other = source.load(0)
    fewer = [replace(other, scene=replace(other.scene, actors=other.scene.actors[:count])) for count in (0, 1)]
    joined = [placer.gather(scene, wanted) for scene in fewer]
    assert joined[0] is not extended and joined[1] is not joined[0]
    assert placer.gather(fewer[1], wanted) is joined[1]
    assert placer.gather(source.load(0), wanted) is not extended


def test_recorded_actors_stand_next_to_placed_ones(renderer: SceneRenderer, served: tuple[str, str]) -> None:
    """Between two frames, too, where a placed actor would be elsewhere."""
    still = request_at(renderer, served, 2, "front_camera")
    request = replace(still, start_s=still.start_s + 0.03, end_s=still.start_s + 0.03)
    ids = tuple(actor.track_id for actor in renderer.actors())
    expected = renderer.render(request)
    assert difference(renderer.render(replace(request, actors=(), recorded_actors=ids)), expected) == 0
    empty = renderer.render(replace(request, actors=()))
    assert difference(empty, expected) > 10
    box = np.eye(4)
    box[:3, 3] = request.start_world_SE3_camera[:3, 3] + 4.0 * request.start_world_SE3_camera[:3, 2]
    placed = (ActorPose(ids[0], box, box),)
    alone = renderer.render(replace(request, actors=placed))
    both = renderer.render(replace(request, actors=placed, recorded_actors=ids[1:]))
    assert difference(both, alone) > 10 and difference(both, expected) > 10
    with pytest.raises(InputError, match="during a readout"):
        renderer.render(replace(request, end_s=request.end_s + 0.01, actors=(), recorded_actors=ids))


def sheared(chunk_scene: ChunkScene, request: ImageRequest, middle: Float64, velocity: Float64, frame: int) -> Image:
    """The same image by the renderer's own words: a pose in the middle, and velocities."""
    readout_s = request.end_s - request.start_s
    x, y, z = middle[:3, :3].T @ velocity
    shutter = RollingShutter(readout_s, velocity_m_s=(x, y, z), turn_rad_s=(0.0, 0.0, 0.0), frame_s=0.1)
    pose = np.linalg.inv(chunk_scene.chunk.world_SE3_chunk) @ middle
    view = RolloutView("front_camera", frame, pose, request.lens, shutter)
    with torch.no_grad():
        return to_pixels(render_views(chunk_scene.scene, [view]).color)[0]


def test_start_and_end_are_a_rolling_shutter(renderer: SceneRenderer, served: tuple[str, str]) -> None:
    still = request_at(renderer, served, 3, "front_camera")
    middle = still.start_world_SE3_camera
    velocity = 40.0 * middle[:3, 0]
    shift = np.zeros((4, 4))
    shift[:3, 3] = 0.03 * velocity
    moving = replace(
        still,
        start_world_SE3_camera=middle - shift,
        end_world_SE3_camera=middle + shift,
        start_s=still.start_s - 0.03,
        end_s=still.end_s + 0.03,
    )
    loaded = RunScenes(*served).load(0)
    expected = sheared(loaded, moving, middle, velocity, 3)
    image = renderer.render(moving)
    assert difference(image, renderer.render(still)) > 20
    assert difference(image, expected) <= 1
    # The actors' motion within the readout, stated by a simulator, is that which the log has.
    placed = []
    for actor in loaded.scene.actors:
        along, turn = actor.motion(3)
        assert np.abs(turn).max() < 0.05
        offset = np.zeros((4, 4))
        offset[:3, 3] = loaded.chunk.world_SE3_chunk[:3, :3] @ along * 0.3
        pose = actor.pose(3)
        assert pose is not None
        world = loaded.chunk.world_SE3_chunk @ pose
        placed.append(ActorPose(actor.track_id, world - offset, world + offset))
    assert difference(renderer.render(replace(moving, actors=tuple(placed))), expected) <= 3
    resting = tuple(ActorPose(p.track_id, *[(p.start_world_SE3_box + p.end_world_SE3_box) / 2] * 2) for p in placed)
    fast = [
        replace(p, start_world_SE3_box=p.end_world_SE3_box - 30 * (p.end_world_SE3_box - p.start_world_SE3_box))
        for p in placed
    ]
    images = renderer.render_batch([replace(moving, actors=tuple(actors)) for actors in (fast, resting)])
    assert difference(*images) > 5


def pose_with(entry: tuple[int, int], value: float) -> Float64:
    pose = np.eye(4)
    pose[entry] = value
    return pose


LENS = Lens(65.0, 65.0, 32.0, 18.0, 64, 36)
FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "no image": ({"lens": replace(LENS, width_px=0)}, "0 × 36 px"),
    "huge": ({"lens": replace(LENS, height_px=10**9)}, "1000000000 px is out of bounds"),
    "not finite lens": ({"lens": replace(LENS, cx_px=np.nan)}, "cx nan"),
    "fisheye": ({"lens": replace(LENS, fx_px=1.0)}, "fx of 1 px"),
    "telescope": ({"lens": replace(LENS, fy_px=1e9)}, "fy of 1e"),
    "far center": ({"lens": replace(LENS, cy_px=1e6)}, "cy of 1e"),
    "folding": ({"lens": replace(LENS, distortion=(-0.9,))}, "folds back"),
    "not finite distortion": ({"lens": replace(LENS, distortion=(np.inf,))}, "not finite"),
    "not finite pose": ({"end_world_SE3_camera": pose_with((0, 3), np.inf)}, "not finite"),
    "scaled": ({"start_world_SE3_camera": 2 * np.eye(4)}, "no rigid transform"),
    "mirrored": ({"start_world_SE3_camera": pose_with((0, 0), -1.0)}, "determinant is -1"),
    "shape": ({"start_world_SE3_camera": np.eye(3)}, "3 × 3"),
    "far": ({"start_world_SE3_camera": pose_with((0, 3), 1e8)}, "moves by 1e"),
    "time": ({"start_s": 5.0, "end_s": 5.0}, "5.000000 to 5.000000 s is outside of the run"),
    "not finite time": ({"start_s": np.nan}, "nan"),
    "backwards": ({"end_s": 0.0}, "readout of -"),
    "camera": ({"camera": "front_camer"}, "Did you mean 'front_camera'"),
    "actor": ({"actors": (ActorPose("lorry", np.eye(4), np.eye(4)),)}, "no actor 'lorry'"),
    "actor's number": ({"actors": (ActorPose("3", np.eye(4), np.eye(4)),)}, "no actor '3'"),
    "twice": ({"actors": (ActorPose("car-0", np.eye(4), np.eye(4)),) * 2}, "twice"),
    "actor's pose": ({"actors": (ActorPose("car-0", pose_with((1, 1), np.nan), np.eye(4)),)}, "'car-0' at the start"),
    "many actors": ({"actors": (ActorPose("car-0", np.eye(4), np.eye(4)),) * 1001}, "1001 actors"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_with_its_numbers(name: str, renderer: SceneRenderer, served: tuple[str, str]) -> None:
    sound = replace(request_at(renderer, served, 2, "front_camera"), lens=LENS)
    changes, words = FAULTS[name]
    with pytest.raises(InputError) as caught:
        renderer.render(replace(sound, **changes))
    assert words in str(caught.value)


def test_a_camera_far_away_or_too_many_images(renderer: SceneRenderer, served: tuple[str, str]) -> None:
    sound = request_at(renderer, served, 2, "front_camera")
    away = pose_with((0, 3), 1e8)
    with pytest.raises(InputError, match="km away from the recorded path"):
        renderer.render(replace(sound, start_world_SE3_camera=away, end_world_SE3_camera=away))
    with pytest.raises(InputError, match="33 images"):
        renderer.render_batch([sound] * 33)
    large = replace(sound, lens=sound.lens.resized(1920, 1280))
    with pytest.raises(InputError, match="79 megapixels"):
        renderer.render_batch([large] * 32)
    with pytest.raises(InputError, match="no camera"):
        renderer.ego_mask("rear")


def test_several_threads_get_their_own_images(renderer: SceneRenderer, served: tuple[str, str]) -> None:
    requests = [request_at(renderer, served, frame, "front_camera") for frame in (0, 4, 7, 11)] * 3
    expected = [renderer.render(request) for request in requests]
    with ThreadPoolExecutor(6) as pool:
        images = list(pool.map(renderer.render, requests))
    assert all(difference(one, other) == 0 for one, other in zip(images, expected, strict=True))
    assert renderer.queue_length == 0


def test_who_would_wait_too_long_is_refused() -> None:
    queue = RenderQueue(max_waiting=1)
    entered = threading.Event()
    leave = threading.Event()

    def occupy() -> None:
        with queue.turn():
            entered.set()
            leave.wait(30)

    threads = [threading.Thread(target=occupy) for _ in range(2)]
    for thread in threads:
        thread.start()
    assert entered.wait(30)
    wait_until(lambda: queue.length == 2, "the second request does not wait")
    with pytest.raises(ResourceError, match="busy: 1 requests wait, and 1 may"), queue.turn():
        pass
    leave.set()
    for thread in threads:
        thread.join()
    with queue.turn():
        assert queue.length == 1


def test_renderers_of_several_runs_take_turns() -> None:
    queues = [RenderQueue(max_waiting=0), RenderQueue(max_waiting=0)]
    entered = threading.Event()

    def render() -> None:
        with queues[1].turn():
            entered.set()

    thread = threading.Thread(target=render)
    with queues[0].turn():
        thread.start()
        assert not entered.wait(0.2)
    thread.join(30)
    assert entered.is_set()


def test_a_renderer_describes_its_run(renderer: SceneRenderer, served: tuple[str, str]) -> None:
    times_s, poses = renderer.ego_trajectory()
    assert times_s.shape == (12,) and poses.shape == (12, 4, 4)
    assert np.allclose(renderer.time_range_s, times_s[[0, -1]]) and renderer.name == served[1]
    assert np.allclose(np.diff(times_s), renderer.frame_s, atol=1e-6)
    request = request_at(renderer, served, 8, "front_camera")
    rig = renderer.cameras["front_camera"].rig_SE3_camera
    assert np.allclose(poses[8] @ rig, request.start_world_SE3_camera, atol=1e-6)
    names = [actor.name for actor in renderer.actors()]
    assert names[0] == "car-1" and len(set(names)) == len(names) == 7
    mask = renderer.ego_mask("front_camera")
    assert mask is not None and mask.shape == (36, 64) and not mask[:18].any()


def test_limits_are_the_services(served: tuple[str, str]) -> None:
    narrow = SceneRenderer(*served, limits=RenderLimits(max_width_px=32))
    with pytest.raises(InputError, match="1 × 1 to 32 ×"):
        narrow.render(request_at(narrow, served, 0, "front_camera"))


def test_an_edited_run_keeps_the_names_of_the_recorded_one(served: tuple[str, str]) -> None:
    store, run = served
    edits = EditList(edits=(Remove(actor="car-1"), Move(actor="car-3", left_m=1.0)))
    edited = SceneRenderer(store, write_edited_run(store, run, edits)["run"])
    names = {actor.track_id: actor.name for actor in edited.actors()}
    assert "car-1" not in names.values() and names["car-1"] == "car-2" and names["car-2"] == "car-3"
    request = request_at(edited, served, 2, "front_camera")
    box = request.start_world_SE3_camera @ pose_with((2, 3), 8.0)
    edited.render(replace(request, actors=(ActorPose("car-3", box, box),)))
    # The log's own car-0 is the removed car-1.
    with pytest.raises(InputError, match="no actor 'car-0'"):
        edited.render(replace(request, actors=(ActorPose("car-0", box, box),)))
