"""Refined camera poses: nearer to the truth of a street whose recorded poses err, and unmoved where nothing errs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from genre_tasks.config import EffectsConfig, IngestConfig, InitialConfig
from genre_tasks.effects import measurements, pose_refinement
from genre_tasks.effects.apply_plan import apply_plan, move_views
from genre_tasks.effects.plan import EFFECT_NAMES, plan_effects
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.synthetic.log import SyntheticStreet
from genre_tasks.logs.types import Lens
from genre_tasks.scene import alignment_step, pose_alignment
from genre_tasks.scene.alignment_step import AlignedImage, project_points
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.pose_alignment import PoseAlignment, align_poses
from genre_tasks.scene.projection import project
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial

EXACT = "synthetic:street?seed=903&cameras=3&samples=4&frames=8"
NOISY = EXACT + "&pose_noise_deg=0.4&pose_noise_m=0.1"
LATE = EXACT + "&camera_delay_s=0.05"
ONLY = EffectsConfig(**{name: "auto" if name == "pose_refinement" else "off" for name in EFFECT_NAMES})


@cache
def street(uri: str) -> SyntheticStreet:
    log = open_log(uri)
    assert isinstance(log, SyntheticStreet)
    return log


@cache
def chunk(uri: str) -> Chunk:
    return ingest(IngestConfig(width_px=320, height_px=180, source_every=2), street(uri), 0)


# The key is a chunk's identity: chunks are those of ``chunk``, which keeps them.
_found: dict[tuple[int, bool], PoseAlignment | None] = {}


def align_once(chunk: Chunk, *, coarse: bool = False, start: PoseAlignment | None = None) -> PoseAlignment | None:
    """``align_poses``, once for each chunk, and not in every test that plans its effects."""
    key = id(chunk), coarse
    if key not in _found:
        _found[key] = align_poses(chunk, coarse=coarse, start=start)
    return _found[key]


@pytest.fixture
def poses_found_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plans take the poses that an earlier test has found on the same chunk."""
    monkeypatch.setattr(measurements, "align_poses", align_once)
    monkeypatch.setattr(pose_refinement, "align_poses", align_once)


@cache
def aligned(uri: str) -> PoseAlignment:
    found = align_once(chunk(uri), start=align_once(chunk(uri), coarse=True))
    assert found is not None
    return found


def true_poses(uri: str) -> dict[tuple[str, int], np.ndarray]:
    chunk_SE3_world = np.linalg.inv(chunk(uri).world_SE3_chunk)
    return {
        (v.camera, v.frame): chunk_SE3_world @ street(uri).true_world_SE3_camera(v.camera, v.frame)
        for v in chunk(uri).views
    }


def displacement_px(uri: str, poses: dict[tuple[str, int], np.ndarray]) -> float:
    """By how far LiDAR returns are from where they are in the images, in the median."""
    true = true_poses(uri)
    errors = []
    for view in chunk(uri).views:
        points = chunk(uri).static.positions[chunk(uri).static.frames == view.frame].astype(float)
        pixels = []
        for pose in (poses[view.camera, view.frame], true[view.camera, view.frame]):
            local = (points - pose[:3, 3]) @ pose[:3, :3]
            ahead = np.where(local[:, 2:] > 3, local[:, 2:], np.nan)
            pixels.append(local[:, :2] / ahead * [view.lens.fx_px, view.lens.fy_px])
        errors.append(np.linalg.norm(pixels[0] - pixels[1], axis=1))
    return float(np.nanmedian(np.concatenate(errors)))


# A delay moves the whole rig along its path, which colours hardly tell: a part of it stays.
@pytest.mark.parametrize(("uri", "left"), [(NOISY, 0.6), (LATE, 0.8)])
def test_refined_poses_are_nearer_to_the_truth(uri: str, left: float) -> None:
    recorded = {(v.camera, v.frame): v.chunk_SE3_camera for v in chunk(uri).views}
    before = displacement_px(uri, recorded)
    after = displacement_px(uri, aligned(uri).poses)
    assert before > 0.8
    assert after < left * before


