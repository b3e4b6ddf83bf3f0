"""Masks by weight and optical flow, of two actors in front of a wall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.logs.types import Float64, Lens, RollingShutter
from genre_tasks.render.types import RenderSettings
from genre_tasks.rollout.instance_masks import (
    DISTANT_CLASS,
    EMPTY_CLASS,
    STATIC_CLASS,
    Masks,
    is_in_view,
    render_masks,
    render_node_weights,
)
from genre_tasks.rollout.optical_flow import compute_flow
from genre_tasks.rollout.render_rollout import RolloutImages
from genre_tasks.rollout.rig import RolloutView
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC, SceneGraph
from genre_tasks.scene_edits.chunk_scene import ChunkScene
from genre_tasks.scene_edits.edits import Insert
from tests.lidar_simulation.spinning_lidar import build_chunk
from tests.scene_edits.edited_runs import MadeRun, draw, edit

LENS = Lens(60.0, 60.0, 32.0, 18.0, 64, 36)
SETTINGS = RenderSettings("reference")
WALL_Z_M = 10.0
ACTOR_Z_M = 6.0
CHUNK = build_chunk((0,))


def square(z_m: float, half_m: float, center: tuple[float, float] = (0.0, 0.0), spacing: float = 0.25) -> Gaussians:
    """Flat Gaussians at right angles to z."""
    x, y = torch.meshgrid(*[torch.arange(-half_m, half_m, spacing) + spacing / 2] * 2, indexing="ij")
    count = x.numel()
    means = torch.stack([x.reshape(-1) + center[0], y.reshape(-1) + center[1], torch.full((count,), z_m)], 1)
    scales = torch.tensor([0.6 * spacing, 0.6 * spacing, 0.005]).log().expand(count, 3)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    return Gaussians(means, scales, quats, torch.full((count,), 4.0), torch.full((count, 3), 0.5))


def actor(name: str, x_m: float, step_m: float, label: str, frames: tuple[int, ...] = (0, 1)) -> ActorNode:
    poses = np.repeat(np.eye(4)[None], len(frames), axis=0)
    poses[:, :3, 3] = [[x_m + step_m * frame, 0.0, ACTOR_Z_M] for frame in frames]
    return ActorNode(name, label, (1.5, 1.5, 0.1), np.array(frames), poses)


def build_scene(actors: tuple[ActorNode, ...]) -> SceneGraph:
    parts = [square(WALL_Z_M, 4.0), square(60.0, 40.0, spacing=5.0), *(square(0.0, 0.75) for _ in actors)]
    nodes = [STATIC, DISTANT, *(FIRST_ACTOR + k for k in range(len(actors)))]
    numbers = torch.cat([torch.full((len(p),), n, dtype=torch.int64) for p, n in zip(parts, nodes, strict=True)])
    return SceneGraph(Gaussians.unpack(torch.cat([part.pack() for part in parts])), numbers, actors)


def images_at(scene: SceneGraph, frame: int, shift_m: float = 0.0) -> RolloutImages:
    pose = np.eye(4)
    pose[0, 3] = shift_m
    view = RolloutView("front", float(frame), pose, LENS)
    nothing = torch.zeros(1, LENS.height_px, LENS.width_px)
    return RolloutImages(frame, (view,), ChunkScene(CHUNK, scene), nothing[..., None], nothing, nothing)


def two_actors() -> SceneGraph:
    return build_scene((actor("a", -1.2, 0.3, "van"), actor("b", 1.2, 0.0, "car")))


def rectangle(x_m: float) -> tuple[slice, slice]:
    """Pixels well within an actor at x."""
    middle = 32 + 60 * x_m / ACTOR_Z_M
    return slice(15, 21), slice(int(middle) - 4, int(middle) + 4)


def test_weights_sum_up_to_alpha():
    from genre_tasks.render import render_views

    images = images_at(two_actors(), 0)
    weights = render_node_weights(images, SETTINGS)
    assert weights.nodes == (STATIC, DISTANT, FIRST_ACTOR, FIRST_ACTOR + 1)
    alpha = render_views(images.chunk_scene.scene, images.views, SETTINGS).alpha
    assert (weights.alpha - alpha).abs().max() < 1e-5
    assert (weights.weights >= 0).all()


def test_pixels_show_the_node_that_contributes_most():
    masks = render_masks(images_at(two_actors(), 0), SETTINGS)
    assert masks.class_names == ("empty", "static", "distant", "car", "van")
    assert (masks.instances[0][rectangle(-1.2)] == 1).all()
    assert (masks.instances[0][rectangle(1.2)] == 2).all()
    assert (masks.classes[0][rectangle(-1.2)] == 4).all()
    assert (masks.classes[0][rectangle(1.2)] == 3).all()
    assert masks.classes[0, 18, 32] == STATIC_CLASS
    assert masks.classes[0, 18, 1] == DISTANT_CLASS
    covered = (masks.instances > 0).float().sum()
    assert 0.8 * 2 * 15**2 < covered < 1.3 * 2 * 15**2


def test_what_is_hardly_covered_is_empty():
    scene = two_actors()
    faint = replace(scene.gaussians, logit_opacities=torch.full_like(scene.gaussians.logit_opacities, -4.0))
    masks = render_masks(images_at(scene.with_gaussians(faint), 0), SETTINGS)
    assert (masks.classes == EMPTY_CLASS).all()
    assert (masks.instances == 0).all()


def test_actors_outside_of_the_view_are_not_rendered():
    scene = build_scene((actor("a", -40.0, 0.0, "van"), actor("b", 0.0, 0.0, "car"), actor("c", 0.0, 0.0, "car", (1,))))
    images = images_at(scene, 0)
    assert [is_in_view(node, images.views[0]) for node in scene.actors] == [False, True, False]
    assert render_node_weights(images, SETTINGS).nodes == (STATIC, DISTANT, FIRST_ACTOR + 1)


def flow_of(scene: SceneGraph, shift_m: float = 0.0, next_scene: SceneGraph | None = None) -> Float64:
    flow = compute_flow(images_at(scene, 0), images_at(next_scene or scene, 1, shift_m), SETTINGS)
    assert flow.shape == (1, LENS.height_px, LENS.width_px, 2)
    return flow[0].double().numpy()


def test_flow_is_that_of_planes_and_of_actors():
    flow = flow_of(two_actors(), shift_m=0.2)
    wall = flow[18, 31:33]
    assert np.abs(wall - [-60 * 0.2 / WALL_Z_M, 0]).max() < 0.02
    moving = flow[rectangle(-1.2)]
    assert np.abs(moving - [60 * (0.3 - 0.2) / ACTOR_Z_M, 0]).max() < 0.05
    resting = flow[rectangle(1.2)]
    assert np.abs(resting - [60 * -0.2 / ACTOR_Z_M, 0]).max() < 0.05


def test_flow_is_nan_where_the_point_is_hidden_next():
    # Ahead of the moving actor lies wall that it covers at the next moment.
    flow = flow_of(build_scene((actor("a", -1.2, 1.0, "van"),)))
    middle = 32 + 60 * -0.2 / ACTOR_Z_M
    assert np.isnan(flow[18, int(middle) + 1 : int(middle) + 5, 0]).all()
    assert np.isfinite(flow[18, 45:50, 0]).all()


def test_flow_is_nan_where_the_actor_is_gone_or_nothing_is():
    gone = flow_of(build_scene((actor("a", 0.0, 0.0, "van", (0,)),)))
    assert np.isnan(gone[18, 30:34]).all()
    scene = two_actors()
    faint = replace(scene.gaussians, logit_opacities=torch.full_like(scene.gaussians.logit_opacities, -4.0))
    assert np.isnan(flow_of(scene.with_gaussians(faint))).all()


def test_flow_finds_an_actor_by_its_name_in_another_scene():
    scene = two_actors()
    first, second = scene.actors
    swapped = build_scene((second, first))
    assert np.allclose(flow_of(scene, 0.1), flow_of(scene, 0.1, swapped), atol=1e-3, equal_nan=True)


def test_flow_leaves_the_readout_out_of_masks_too():
    shutter = RollingShutter(0.1, velocity_m_s=(20.0, 0.0, 0.0), turn_rad_s=(0.0, 0.0, 0.0))

    def read_out(images: RolloutImages) -> RolloutImages:
        return replace(images, views=tuple(replace(view, shutter=shutter) for view in images.views))

    scene = two_actors()
    resting = images_at(scene, 0)
    moving = read_out(resting)
    # The masks that are written are those of the image with its readout.
    assert (render_masks(moving, SETTINGS).instances != render_masks(resting, SETTINGS).instances).any()
    flow = compute_flow(moving, read_out(images_at(scene, 1, 0.2)), SETTINGS)
    assert np.array_equal(flow[0].double().numpy(), flow_of(scene, 0.2), equal_nan=True)


def test_a_contact_shadow_is_no_part_of_its_actor():
    run = MadeRun()
    insert = Insert(actor="a", name="x", ahead_m=9, speed_m_s=0)

    def render(darkness: float) -> tuple[torch.Tensor, Masks]:
        chunk_scene = edit(run, insert, config=SimulateConfig(contact_shadow=darkness)).load(0)
        pose = chunk_scene.chunk.views[0].chunk_SE3_camera
        view = RolloutView("front", 0.0, pose, LENS)
        nothing = torch.zeros(1, LENS.height_px, LENS.width_px)
        images = RolloutImages(0, (view,), chunk_scene, nothing[..., None], nothing, nothing)
        return draw(chunk_scene), render_masks(images, RenderSettings(threads=1))

    bare_color, bare = render(0.0)
    shaded_color, shaded = render(0.9)
    assert (bare_color - shaded_color).max() > 0.05
    assert (bare.instances == 3).sum() > 20
    assert torch.equal(shaded.instances, bare.instances) and torch.equal(shaded.classes, bare.classes)
