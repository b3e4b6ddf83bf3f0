"""Edited scenes: what stays keeps its bytes, what moves stays on the ground, and who is turned shows the other side."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.errors import InputError
from genre_tasks.scene.graph import FIRST_ACTOR
from genre_tasks.scene_edits.actor_names import name_actors
from genre_tasks.scene_edits.edited_scenes import EditedScenes
from genre_tasks.scene_edits.edits import Insert, Move, Remove, Retime, Rotate, ScaleSpeed
from genre_tasks.scene_edits.ground import Ground
from genre_tasks.scene_edits.insertion import _PathLine
from genre_tasks.scene_edits.trajectories import rest_on_ground
from genre_tasks.srgb import srgb_to_linear
from tests.fakes import yaw_pose
from tests.scene_edits.edited_runs import (
    NO_SHADOW,
    SIZE_M,
    MadeRun,
    draw,
    draw_actor,
    edit,
    find_node,
    ground_distance,
    world_poses,
)


@pytest.fixture(scope="module")
def run() -> MadeRun:
    return MadeRun()


def test_round_trip_gives_the_same_bytes(run: MadeRun) -> None:
    edited = edit(
        run,
        Move(actor="car-1", forward_m=0.1),
        Move(actor="a", forward_m=0.2),
        Move(actor="1", forward_m=-0.3),
        Rotate(actor="car-1", degrees=270),
        Rotate(actor="car-1", degrees=90),
        ScaleSpeed(actor="car-1", factor=0.5),
        ScaleSpeed(actor="car-1", factor=2),
        Retime(actor="car-1", delay_s=0.3),
        Retime(actor="car-1", delay_s=-0.3),
    )
    for number in run.chunk_numbers:
        assert edited.load(number) is run.load(number)


def test_edits_of_edited_scenes_cancel_out(run: MadeRun) -> None:
    away = edit(run, Move(actor="car-1", left_m=3))
    back = edit(away, Move(actor="car-1", left_m=-3))
    assert not torch.equal(draw(away.load(0)), draw(run.load(0)))
    assert draw(back.load(0)).numpy().tobytes() == draw(run.load(0)).numpy().tobytes()


def test_actors_without_edits_keep_their_arrays(run: MadeRun) -> None:
    edited = edit(run, Remove(actor="car-1")).load(0)
    before = run.load(0)
    assert find_node(edited, "b") is find_node(before, "b")
    assert edited.chunk.actors == (before.chunk.actors[1],)
    kept = before.scene.nodes != FIRST_ACTOR
    assert torch.equal(edited.scene.gaussians.pack(), before.scene.gaussians.pack()[kept])
    assert torch.equal(edited.scene.spherical_harmonics, before.scene.spherical_harmonics[kept])
    assert edited.scene.nodes.unique().tolist() == [0, FIRST_ACTOR]


def test_removing_changes_no_other_pixel(run: MadeRun) -> None:
    before = run.load(0)
    edited = edit(run, Remove(actor="car-1")).load(0)
    # Where the actor has weight: a render of it in front of nothing.
    covered = draw_actor(before, "a").abs().sum(-1) > 0
    changed = (draw(before) != draw(edited)).any(-1)
    assert changed.any()
    assert not (changed & ~covered).any()
    assert [node.track_id for node in edited.removed] == ["a"]


@pytest.mark.parametrize("move", [Move(actor="a", forward_m=6, left_m=-2), Move(actor="a", left_m=1.5, up_m=0.5)])
def test_moved_actor_stays_on_a_slope(run: MadeRun, move: Move) -> None:
    edited = edit(run, move).load(0)
    recorded = world_poses(run.load(0), "a")
    moved = world_poses(edited, "a")
    for before, after in zip(recorded, moved, strict=True):
        assert ground_distance(after) == pytest.approx(move.up_m, abs=0.01)
        # The heading is level, so that metres count on the map.
        assert after[:2, 3] - before[:2, 3] == pytest.approx([move.forward_m, move.left_m], abs=1e-6)
        assert after[:3, :3] == pytest.approx(before[:3, :3], abs=0.01)
    assert edited.removed == (find_node(run.load(0), "a"),)


def test_moved_actor_is_upright_on_another_slope() -> None:
    x, y = np.meshgrid(np.arange(-10, 30, 0.4), np.arange(-5, 5, 0.4))
    # Level up to x = 10, then it rises by a tenth.
    height = np.maximum(x - 10, 0) / 10
    ground = Ground(np.stack([x, y, height], -1).reshape(-1, 3), np.array([[0.0, 0.0, 0.0]]))
    level = np.eye(4)[None]
    moved = level.copy()
    moved[0, 0, 3] = 22.0
    resting = rest_on_ground(moved, level, ground)[0]
    assert resting[2, 3] == pytest.approx(1.2, abs=0.02)
    assert resting[2, 0] / resting[0, 0] == pytest.approx(0.1, abs=0.01)


def test_rotated_actor_stays_where_it_was(run: MadeRun) -> None:
    before = world_poses(run.load(0), "a")
    after = world_poses(edit(run, Rotate(actor="a", degrees=90)).load(0), "a")
    assert np.array_equal(after[:, :3, 3], before[:, :3, 3])
    assert after[:, :3, 0] == pytest.approx(before[:, :3, 1], abs=1e-9)


def test_colours_turn_with_the_actor(run: MadeRun) -> None:
    """Turning actor and camera about the box's vertical axis shows the same, harmonics included."""
    unturned = edit(run, Move(actor="b", forward_m=0.5), Move(actor="b", forward_m=-0.499999)).load(0)
    turned = edit(run, Rotate(actor="b", degrees=70), Move(actor="b", forward_m=1e-6)).load(0)
    camera = run.load(0).chunk.views[0].chunk_SE3_camera
    a = find_node(unturned, "b").chunk_SE3_box[0]
    b = find_node(turned, "b").chunk_SE3_box[0]
    expected = draw_actor(unturned, "b", pose=camera)
    seen = draw_actor(turned, "b", pose=b @ np.linalg.inv(a) @ camera)
    assert expected.max() > 0.3
    assert seen.numpy() == pytest.approx(expected.numpy(), abs=0.01)