def test_poses_stay_rigid_and_held_out_views_have_them_too() -> None:
    poses = aligned(NOISY).poses
    assert set(poses) == {(v.camera, v.frame) for v in chunk(NOISY).views}
    for pose in poses.values():
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    # A held-out frame's motion of the rig is between those of its neighbours.
    rig = aligned(NOISY).rig
    frames = sorted({v.frame for v in chunk(NOISY).views_with_role("source")})
    view = next(v for v in chunk(NOISY).views if v.role == "heldout" and frames[0] < v.frame < frames[1])
    ego = chunk(NOISY).chunk_SE3_ego[chunk(NOISY).frames.index(view.frame)]
    mount = aligned(NOISY).mounts[chunk(NOISY).camera_names.index(view.camera)]
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec(mount[:3]).as_matrix()
    turned[:3, 3] = mount[3:]
    in_rig = np.linalg.inv(ego) @ poses[view.camera, view.frame] @ np.linalg.inv(turned)
    found = in_rig @ np.linalg.inv(np.linalg.inv(ego) @ view.chunk_SE3_camera)
    np.testing.assert_allclose(found[:3, 3], (rig[0, 3:] + rig[1, 3:]) / 2, atol=1e-6)


@pytest.mark.parametrize("wrong_s", [0.0, float("nan"), 1e9])
def test_a_wrong_clock_gives_no_view_the_motion_of_another_frame(wrong_s: float) -> None:
    frames = sorted({view.frame for view in chunk(EXACT).views_with_role("source")})
    odd = replace(
        chunk(EXACT),
        views=tuple(
            replace(view, timestamp_s=wrong_s) if view.frame == frames[1] and view.camera == "front_camera" else view
            for view in chunk(EXACT).views
        ),
    )
    rig = np.zeros((len(frames), 6))
    rig[:, 3] = np.arange(len(frames))
    mounts = np.zeros((len(odd.camera_names), 6))

    def moved(of: Chunk) -> dict[tuple[str, int], np.ndarray]:
        sources = of.views_with_role("source")
        ego = np.eye(4)
        images = [AlignedImage(v, v.lens, np.zeros((1, 1), np.float32), ego, 0, frames.index(v.frame)) for v in sources]
        return pose_alignment._interpolate(of, images, mounts, rig)

    expected = moved(chunk(EXACT))
    for place, pose in moved(odd).items():
        np.testing.assert_allclose(pose, expected[place], atol=1e-4)


def test_the_same_chunk_has_the_same_poses() -> None:
    # A third of the views takes a third of the time.
    frames = sorted({view.frame for view in chunk(NOISY).views_with_role("source")})[:2]
    few = replace(chunk(NOISY), views=tuple(view for view in chunk(NOISY).views if view.frame in frames))
    first, again = align_poses(few), align_poses(few)
    assert first is not None and again is not None and len(first.poses) == len(few.views) == 6
    assert all(np.array_equal(again.poses[key], pose) for key, pose in first.poses.items())


@pytest.mark.usefixtures("poses_found_once")
def test_an_exact_street_is_off_by_its_gate_and_keeps_its_bytes() -> None:
    plan = plan_effects(ONLY, chunk(EXACT), street(EXACT).cameras)
    decision = plan["pose_refinement"]
    assert decision.choice == "off" and decision.value < pose_refinement.EFFECT.threshold
    none = plan_effects(ONLY.model_copy(update={"pose_refinement": "off"}), chunk(EXACT), street(EXACT).cameras)
    config = InitialConfig(max_points=2000, distant_count=200)
    scenes = [initial(config, chunk(EXACT), p).scene.gaussians.pack() for p in (plan, none)]
    assert torch.equal(*scenes)


@pytest.mark.usefixtures("poses_found_once")
def test_a_noisy_street_is_on_and_its_views_are_moved_before_other_effects_look_at_them() -> None:
    settings = ONLY.model_copy(update={"multi_view_stereo": "auto"})
    plan = plan_effects(settings, chunk(NOISY), street(NOISY).cameras)
    assert plan["pose_refinement"].choice == "on"
    moved = apply_plan(chunk(NOISY), plan)
    assert all(np.array_equal(v.chunk_SE3_camera, aligned(NOISY).poses[v.camera, v.frame]) for v in moved.views)
    # The other effect has measured at the moved poses.
    alone = ONLY.model_copy(update={"pose_refinement": "off", "multi_view_stereo": "auto"})
    at_moved = plan_effects(alone, move_views(chunk(NOISY), plan.parameters.poses), street(NOISY).cameras)
    assert plan["multi_view_stereo"].value == at_moved["multi_view_stereo"].value


@pytest.mark.usefixtures("poses_found_once")
def test_the_gate_flips_at_its_threshold(monkeypatch: pytest.MonkeyPatch) -> None:
    coarse = align_once(chunk(NOISY), coarse=True)
    assert coarse is not None
    for factor, choice in ((0.98, "on"), (1.02, "off")):
        threshold = factor * coarse.displacement_px
        monkeypatch.setattr(pose_refinement, "EFFECT", replace(pose_refinement.EFFECT, threshold=threshold))
        assert plan_effects(ONLY, chunk(NOISY), street(NOISY).cameras)["pose_refinement"].choice == choice


