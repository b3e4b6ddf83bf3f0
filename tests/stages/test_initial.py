"""The initial scene, LiDAR depth and novel views on the fake log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from genre_tasks.config import IngestConfig, InitialConfig, NovelViewsConfig
from genre_tasks.errors import InputError
from genre_tasks.render import render_views
from genre_tasks.scene.chunk import Chunk, Points
from genre_tasks.scene.distant_shell import fibonacci_directions
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC
from genre_tasks.scene.image_decoding import decode_image
from genre_tasks.scene.initial_gaussians import MAX_SCALE_M, estimate_surface_axes
from genre_tasks.scene.lidar_depth import compute_lidar_depth
from genre_tasks.scene.lidar_map import build_lidar_scene
from genre_tasks.scene.novel_poses import find_nearest_reference, place_novel_views
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.scene.rotations import quats_to_matrices_numpy
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial
from genre_tasks.stages.novel_views import novel_views
from tests.fakes import FakeLog

CONFIG = InitialConfig(max_points=8000, distant_count=500)


@pytest.fixture(scope="module")
def log() -> FakeLog:
    return FakeLog()


@pytest.fixture(scope="module")
def chunk(log: FakeLog) -> Chunk:
    return ingest(IngestConfig(width_px=96, height_px=64), log, 0)


@pytest.fixture(scope="module")
def reconstruction(chunk: Chunk) -> Reconstruction:
    return initial(CONFIG, chunk)


def _psnr(image: torch.Tensor, truth: torch.Tensor) -> float:
    return float(-10 * ((image.clamp(0, 1) - truth) ** 2).mean().log10())


def test_counts_and_finiteness(reconstruction: Reconstruction) -> None:
    nodes = reconstruction.scene.nodes
    near = int((nodes != DISTANT).sum())
    assert 0.9 * CONFIG.max_points < near <= CONFIG.max_points
    assert int((nodes == DISTANT).sum()) == 500 and int((nodes == FIRST_ACTOR).sum()) > 100
    assert reconstruction.scene.gaussians.pack().isfinite().all()
    assert reconstruction.scene.gaussians.pack().dtype == torch.float32


def test_same_bytes_again(chunk: Chunk, reconstruction: Reconstruction) -> None:
    again = initial(CONFIG, chunk).scene.gaussians.pack()
    assert torch.equal(again, reconstruction.scene.gaussians.pack())


def test_discs_lie_on_their_surfaces(chunk: Chunk, reconstruction: Reconstruction) -> None:
    g = reconstruction.scene.gaussians
    static = reconstruction.scene.nodes == STATIC
    world = g.means[static].double().numpy() + chunk.world_SE3_chunk[:3, 3]
    normal = quats_to_matrices_numpy(g.quats[static].double().numpy())[:, :, 2]
    scales = g.log_scales[static].exp().numpy()
    floor = (np.abs(world[:, 2]) < 0.02) & (np.abs(world[:, 1]) < 6.5) & (np.abs(world[:, 0]) < 12)
    assert np.median(np.abs(normal[floor, 2])) > 0.999
    assert np.median(scales[floor, 2] / scales[floor, 0]) < 0.1
    wall = (np.abs(world[:, 1] - 8) < 0.02) & (world[:, 2] > 1) & (world[:, 2] < 3.5) & (np.abs(world[:, 0]) < 12)
    assert np.median(np.abs(normal[wall, 1])) > 0.999


def test_principal_frames_are_rotations() -> None:
    cloud = np.random.default_rng(0).normal(size=(400, 3)) * [3.0, 1.0, 0.01]
    axes, spread = estimate_surface_axes(cloud[:50], cloud, 30)
    assert np.allclose(np.swapaxes(axes, 1, 2) @ axes, np.eye(3), atol=1e-9) and (np.linalg.det(axes) > 0).all()
    assert (np.diff(spread, axis=1) <= 0).all() and np.abs(axes[:, 2, 2]).min() > 0.99


def test_the_scene_resembles_heldout_images(chunk: Chunk, reconstruction: Reconstruction) -> None:
    views = chunk.views_with_role("heldout")[::5]
    images = render_views(reconstruction.scene, views).color
    scores = [_psnr(c, decode_image(v.image, 96, 64)) for c, v in zip(images, views, strict=True)]
    assert np.mean(scores) > 20


def test_the_sky_has_its_colour(reconstruction: Reconstruction) -> None:
    g = reconstruction.scene.gaussians
    distant = reconstruction.scene.nodes == DISTANT
    ahead = distant & (g.means[:, 0] > 0) & (g.means[:, 2] > 20)
    assert torch.allclose(g.colors[ahead].median(0).values, torch.tensor([0.45, 0.65, 0.9]), atol=0.005)


def test_fibonacci_directions_are_even() -> None:
    directions = fibonacci_directions(2000)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1) and directions[:, 2].min() > -0.081
    from scipy.spatial import cKDTree

    nearest = cKDTree(directions).query(directions, k=2)[0][:, 1]
    assert nearest.max() / nearest.min() < 2.5


def test_near_points_are_needed(chunk: Chunk) -> None:
    far = replace(chunk.static, positions=chunk.static.positions + np.float32(1000))
    with pytest.raises(InputError, match="within 100") as caught:
        initial(CONFIG, replace(chunk, static=far))
    assert "max_range_m" in caught.value.remedy


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_a_handful_of_points_is_enough(chunk: Chunk, count: int) -> None:
    at = np.random.default_rng(0).uniform(-5, 5, (count, 3)).astype(np.float32)
    few = Points(at, np.full((count, 3), 9, np.uint8), np.zeros(count, bool), np.zeros(count, np.int16))
    out = initial(CONFIG.model_copy(update={"distant_count": 0}), replace(chunk, static=few, actors=()))
    assert len(out.scene) == count and out.scene.gaussians.pack().isfinite().all()
    assert torch.allclose(out.scene.gaussians.colors, torch.tensor(0.5)), "no colour near: grey"


def test_lidar_depth_is_the_distance_along_the_axis(chunk: Chunk) -> None:
    view = next(v for v in chunk.views if v.camera == "left" and v.frame == 8)
    depth = compute_lidar_depth(chunk, view)
    assert depth.shape == (64, 96) and depth.dtype == torch.float32
    wall = depth[25:32][depth[25:32] > 7.5]
    assert len(wall) > 50 and torch.allclose(wall, torch.tensor(8.0), atol=0.01)


def test_lidar_depth_follows_the_actor(chunk: Chunk) -> None:
    (actor,) = chunk.actors
    view = next(v for v in chunk.views if v.camera == "front" and v.frame == 12)
    pose = np.linalg.inv(view.chunk_SE3_camera) @ actor.chunk_SE3_box[12]
    rear = pose[2, 3] - actor.size_m[0] / 2
    depth = compute_lidar_depth(chunk, view)
    assert ((depth - rear).abs() < 0.02).sum() > 5


def test_lidar_depth_without_a_sweep_is_zero(chunk: Chunk) -> None:
    keep = chunk.static.frames != 8
    static = Points(*(getattr(chunk.static, n)[keep] for n in ("positions", "colors", "colored", "frames")))
    view = next(v for v in chunk.views if v.frame == 8)
    assert float(compute_lidar_depth(replace(chunk, static=static, actors=()), view).abs().sum()) == 0


def test_novel_poses_and_references(chunk: Chunk) -> None:
    views = place_novel_views(chunk, (3.0, -3.0))
    assert len(views) == 2 * 10 and [v.shift_m for v in views] == [3.0] * 10 + [-3.0] * 10
    by_frame = {(v.camera, v.frame): v for v in chunk.views}
    for view in views:
        moved = view.chunk_SE3_camera[:3, 3] - by_frame[view.camera, view.frame].chunk_SE3_camera[:3, 3]
        assert np.allclose(moved, [0, view.shift_m, 0], atol=1e-9) and view.reference == (view.camera, view.frame)
    every = place_novel_views(chunk, (1.0,), chunk.frames)
    assert len(every) == 40 and {v.reference[1] for v in every} == {0, 4, 8, 12, 16}
    assert next(v for v in every if v.frame == 7).reference == ("front", 8)
    with pytest.raises(ValueError, match="expected frames of chunk 0, 0 to 19, got \\[99\\]"):
        place_novel_views(chunk, (1.0,), [99])


def test_shifts_take_turns(chunk: Chunk) -> None:
    both = place_novel_views(chunk, (3.0, -3.0))
    half = place_novel_views(chunk, (3.0, -3.0), every=2)
    # Source frames are 0, 4, 8, 12 and 16: the left side has the first, the right side the second.
    assert {(v.shift_m, v.frame) for v in half} == {(3.0, 0), (3.0, 8), (3.0, 16), (-3.0, 4), (-3.0, 12)}
    assert [v.frame for v in half if v.camera == "front"] == [0, 8, 16, 4, 12]
    poses = {(v.camera, v.frame, v.shift_m): v.chunk_SE3_camera for v in both}
    assert all(np.array_equal(v.chunk_SE3_camera, poses[v.camera, v.frame, v.shift_m]) for v in half)
    # However rare a shift is, the first one has the first frame.
    assert {(v.shift_m, v.frame) for v in place_novel_views(chunk, (3.0, -3.0), every=99)} == {(3.0, 0), (-3.0, 4)}


def test_reference_of_a_camera_without_images_is_the_nearest_other(chunk: Chunk) -> None:
    fronts = [v for v in chunk.views_with_role("source") if v.camera == "front"]
    left = next(v for v in chunk.views if v.camera == "left" and v.frame == 9)
    near = find_nearest_reference("left", left.chunk_SE3_camera, fronts)
    assert (near.camera, near.frame) == ("front", 8)


def test_novel_views_contract(log: FakeLog, chunk: Chunk, reconstruction: Reconstruction) -> None:
    calls: list[int] = []
    out = novel_views(
        NovelViewsConfig(lidar_max_points=20_000), chunk, reconstruction, progress=lambda d, t, n="": calls.append(d)
    )
    assert out.color.shape == (20, 64, 96, 3) and out.lidar_depth.shape == (20, 64, 96)
    assert float(out.alpha.min()) >= 0 and float(out.alpha.max()) <= 1 and calls == sorted(calls) and calls[-1] == 40
    scores, lidar_scores = [], []
    for n, view in enumerate(out.views):
        pose = view.chunk_SE3_camera.copy()
        pose[:3, 3] += chunk.world_SE3_chunk[:3, 3]
        truth = torch.from_numpy(log.render(pose, log.lens, view.frame)).float() / 255
        scores.append(_psnr(out.color[n], truth))
        solid = out.lidar_alpha[n] > 0.95
        lidar_scores.append(_psnr(out.lidar_color[n][solid], truth[solid]))
    assert np.mean(scores) > 18 and np.mean(lidar_scores) > 18
    assert 0 < out.culled["behind"] < 20 * len(reconstruction.scene) and out.lidar_culled["behind"] > 0
    left_wall = out.lidar_depth[0:10][1::2][:, 28, 48]
    assert torch.allclose(left_wall, torch.tensor(5.0), atol=0.3)


def test_lidar_scene_is_thinned_and_coloured(chunk: Chunk) -> None:
    scene = build_lidar_scene(chunk, 3000)
    scales = scene.gaussians.log_scales.exp()
    assert 2500 < len(scene) <= 3000 and float(scales.max()) <= MAX_SCALE_M
    assert float((scales[:, 2] / scales[:, 0]).median()) < 0.3  # discs on surfaces, not balls
    empty = Points(*(getattr(chunk.static, n)[:0] for n in ("positions", "colors", "colored", "frames")))
    assert len(build_lidar_scene(replace(chunk, static=empty, actors=()), 3000)) == 0