def test_inserted_actor_shows_its_other_side_at_180_degrees(run: MadeRun) -> None:
    """Both sides of car b are seen in the recording, so none is mirrored."""

    def draw_inserted(turn_deg: float) -> torch.Tensor:
        insert = Insert(actor="b", name="x", ahead_m=9, left_m=3, turn_deg=turn_deg, speed_m_s=0)
        return draw(edit(run, Remove(actor="a"), Remove(actor="b"), insert).load(0))

    def count(image: torch.Tensor, channel: int) -> int:
        others = [k for k in range(3) if k != channel]
        return int((image[..., channel] > image[..., others].amax(-1) + 0.2).sum())

    # To the left of the camera it shows its blue right side; turned around its red left side and its green front.
    right = draw_inserted(0)
    turned = draw_inserted(180)
    assert count(right, 2) >= 20
    assert count(right, 0) <= 3
    assert count(turned, 0) >= 20
    assert count(turned, 1) >= 5
    assert count(turned, 2) <= 3


def test_side_that_no_camera_saw_is_mirrored(run: MadeRun) -> None:
    edited = edit(run, Insert(actor="a", name="x")).load(0)
    rows = edited.scene.nodes == FIRST_ACTOR + 2
    means = edited.scene.gaussians.means[rows]
    colors = edited.scene.gaussians.colors[rows]
    on_left = means[:, 1] > 0.85
    # The red left side of car a was never seen, so that its blue right side takes its place.
    assert on_left.sum() == (means[:, 1] < -0.85).sum() == 32
    assert (colors[on_left][:, 2] > colors[on_left][:, 0]).all()


def test_inserted_actor_drives_along_the_path_on_the_ground(run: MadeRun) -> None:
    edited = edit(run, Insert(actor="a", name="taxi", ahead_m=5, left_m=-2, speed_m_s=10))
    poses = np.concatenate([world_poses(edited.load(number), "taxi") for number in (0, 1)])
    assert len(poses) == 12
    # 10 m/s at ten frames a second.
    assert np.diff(poses[:, 0, 3]) == pytest.approx(np.ones(11), abs=0.02)
    assert poses[0, :2, 3] == pytest.approx([5.0, -2.0], abs=0.2)
    assert [ground_distance(pose) for pose in poses] == pytest.approx(np.zeros(12), abs=0.02)
    assert edited.load(0).removed == ()


def test_a_path_is_as_long_as_its_vehicle_crept() -> None:
    x = np.cumsum(np.concatenate([[0.0], np.full(40, 0.03), np.full(10, 0.3), 0.01 * (-1.0) ** np.arange(20)]))
    path = EgoPath(0.03 * np.arange(len(x)), np.arange(float(len(x))), np.stack([yaw_pose(0, (k, 0, 0)) for k in x]))
    line = _PathLine(path)
    # What the vehicle jitters while it stands is no way, and the creeping before is one.
    assert line.length_at(50.0) == pytest.approx(4.2, abs=0.05) == line.length_at(70.0)
    places, _ = line.at(np.linspace(0, 4.0, 41), 0.0)
    assert np.diff(places[:, 0]) == pytest.approx(np.full(40, 0.1), abs=1e-6)