def test_images_that_are_too_coarse_are_left_alone() -> None:
    small = ingest(IngestConfig(width_px=160, height_px=90, source_every=2), street(NOISY), 0)
    decision = plan_effects(ONLY, small, street(NOISY).cameras)["pose_refinement"]
    assert decision.choice == "off" and "160×90 pixels are too coarse" in decision.reason


@pytest.mark.parametrize("size_px", [(320, 180), (302, 190), (304, 190), (278, 208), (436, 132)])
def test_images_of_every_shape_are_fine_enough_with_as_many_pixels(size_px: tuple[int, int]) -> None:
    still = SimpleNamespace(displacement_px=0.25)
    shaped = SimpleNamespace(width_px=size_px[0], height_px=size_px[1])
    measurements = SimpleNamespace(chunk=shaped, source_views=range(15), coarse_alignment=still)
    assert pose_refinement.measure(measurements).value == 0.25  # type: ignore[arg-type]


def test_many_images_are_smaller_and_share_their_points(monkeypatch: pytest.MonkeyPatch) -> None:
    views = chunk(NOISY).views_with_role("source")
    taken: list[tuple[int, int, int]] = []

    def record(
        points: np.ndarray, observed: np.ndarray, images: list[AlignedImage], *rest: object
    ) -> tuple[object, ...]:
        taken.append((len(points), images[0].luma.size, len(images)))
        return rest[1:]

    monkeypatch.setattr(pose_alignment, "take_step", record)
    monkeypatch.setattr(pose_alignment, "MAX_PIXELS", 100_000)
    monkeypatch.setattr(pose_alignment, "MAX_OBSERVATIONS", 9_000)
    assert align_poses(chunk(NOISY)) is not None
    assert {count for _, _, count in taken} == {len(views)}
    assert all(points * count <= 9_000 and size * count <= 102_000 for points, size, count in taken)


def test_without_common_points_nothing_is_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    lone = replace(chunk(EXACT), views=chunk(EXACT).views_with_role("source")[:1])
    assert align_poses(lone) is None
    monkeypatch.setattr(measurements, "align_poses", lambda *_, **__: None)
    decision = plan_effects(ONLY, chunk(EXACT), street(EXACT).cameras)["pose_refinement"]
    assert decision.choice == "off" and "the same LiDAR points" in decision.reason


def test_points_at_the_border_of_images_alone_refine_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    # Wider than the images: points are seen, and none of them is well inside.
    monkeypatch.setattr(alignment_step, "_BORDER_PX", 10_000)
    # At the last blur: what is not finite would be found out at the next one.
    monkeypatch.setattr(pose_alignment, "COARSE_BLURS_PX", (4.0,))
    monkeypatch.setattr(pose_alignment, "BLURS_PX", (4.0,))
    for setting, choice in (("auto", "off"), ("on", "on")):
        config = ONLY.model_copy(update={"pose_refinement": setting})
        plan = plan_effects(config, chunk(EXACT), street(EXACT).cameras)
        assert plan["pose_refinement"].choice == choice
        assert "no two source images see the same LiDAR points" in plan["pose_refinement"].reason
        assert not plan.parameters.poses


def test_the_images_of_one_camera_do_not_move_the_poses_of_an_exact_street() -> None:
    uri = "synthetic:street?seed=12&samples=1&lidar_beams=32&lidar_azimuths=300"
    config = IngestConfig(width_px=320, height_px=180, cameras=("front_camera",))
    decision = plan_effects(ONLY, ingest(config, street(uri), 0), street(uri).cameras)["pose_refinement"]
    assert decision.choice == "off" and decision.reason == "5 source images are too few to tell"


@pytest.mark.parametrize("blur_px", pose_alignment.BLURS_PX)
def test_means_of_the_surroundings_stay_in_place(blur_px: float) -> None:
    image = np.zeros((101, 101), np.float32)
    image[50, 50] = 1
    averaged = pose_alignment._average_surround(image, blur_px)
    assert np.allclose(averaged, averaged[::-1, ::-1], atol=1e-7)


def test_points_that_a_lens_folds_back_are_in_no_image() -> None:
    lens = Lens(200.0, 200.0, 160.0, 90.0, 320, 180, (-0.3, 0.0, 0.0, 0.0, 0.0))
    angle = np.radians(np.linspace(-80, 80, 161))
    points = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], 1) * 10
    inside = project_points(points, np.eye(4), lens)[3]
    seen = project(points.astype(np.float32), np.eye(4), lens).index
    assert inside.sum() > 50 and set(np.flatnonzero(inside)) <= set(seen.tolist())
