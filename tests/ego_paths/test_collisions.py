"""Overlaps of boxes in the plane, and actors that are joined over chunks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from genre_tasks.ego_paths.collisions import EGO_SIZE_M, find_collisions, measure_overlap
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.world_actors import WorldActor, list_parked_actors, list_world_actors
from genre_tasks.logs.types import CuboidTrack
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Actor, Chunk
from tests.ego_paths.drives import drive, straight
from tests.fakes import yaw_pose
from tests.storage import artifact_values

SIZE_M = (4.0, 2.0, 1.5)


def car(
    x: float, y: float, *, speed: float = 0.0, yaw: float = 0.0, frames: range = range(40), z: float = 0.75
) -> WorldActor:
    """A car at (x, y) in frame 0 that drives along x, a frame being a tenth of a second."""
    poses = np.stack([yaw_pose(yaw, (x + 0.1 * speed * frame, y, z)) for frame in frames])
    return WorldActor("7", "Car", SIZE_M, np.array(frames), poses)


def overlap(x: float, y: float, yaw: float = 0.0) -> tuple[float, float]:
    """Of a rectangle of 4 × 2 m at the origin with the same one at (x, y)."""
    depth, gap = measure_overlap(
        np.zeros((1, 2)), np.zeros(1), (4.0, 2.0), np.array([[x, y]]), np.array([yaw]), (4.0, 2.0)
    )
    return float(depth[0]), float(gap[0])


@pytest.mark.parametrize(
    ("x", "y", "yaw", "depth", "gap"),
    [
        (3.5, 0.0, 0.0, 0.5, 0.0),
        (0.0, 1.5, 0.0, 0.5, 0.0),
        (0.0, 0.0, 0.0, 2.0, 0.0),
        (0.0, 2.5, np.pi / 2, 0.5, 0.0),
        (5.0, 0.0, 0.0, 0.0, 1.0),
        (7.0, 6.0, 0.0, 0.0, 5.0),
        # A corner that points at a side: half of the diagonal of 4 × 2 m, along 45°, is 1.5 √2 m.
        (2.0 + 1.5 * np.sqrt(2) + 0.3, 0.0, np.pi / 4, 0.0, 0.3),
        (2.0 + 1.5 * np.sqrt(2) - 0.3, 0.0, np.pi / 4, 0.3, 0.0),
    ],
)
def test_depth_and_gap_of_rectangles(x: float, y: float, yaw: float, depth: float, gap: float) -> None:
    assert overlap(x, y, yaw) == pytest.approx((depth, gap), abs=1e-9)


def test_overlap_is_symmetric_and_agrees_with_points_inside_of_both() -> None:
    rng = np.random.default_rng(0)
    count = 300
    center = rng.uniform(-4, 4, (count, 2))
    heading = rng.uniform(-4, 4, (2, count))
    one = (np.zeros((count, 2)), heading[0], (4.8, 2.0))
    other = (center, heading[1], (3.0, 1.0))
    depth, gap = measure_overlap(*one, *other)
    assert np.allclose(measure_overlap(*other, *one), (depth, gap))
    grid = np.stack(np.meshgrid(np.linspace(-1.5, 1.5, 61), np.linspace(-0.5, 0.5, 41)), axis=-1).reshape(-1, 2)
    for k in range(count):
        cosine, sine = np.cos(heading[1, k]), np.sin(heading[1, k])
        points = center[k] + grid @ np.array([[cosine, sine], [-sine, cosine]])
        cosine, sine = np.cos(heading[0, k]), np.sin(heading[0, k])
        local = np.abs(points @ np.array([[cosine, -sine], [sine, cosine]]))
        shared = bool(((local[:, 0] < 2.4) & (local[:, 1] < 1.0)).any())
        # Between two points of the grid a corner of a few centimetres may hide.
        assert shared == (depth[k] > 0) or depth[k] < 0.06
        assert (gap[k] > 0) == (depth[k] == 0)


def test_a_collision_has_its_first_time_and_its_deepest_overlap() -> None:
    # 10 m/s towards a car that stands 30 m ahead: 2.4 m + 2 m of half lengths remain after 25.6 m.
    (collision,) = find_collisions(straight(40, 10.0), [car(30.0, 0.5)], 0.0)
    assert collision.time_s == pytest.approx(2.6)
    assert collision.frame == 26
    # Deepest where both are level: across it is a shorter way out than along.
    assert collision.overlap_m == pytest.approx(1.5, abs=1e-9)
    assert str(collision) == "Car 7 at 2.6 s (frame 26), 1.50 m deep"


def test_a_start_inside_of_a_car_is_a_collision_at_once() -> None:
    (collision,) = find_collisions(straight(10, 5.0), [car(1.0, 0.0, speed=5.0)], 0.0)
    assert collision.time_s == 0.0
    assert collision.overlap_m == pytest.approx(2.0)


def test_actors_are_where_they_are_at_that_moment_of_the_log() -> None:
    path = straight(40, 10.0)
    assert find_collisions(path, [car(12.0, 0.0, speed=10.0)], 0.0) == ()
    assert find_collisions(path, [car(12.0, 0.0, speed=2.0)], 0.0)[0].time_s == pytest.approx(1.0)
    # Traffic that stands still in frame 0: the ego vehicle reaches where the other one was.
    frozen = replace(path, frames=np.zeros(40))
    assert find_collisions(frozen, [car(12.0, 0.0, speed=10.0)], 0.0)[0].time_s == pytest.approx(0.8)
    # It has left by then.
    assert find_collisions(path, [car(30.0, 0.0, frames=range(0, 20))], 0.0) == ()


@pytest.mark.parametrize("frame", [3.0, 3.25, 3.5, 3.75, 0.0, 7.0, 5.25, 6.75])
def test_boxes_are_where_renders_draw_the_actor(frame: float) -> None:
    rng = np.random.default_rng(1)
    frames = np.array([0, 1, 2, 3, 4, 5, 7])
    poses = np.stack([yaw_pose(3.0 + 0.1 * f, (f * 1.1, f**2 * 0.1, 0.5)) for f in frames])
    poses[:, :2, 3] += 0.05 * rng.standard_normal((7, 2))
    boxes = WorldActor("7", "Car", SIZE_M, frames, poses).place_boxes(np.array([frame]))
    drawn = ActorNode("7", "Car", SIZE_M, frames, poses).pose(frame)
    assert drawn is not None
    assert bool(boxes.exists[0])
    assert boxes.center_m[0] == pytest.approx(drawn[:2, 3], abs=1e-9)
    assert np.cos(boxes.heading_rad[0]) == pytest.approx(drawn[0, 0], abs=1e-9)


def test_the_margin_counts_boxes_that_come_near() -> None:
    path = straight(40, 10.0)
    beside = car(20.0, 2.4)
    assert find_collisions(path, [beside], 0.0) == ()
    assert find_collisions(path, [beside], 0.39) == ()
    (collision,) = find_collisions(path, [beside], 0.41)
    assert collision.overlap_m == 0.0
    assert collision.gap_m == pytest.approx(0.4)
    assert "0.40 m apart" in str(collision)


@pytest.mark.parametrize("origin_m", [0.0, 1.9])
def test_traffic_on_another_level_does_not_count(origin_m: float) -> None:
    path = straight(40, 10.0)
    path.world_SE3_ego[:, 2, 3] = origin_m
    assert len(find_collisions(path, [car(20.0, 0.0)], 0.0)) == 1
    assert find_collisions(path, [car(20.0, 0.0, z=6.0), car(20.0, 0.0, z=-6.0)], 0.0) == ()


def test_collisions_come_in_the_order_of_time() -> None:
    path = drive(60, lambda t: np.full_like(t, 8.0))
    actors = [replace(car(x, 0.0), actor_id=str(x)) for x in (30.0, 15.0, 22.0, 100.0)]
    assert [c.actor_id for c in find_collisions(path, actors, 0.0)] == ["15.0", "22.0", "30.0"]
    assert find_collisions(EgoPath(np.zeros(0), np.zeros(0), np.zeros((0, 4, 4))), actors, 0.0) == ()
    assert EGO_SIZE_M == (4.8, 2.0, 1.6)


def test_the_box_is_where_the_middle_of_the_vehicle_is() -> None:
    """Of logs whose origin is the rear axle, the bonnet is farther ahead, whichever way the vehicle looks."""
    path = straight(1, 10.0)
    ahead, behind = car(5.0, 0.0), car(-4.0, 0.0)
    assert find_collisions(path, [ahead], 0.0) == ()
    (collision,) = find_collisions(path, [ahead], 0.0, center_ahead_m=1.4)
    assert collision.overlap_m == pytest.approx(0.8)
    assert find_collisions(path, [behind], 0.0) != ()
    assert find_collisions(path, [behind], 0.0, center_ahead_m=1.4) == ()
    turned = replace(path, world_SE3_ego=path.world_SE3_ego @ yaw_pose(np.pi, (0.0, 0.0, 0.0)))
    assert find_collisions(turned, [car(-5.0, 0.0)], 0.0, center_ahead_m=1.4) != ()


def _chunk(frames: range, x: float, actors: dict[str, range]) -> Chunk:
    """Rebased to x, with actors that drive a metre a frame."""
    chunk = artifact_values.chunk(np.random.default_rng(0), frames=1, actors=0)
    made = []
    for track_id, there in actors.items():
        poses = np.stack([yaw_pose(0.0, (frame - x, 3.0, 0.75)) for frame in there])
        made.append(Actor(track_id, "Car", SIZE_M, np.array(there), poses, chunk.static))
    world_SE3_chunk = yaw_pose(0.0, (x, 0.0, 0.0))
    return replace(chunk, frames=tuple(frames), world_SE3_chunk=world_SE3_chunk, actors=tuple(made))


CHUNKS = (
    _chunk(range(0, 20), 10.0, {"a": range(0, 20), "b": range(5, 9)}),
    _chunk(range(20, 40), 30.0, {"c": range(20, 40), "a": range(20, 33)}),
)


def test_an_actor_of_two_chunks_is_one() -> None:
    actors = {actor.actor_id: actor for actor in list_world_actors(iter(CHUNKS))}
    assert list(actors) == ["a", "b", "c"]
    assert actors["a"].frames.tolist() == list(range(33))
    assert np.allclose(actors["a"].world_SE3_box[:, 0, 3], np.arange(33))


def test_parked_actors_are_what_chunks_take_for_background() -> None:
    def track(track_id: str, frames: range) -> CuboidTrack:
        poses = np.stack([yaw_pose(0.0, (5.0, 2.0, 0.75)) for _ in frames])
        return CuboidTrack(track_id, "Car", np.array(frames), poses, SIZE_M, moving=False)

    broken = track("e", range(0, 10))
    broken.world_SE3_box[3:] = np.nan
    tracks = [track("a", range(0, 40)), track("b", range(0, 40)), track("d", range(10, 60)), broken]
    parked = {actor.actor_id: actor for actor in list_parked_actors(tracks, CHUNKS)}
    assert {name: (a.frames[0], a.frames[-1]) for name, a in parked.items()} == {
        "b": (20, 39),
        "d": (10, 39),
        "e": (0, 2),
    }