def test_oncoming_actor_drives_towards_the_vehicle(run: MadeRun) -> None:
    edited = edit(run, Insert(actor="a", name="x", ahead_m=30, turn_deg=180, speed_m_s=10))
    poses = world_poses(edited.load(0), "x")
    assert np.diff(poses[:, 0, 3]) == pytest.approx(-np.ones(5), abs=0.02)
    assert poses[0, 0, 0] < -0.9


def test_delayed_actor_follows_its_path(run: MadeRun) -> None:
    before = np.concatenate([world_poses(run.load(number), "a") for number in (0, 1)])
    edited = edit(run, Retime(actor="a", delay_s=0.2))
    after = np.concatenate([world_poses(edited.load(number), "a") for number in (0, 1)])
    assert after[2:, :3, 3] == pytest.approx(before[:-2, :3, 3], abs=1e-6)
    # Before its path begins it comes straight from behind, on the ground.
    assert after[0, 0, 3] == pytest.approx(before[0, 0, 3] - 2.0, abs=0.05)
    assert ground_distance(after[0]) == pytest.approx(0.0, abs=0.02)


def test_slower_actor_drives_the_same_path(run: MadeRun) -> None:
    edited = edit(run, ScaleSpeed(actor="a", factor=0.5))
    poses = np.concatenate([world_poses(edited.load(number), "a") for number in (0, 1)])
    assert np.diff(poses[:, 0, 3]) == pytest.approx(np.full(11, 0.5), abs=0.01)
    assert poses[:, 1, 3] == pytest.approx(np.full(12, 3.0))
    standing = edit(run, ScaleSpeed(actor="a", factor=0)).load(1)
    assert world_poses(standing, "a")[:, 0, 3] == pytest.approx(np.full(6, world_poses(run.load(0), "a")[0, 0, 3]))


def test_faster_actor_drives_on_where_its_path_ends(run: MadeRun) -> None:
    poses = world_poses(edit(run, ScaleSpeed(actor="a", factor=2)).load(1), "a")
    assert np.diff(poses[:, 0, 3]) == pytest.approx(np.full(5, 2.0), abs=0.05)
    assert [ground_distance(pose) for pose in poses] == pytest.approx(np.zeros(6), abs=0.03)


def test_earlier_actor_comes_into_a_chunk_where_it_never_was(run: MadeRun) -> None:
    edited = edit(run, Retime(actor="c", delay_s=-0.4)).load(0)
    node = find_node(edited, "c")
    assert node.frames.tolist() == [4, 5]
    assert int((edited.scene.nodes == FIRST_ACTOR + 2).sum()) >= 100
    assert edited.chunk.actors[2].track_id == "c"


def test_shape_follows_a_delayed_actor() -> None:
    run = MadeRun(deforming=True)
    before = run.load(0).scene.deformation
    after = edit(run, Retime(actor="a", delay_s=0.1)).load(0).scene.deformation
    assert before is not None
    assert after is not None
    assert torch.allclose(after.offsets_at([3.0]), before.offsets_at([2.0]))
    removed = edit(run, Remove(actor="b")).load(0).scene.deformation
    assert removed is not None
    assert torch.equal(removed.offsets, before.offsets)


@pytest.mark.parametrize(
    ("change", "frame", "frame_before"),
    [(Retime(actor="x", delay_s=0.2), 5.0, 3.0), (ScaleSpeed(actor="x", factor=0.5), 4.0, 3.0)],
)
def test_shape_follows_an_inserted_actor_at_its_new_times(change: object, frame: float, frame_before: float) -> None:
    run = MadeRun(deforming=True)
    edits = (Insert(actor="a", name="x", start_s=0.2, ahead_m=9, speed_m_s=10.0), Remove(actor="a"))
    before = edit(run, *edits).load(0).scene.deformation
    after = edit(run, *edits, change).load(0).scene.deformation
    assert before is not None
    assert after is not None
    assert torch.allclose(after.offsets_at([frame]), before.offsets_at([frame_before]), atol=1e-6)
    assert not torch.allclose(after.offsets_at([frame]), before.offsets_at([frame]), atol=1e-3)


