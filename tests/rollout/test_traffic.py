"""Traffic over the border of two chunks: tracks go on, looks and coordinates stay right, no actor doubles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.rollout.chunk_layout import ChunkLayout
from genre_tasks.rollout.handover import Handover
from genre_tasks.rollout.traffic import compose_scene, extend_traffic
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Actor, Chunk, Points
from genre_tasks.scene.deformation import NODES, Deformation
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene_edits.chunk_scene import ChunkScene

NO_POINTS = Points(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, bool), np.zeros(0, np.int16))


def drive(frames: range, origin: float) -> np.ndarray:
    """Boxes that are at x = frame in the world, in coordinates of a chunk."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, 0, 3] = np.array(frames) - origin
    return poses


def chunk_scene(index: int, frames: range, origin: float, names: str, sh_count: int | None) -> ChunkScene:
    """Two static Gaussians, one distant one, and one for each actor, whose red is the chunk's number."""
    nodes = torch.tensor([0, 0, 1, *(FIRST_ACTOR + k for k in range(len(names)))])
    packed = torch.zeros(len(nodes), 14)
    packed[:, 6] = 1.0
    packed[:, 11] = float(index)
    tracks = [(name, np.array(frames), drive(frames, origin)) for name in names]
    actors = tuple(ActorNode(name, "car", (4.0, 2.0, 1.5), f, p) for name, f, p in tracks)
    world_SE3_chunk = np.eye(4)
    world_SE3_chunk[0, 3] = origin
    deformation = Deformation.zero(actors, (0,), tuple(frames))
    deformation = deformation.with_offsets(torch.full((1, len(frames), NODES, 3), float(index + 1)))
    chunk = Chunk(
        dataset="test",
        log="test",
        index=index,
        frames=tuple(frames),
        camera_names=(),
        width_px=64,
        height_px=36,
        world_SE3_chunk=world_SE3_chunk,
        chunk_SE3_ego=drive(frames, origin),
        views=(),
        static=NO_POINTS,
        actors=tuple(Actor(name, "car", (4.0, 2.0, 1.5), f, p, NO_POINTS) for name, f, p in tracks),
        log_issues=(),
    )
    harmonics = None if sh_count is None else torch.full((len(nodes), sh_count, 3), float(index + 1))
    return ChunkScene(chunk, SceneGraph(Gaussians.unpack(packed), nodes, actors, False, deformation, harmonics))


BEFORE = chunk_scene(0, range(0, 4), 0.0, "ab", None)
AFTER = chunk_scene(1, range(4, 8), 5.0, "cb", 3)


def test_actors_drive_on_over_the_border() -> None:
    extended = extend_traffic(BEFORE, AFTER)
    scene = extended.scene
    assert [actor.track_id for actor in scene.actors] == ["a", "b", "c"]
    assert [actor.track_id for actor in extended.chunk.actors] == ["a", "b", "c"]
    a, b, c = scene.actors
    assert list(a.frames) == [0, 1, 2, 3] and list(b.frames) == list(range(8)) and list(c.frames) == [4, 5, 6, 7]
    # In coordinates of the first chunk, without a step where the second one takes over.
    assert np.allclose(b.chunk_SE3_box[:, 0, 3], np.arange(8)) and np.allclose(
        c.chunk_SE3_box[:, 0, 3], np.arange(4, 8)
    )
    # The actor of both chunks is there once, as the first chunk shows it; the new one comes with its Gaussian.
    assert scene.nodes.tolist() == [0, 0, 1, 2, 3, 4]
    assert scene.gaussians.colors[:, 0].tolist() == [0, 0, 0, 0, 0, 1]
    assert scene.spherical_harmonics is not None
    assert scene.spherical_harmonics[:, 0, 0].tolist() == [0, 0, 0, 0, 0, 2]


def test_a_deformation_goes_with_its_actor() -> None:
    deformation = extend_traffic(BEFORE, AFTER).scene.deformation
    assert deformation is not None and deformation.actors == (0, 2)
    before, after = deformation.offsets_at([6.0])[0]
    # Actor a keeps the last offsets that it has; c has those of its own chunk.
    assert before.unique().tolist() == [1.0] and after.unique().tolist() == [2.0]


def test_a_background_takes_the_actors_of_another_chunk() -> None:
    composed = compose_scene(BEFORE, AFTER)
    assert [actor.track_id for actor in composed.scene.actors] == ["c", "b"]
    assert composed.scene.nodes.tolist() == [0, 0, 1, 2, 3]
    assert composed.scene.gaussians.colors[:, 0].tolist() == [0, 0, 0, 1, 1]
    assert np.allclose(composed.scene.actors[1].chunk_SE3_box[:, 0, 3], np.arange(4, 8))
    assert composed.chunk.world_SE3_chunk[0, 3] == 0 and composed.chunk.frames == BEFORE.chunk.frames
    posed = composed.scene.gaussians_at(5.0)
    assert np.allclose(posed.means[4].numpy(), [5.0, 0.0, 0.0])


def test_what_was_removed_from_either_chunk_is_known() -> None:
    removed = tuple(replace(part, removed=part.scene.actors[:1]) for part in (BEFORE, AFTER))
    assert [track.track_id for track in compose_scene(*removed).removed] == ["a", "c"]
    assert [track.track_id for track in extend_traffic(*removed).removed] == ["a", "c"]


