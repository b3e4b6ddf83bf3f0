"""Scenes as arrays of a viewer: poses, covariances, what is too large, and what the path sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from flows.viewer.path_colors import measure_path_colors
from flows.viewer.scene_nodes import MAX_SIGMA_M, SplatNode, build_scene_nodes, select_rows
from genre_tasks.config import IngestConfig, InitialConfig
from genre_tasks.logs.registry import open_log
from genre_tasks.render.api import compute_view_colors, render_views
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC, SceneGraph
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial

LOG = "synthetic:street?seed=900&frames=6&cameras=1&width=64&height=36&lidar_beams=32&lidar_azimuths=300&samples=1"


@pytest.fixture(scope="module")
def chunk() -> Chunk:
    return ingest(IngestConfig(width_px=64, height_px=36, chunk_frames=6), open_log(LOG), 0)


@pytest.fixture(scope="module")
def scene(chunk: Chunk) -> SceneGraph:
    return initial(InitialConfig(max_points=600, distant_count=100), chunk).scene


def build(scene: SceneGraph, chunk: Chunk, rows: list[int] | None = None) -> tuple[dict[str, SplatNode], str]:
    center = chunk.chunk_SE3_ego[:, :3, 3].mean(0)
    names = {actor.track_id: f"actor-{k}" for k, actor in enumerate(scene.actors)}
    taken = None if rows is None else np.array(rows)
    built = build_scene_nodes(scene, chunk.frames, names, center=center, rows=taken)
    return {node.name: node for node in built.nodes}, " ".join(built.losses)


def test_nodes_stand_where_the_scene_graph_puts_them(scene: SceneGraph, chunk: Chunk) -> None:
    nodes, losses = build(scene, chunk)
    assert not losses
    assert sum(map(len, nodes.values())) == len(scene)
    for row, frame in enumerate(chunk.frames):
        posed = scene.gaussians_at(frame)
        for k in range(len(scene.actors)):
            node = nodes[f"actor-{k}"]
            assert node.motion is not None
            if not node.motion.present[row]:
                continue
            pose = node.motion.scene_SE3_node[row]
            expected = posed.means[scene.nodes == FIRST_ACTOR + k].numpy()
            assert np.allclose(node.centers @ pose[:3, :3].T + pose[:3, 3], expected, atol=1e-4)
    assert any(node.motion is not None and node.motion.present.any() for node in nodes.values())
    assert np.allclose(nodes["background"].centers, scene.gaussians.means[scene.nodes == STATIC].numpy())


def test_covariances_have_the_scales_and_the_axes(scene: SceneGraph, chunk: Chunk) -> None:
    node = build(scene, chunk)[0]["background"]
    variances = np.sort(np.linalg.eigvalsh(node.covariances.astype(np.float64)), 1)
    mask = scene.nodes == STATIC
    scales = scene.gaussians.log_scales[mask].exp().numpy().astype(np.float64)
    assert np.allclose(variances, np.sort(scales, 1) ** 2, rtol=1e-3, atol=1e-6)
    quats = scene.gaussians.quats[mask][:, [1, 2, 3, 0]].numpy()
    axes = Rotation.from_quat(quats).as_matrix()
    along = np.einsum("nik,nij,njk->nk", axes, node.covariances, axes)
    assert np.allclose(along, scales**2, rtol=1e-3, atol=1e-5)


def enlarge(scene: SceneGraph, row: int, sigma_m: float, distance_m: float | None = None) -> SceneGraph:
    """One Gaussian with another size, and at another distance."""
    scales = scene.gaussians.log_scales.clone()
    scales[row] = float(np.log(sigma_m))
    means = scene.gaussians.means.clone()
    if distance_m is not None:
        means[row] *= distance_m / means[row].norm()
    return scene.with_gaussians(replace(scene.gaussians, log_scales=scales, means=means))


def test_a_distant_gaussian_that_float16_cannot_hold_is_drawn_nearer(scene: SceneGraph, chunk: Chunk) -> None:
    row = int(torch.nonzero(scene.nodes == DISTANT)[0])
    large = enlarge(scene, row, 800.0, 2000.0)
    nodes, losses = build(large, chunk)
    assert "1 Gaussians of the distant region are too large for the viewer and are drawn nearer" in losses
    node = nodes["distant"]
    assert np.isfinite(node.covariances.astype(np.float16)).all()
    center = chunk.chunk_SE3_ego[:, :3, 3].mean(0)
    before = large.gaussians.means[row].numpy() - center
    after = node.centers[0] - center
    # It is as large as before from the middle of the path, and in the same direction.
    sigma = np.sqrt(np.linalg.eigvalsh(node.covariances[0])).max()
    assert sigma == pytest.approx(MAX_SIGMA_M, rel=1e-3)
    assert sigma / np.linalg.norm(after) == pytest.approx(800.0 / np.linalg.norm(before), rel=1e-3)
    assert np.allclose(after / np.linalg.norm(after), before / np.linalg.norm(before), atol=1e-4)


def test_what_would_come_before_the_background_is_left_out_and_said(scene: SceneGraph, chunk: Chunk) -> None:
    row = int(torch.nonzero(scene.nodes == DISTANT)[0])
    nodes, losses = build(enlarge(scene, row, 50_000.0, 2000.0), chunk)
    assert len(nodes["distant"]) == 99
    assert "1 Gaussians are too large for the viewer and are left out" in losses
    row = int(torch.nonzero(scene.nodes == STATIC)[0])
    assert "too large" in build(enlarge(scene, row, 300.0), chunk)[1]


def test_values_that_are_not_finite_are_left_out_and_said(scene: SceneGraph, chunk: Chunk) -> None:
    means = scene.gaussians.means.clone()
    means[3, 1] = torch.nan
    nodes, losses = build(scene.with_gaussians(replace(scene.gaussians, means=means)), chunk)
    assert sum(map(len, nodes.values())) == len(scene) - 1
    assert "1 Gaussians hold values that are not finite" in losses


def test_a_limit_leaves_out_what_fills_least(scene: SceneGraph, chunk: Chunk) -> None:
    nodes, losses = build(scene, chunk, rows=[0, 1, 2])
    assert sum(map(len, nodes.values())) == 3
    assert f"{len(scene) - 3} of {len(scene)} Gaussians are left out" in losses


def test_a_limit_keeps_some_of_every_node() -> None:
    weights = np.concatenate([np.full(90, 100.0), np.arange(10.0)]).astype(np.float32)
    node_of = np.repeat([0, 2], [90, 10])
    rows = select_rows(weights, node_of, 80)
    assert len(rows) == 80
    assert rows[-2:].tolist() == [98, 99]
    assert (node_of[rows] == 0).sum() == 78


def test_weights_are_the_pixels_that_gaussians_fill(scene: SceneGraph, chunk: Chunk) -> None:
    measured = measure_path_colors(scene, chunk, shifts_m=(0.0,))
    with torch.no_grad():
        rendered = render_views(scene, place_novel_views(chunk, (0.0,), frames=chunk.frames))
    # A pixel's opacity is the sum of what all Gaussians add to it.
    assert measured.weights.sum() == pytest.approx(float(rendered.alpha.sum()), rel=1e-3)
    assert np.array_equal(measured.colors, np.clip(scene.gaussians.colors.numpy(), 0, 1))


def test_the_path_is_seen_where_there_are_images(scene: SceneGraph, chunk: Chunk) -> None:
    # Of six cameras and three shifts, few frames are taken: evenly spread over all of them, none would be frame 3.
    views = tuple(replace(view, role="source") for view in chunk.views if view.frame == 3)
    sparse = replace(chunk, views=views, camera_names=("front", "back", "left", "right", "near", "far"))
    weights = measure_path_colors(scene, sparse, shifts_m=(0.0, -3.0, 3.0)).weights
    with torch.no_grad():
        rendered = render_views(scene, place_novel_views(sparse, (0.0, -3.0, 3.0), frames=(3,)))
    assert weights.sum() == pytest.approx(float(rendered.alpha.sum()), rel=1e-3)


def test_a_gaussian_behind_a_wall_counts_for_nothing(scene: SceneGraph, chunk: Chunk) -> None:
    view = place_novel_views(chunk, (0.0,), frames=chunk.frames[:1])[0]
    means = scene.gaussians.means.clone()
    scales = scene.gaussians.log_scales.clone()
    logits = scene.gaussians.logit_opacities.clone()
    static = torch.nonzero(scene.nodes == STATIC)[:8, 0].tolist()
    ahead = torch.from_numpy(view.chunk_SE3_camera[:3, 2]).float()
    eye = torch.from_numpy(view.chunk_SE3_camera[:3, 3]).float()
    for k, row in enumerate(static):
        means[row] = eye + (3.0 if k else 40.0) * ahead
        scales[row] = float(np.log(3.0 if k else 0.5))
        logits[row] = 6.0
    built = replace(scene.gaussians, means=means, log_scales=scales, logit_opacities=logits)
    weights = measure_path_colors(scene.with_gaussians(built), chunk, shifts_m=(0.0,)).weights
    assert weights[static[0]] < 1e-3 * weights[static[1]]


def test_colours_are_those_that_the_path_sees(scene: SceneGraph, chunk: Chunk) -> None:
    generator = torch.Generator().manual_seed(0)
    harmonics = 0.1 * torch.randn(len(scene), 3, 3, generator=generator)
    bright = scene.with_spherical_harmonics(harmonics)
    one = replace(chunk, views=chunk.views[:1], frames=chunk.frames[:1], chunk_SE3_ego=chunk.chunk_SE3_ego[:1])
    measured = measure_path_colors(bright, one, shifts_m=(0.0,))
    view = place_novel_views(one, (0.0,), frames=one.frames)[0]
    seen = compute_view_colors(bright, [view])[0].numpy()
    moves = bright.nodes.numpy() >= FIRST_ACTOR
    visible = measured.weights > 0
    assert visible.sum() > 50
    assert np.allclose(measured.colors[~moves & visible], np.clip(seen, 0, 1)[: (~moves).sum()][visible[~moves]])
    assert np.allclose(measured.colors[moves & visible], np.clip(seen, 0, 1)[(~moves).sum() :][visible[moves]])
    assert not np.allclose(measured.colors[visible], scene.gaussians.colors.numpy()[visible], atol=0.01)