def test_contact_shadow_darkens_the_ground_alone(run: MadeRun) -> None:
    insert = Insert(actor="a", name="x", ahead_m=9, left_m=0, speed_m_s=0)
    bare = edit(run, insert).load(0)
    shaded = edit(run, insert, config=SimulateConfig(contact_shadow=0.9)).load(0)
    darker = draw(bare) - draw(shaded)
    assert darker.max() > 0.05
    assert darker.min() > -0.02
    count = len(shaded.scene) - len(bare.scene)
    means = shaded.scene.gaussians.means[-count:]
    assert means[:, 2].numpy() == pytest.approx(np.full(count, -SIZE_M[2] / 2 + 0.04), abs=0.03)
    assert (means[:, :2].abs() <= torch.tensor(SIZE_M[:2]) * 0.6).all()


def test_an_actor_of_an_edited_run_leaves_its_shadow_behind(run: MadeRun) -> None:
    shaded = SimulateConfig(contact_shadow=0.9)
    moved = edit(run, Move(actor="b", left_m=0.1), config=shaded)
    counts = []
    for source in ("", "moved"):
        insert = Insert(actor="b", from_run=source or None, name="x", ahead_m=9, left_m=0, speed_m_s=0)
        edited = edit(run, insert, config=shaded, moved=moved).load(0)
        number = next(k for k, node in enumerate(edited.scene.actors) if node.track_id == "x")
        counts.append(int((edited.scene.nodes == FIRST_ACTOR + number).sum()))
    assert counts[0] == counts[1]


def test_actor_of_a_darker_run_is_brightened(run: MadeRun) -> None:
    dark = MadeRun(road_srgb=0.4)
    edited = edit(run, Insert(actor="a", from_run="dark", name="x"), dark=dark).load(0)
    last = edited.scene.gaussians.colors[-1].numpy()
    recorded = dark.load(0).scene.gaussians.colors[-1].numpy()
    gain = srgb_to_linear(0.5) / srgb_to_linear(0.4)
    assert srgb_to_linear(last) == pytest.approx(gain * srgb_to_linear(recorded), rel=1e-3)


def test_names_are_the_same_in_all_chunks(run: MadeRun) -> None:
    assert name_actors(run) == {"a": "car-1", "b": "car-2", "c": "pedestrian-3"}
    edited = edit(run, Remove(actor="car-1"), Insert(actor="car-2", name="taxi"))
    assert name_actors(edited) == {"a": "car-1", "b": "car-2", "c": "pedestrian-3", "taxi": "taxi"}


def test_inserted_actors_are_named_after_the_actor_however_it_is_written(run: MadeRun) -> None:
    for word in ("pedestrian-3", "3", "c", "ped"):
        assert name_actors(edit(run, Insert(actor=word)))["pedestrian-7"] == "pedestrian-7", word


def test_inserted_actors_are_edited_by_their_name(run: MadeRun) -> None:
    insert = Insert(actor="b", name="taxi", ahead_m=10, speed_m_s=0)
    plain = world_poses(edit(run, insert).load(0), "taxi")
    moved = world_poses(edit(run, insert, Move(actor="taxi", left_m=2)).load(0), "taxi")
    assert moved[:, 1, 3] - plain[:, 1, 3] == pytest.approx(np.full(6, 2.0), abs=1e-6)
    assert "taxi" not in {n.track_id for n in edit(run, insert, Remove(actor="taxi")).load(0).scene.actors}


@pytest.mark.parametrize(
    ("edits", "message"),
    [
        ((Remove(actor="a"), Remove(actor="caar-2")), "edit 2 (remove): there is no actor 'caar-2'. Did you mean"),
        ((Remove(actor="a"), Move(actor="a", left_m=1)), "edit 2 (move): 'a' was removed by edit 1"),
        ((Move(actor="car"),), "edit 1 (move): 2 actors begin with 'car': car-1, car-2"),
        ((Insert(actor="zzz"),), "edit 1 (insert): there is no actor 'zzz'"),
        ((Insert(actor="a", name="car-2"),), "edit 1 (insert): an actor 'car-2' is there already"),
        ((Insert(actor="a", name="x", start_s=9.0),), "would appear after 9 s, and the run ends at 1.1 s"),
    ],
)
def test_impossible_edits_are_named(run: MadeRun, edits: tuple[object, ...], message: str) -> None:
    with pytest.raises(InputError) as caught:
        edit(run, *edits)
    assert message in str(caught.value)


def test_no_edits_leave_the_source_alone(run: MadeRun) -> None:
    edited = edit(run, config=NO_SHADOW)
    assert isinstance(edited, EditedScenes)
    assert edited.load(0) is run.load(0)