def test_contact_shadows_stay_known_as_such() -> None:
    shaded = [replace(part, shadow_counts={"b": 1, name: 1}) for part, name in ((BEFORE, "a"), (AFTER, "c"))]
    assert extend_traffic(*shaded).find_shadows().tolist() == [False] * 3 + [True] * 3
    assert compose_scene(*shaded).find_shadows().tolist() == [False] * 3 + [True] * 2
    assert compose_scene(shaded[1], BEFORE).find_shadows().tolist() == [False] * 5


def test_a_standing_vehicle_is_at_the_place_of_its_moment() -> None:
    positions = np.array([[0.0, 0.0], [1.0, 0.0], [1.001, 0.0], [1.0, 0.0], [2.0, 0.0]])
    facings = np.tile([1.0, 0.0], (5, 1))
    layout = ChunkLayout((0, 1), (0, 3), (2, 4), np.arange(5.0), positions, facings)
    # A path beside the recorded one that stands at x = 1 all the time.
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :2, 3] = (1.0, 3.0)
    places = layout.find_places(EgoPath(np.arange(5.0) / 10, np.arange(5.0), poses))
    assert np.allclose(places, [1, 1, 2, 3, 3], atol=0.05)
    assert layout.find_traffic(2) == (0,) and layout.find_traffic(2.4) == (0, 1) and layout.find_traffic(3) == (1,)


def make_path(x_m: list[float], y_m: float, frames: list[int], facing: float) -> EgoPath:
    poses = np.tile(np.eye(4), (len(x_m), 1, 1))
    poses[:, [0, 1], [0, 1]] = facing
    poses[:, 0, 3] = x_m
    poses[:, 1, 3] = y_m
    return EgoPath(0.1 * np.arange(len(x_m)), np.array(frames, np.float64), poses)


def test_a_place_is_in_the_lane_that_the_vehicle_drives_in() -> None:
    # Out along y = 0, a U-turn at x = 40, and back along y = 6.
    turn = np.linspace(-np.pi / 2, np.pi / 2, 7)
    out = np.stack([np.arange(0.0, 40.0, 2.0), np.zeros(20)], 1)
    arc = np.stack([40 + 3 * np.cos(turn), 3 + 3 * np.sin(turn)], 1)
    back = np.stack([out[::-1, 0], np.full(20, 6.0)], 1)
    headings = np.concatenate([np.zeros(20), turn + np.pi / 2, np.full(20, np.pi)])
    facings = np.stack([np.cos(headings), np.sin(headings)], 1)
    layout = ChunkLayout((0, 1), (0, 24), (23, 46), np.arange(47.0), np.concatenate([out, arc, back]), facings)
    x_m = [5.0, 11.0, 20.0, 33.0]
    frames = [2, 5, 10, 16]
    # Next to the other lane, whose poses are nearer.
    assert np.allclose(layout.find_places(make_path(x_m, 5.0, frames, 1.0)), np.array(x_m) / 2)
    assert np.allclose(layout.find_places(make_path(x_m, 1.0, frames, -1.0)), 46 - np.array(x_m) / 2)
    # A camera alone does not tell where its vehicle faces.
    assert layout.find_place(np.array([11.0, 5.0]), 5.0, None) == pytest.approx(40.5)


def test_who_turns_around_on_a_straight_street_stays_there() -> None:
    x = np.arange(0.0, 80.0, 2.0)
    # Where it ends the street bends back, far away from its beginning.
    facings = np.tile([1.0, 0.0], (40, 1))
    facings[-4:] = (-0.2, 0.98)
    layout = ChunkLayout((0,), (0,), (39,), np.arange(40.0), np.stack([x, np.zeros(40)], 1), facings)
    x_m = [5.0, 6.0, 20.5]
    places = [layout.find_places(make_path(x_m, 3.0, [2, 3, 10], facing)) for facing in (1.0, -1.0)]
    assert np.array_equal(*places) and np.allclose(places[0], np.array(x_m) / 2)


def test_who_turns_off_the_street_is_at_the_nearest_place() -> None:
    # At a right angle to the street, the jitter of recorded poses decides which of them look the other way.
    jitter = np.deg2rad(np.where(np.arange(40) % 2, 2.0, -2.0))
    positions = np.stack([np.arange(0.0, 80.0, 2.0), np.zeros(40)], 1)
    facings = np.stack([np.cos(jitter), np.sin(jitter)], 1)
    layout = ChunkLayout((0,), (0,), (39,), np.arange(40.0), positions, facings)
    for facing in (-1.0, 1.0):
        assert layout.find_place(np.array([22.0, 3.0]), 11.0, np.array([0.0, facing])) == pytest.approx(11.0)


def test_fades_of_background_and_traffic() -> None:
    fade = Handover(before=0, after=1, border_frame=3.5, start_frame=4.0, end_frame=6.0)
    assert [fade.weigh(place) for place in (3, 4.5, 6)] == [0, 0.25, 1]
    assert [fade.weigh_traffic(frame) for frame in (2, 3, 3.5, 5)] == [0, 0.25, 0.5, 1]
    cut = Handover(before=0, after=1, border_frame=3.5, start_frame=3.5, end_frame=3.5)
    assert [cut.weigh(place) for place in (3, 4)] == [0, 1]
