"""Scene graphs to what files hold, and back: positions, rotations and colours are those of the renderer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from genre_tasks.exchange.cloud_errors import CloudErrors, compare_clouds
from genre_tasks.exchange.clouds import merge_clouds, transform_cloud, with_sh_degree
from genre_tasks.exchange.conversion import limit_sh_degree, pose_scene, to_exchange_scene, to_scene_graph
from genre_tasks.exchange.types import ExchangeScene
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.deformation import Deformation
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, SceneGraph
from genre_tasks.scene.spherical_harmonics import evaluate_sh_colors_by_view
from tests.exchange.splat_clouds import make_cloud, make_driving_scene, same_bits

FRAMES = tuple(range(40, 46))
NAMES = {"t1": "car-1", "t2": "pedestrian-2"}
ROUNDING = CloudErrors(means_m=2e-5, log_scales=0, angles_rad=1e-6, opacities=0, colors=1e-6, sh_rest=1e-6)


def make_graph(harmonics: int = 8) -> SceneGraph:
    """A background, a shell, and two actors that turn while they move; the second is there for three frames."""
    g = torch.Generator().manual_seed(4)
    packed = torch.randn(60, 14, generator=g)
    packed[:, 11:14] = torch.rand(60, 3, generator=g)
    nodes = torch.tensor([0, DISTANT, FIRST_ACTOR, 0, FIRST_ACTOR + 1, 0]).repeat(10)
    actors = []
    for k, frames in enumerate((FRAMES, FRAMES[2:5])):
        poses = np.broadcast_to(np.eye(4), (len(frames), 4, 4)).copy()
        for f, frame in enumerate(frames):
            # About no axis of the scene, so that no coordinate stays as it is.
            poses[f, :3, :3] = Rotation.from_rotvec([0.2 + k, 0.3 * (frame - 40), 0.9]).as_matrix()
            poses[f, :3, 3] = (5 + 2 * k, 1.5 * (frame - 40), 0.7)
        actors.append(ActorNode(f"t{k + 1}", "Car", (4.0, 2.0, 1.5), np.array(frames), poses))
    sh = torch.randn(60, harmonics, 3, generator=g) * 0.2 if harmonics else None
    return SceneGraph(Gaussians.unpack(packed), nodes, tuple(actors), antialiased=True, spherical_harmonics=sh)


def take_apart(graph: SceneGraph) -> ExchangeScene:
    world = np.eye(4)
    world[:3, 3] = (500.0, -20.0, 3.0)
    times = [7.0 + 0.1 * k for k in range(len(FRAMES))]
    return to_exchange_scene(graph, FRAMES, times, world, names=NAMES, losses=("Exposure is left out.",))


def test_nodes_of_a_scene_graph() -> None:
    scene = take_apart(make_graph())
    assert [node.name for node in scene.nodes] == ["background", "distant", "car-1", "pedestrian-2"]
    assert [len(node.cloud) for node in scene.nodes] == [30, 10, 10, 10]
    assert [node.motion is None for node in scene.nodes] == [True, True, False, False]
    assert scene.nodes[3].motion is not None
    assert scene.nodes[3].motion.present.tolist() == [False, False, True, True, True, False]
    np.testing.assert_allclose(scene.times_s, 0.1 * np.arange(6), atol=1e-12)
    assert scene.frames == FRAMES
    assert scene.losses == ("Exposure is left out.",)
    assert all(node.cloud.antialiased for node in scene.nodes)


@pytest.mark.parametrize("index", range(len(FRAMES)))
def test_posed_gaussians_are_those_of_the_scene_graph(index: int) -> None:
    graph = make_graph()
    posed = pose_scene(take_apart(graph), index)
    order = torch.argsort(graph.nodes, stable=True)
    there = graph.gaussians_at(FRAMES[index]).logit_opacities[order] > -29
    g = Gaussians.unpack(graph.gaussians_at(FRAMES[index]).pack()[order][there])
    assert len(posed) == int(there.sum())
    np.testing.assert_allclose(posed.means, g.means.numpy(), atol=1e-5)
    signs = np.sign((posed.quats * g.quats.numpy()).sum(1, keepdims=True))
    np.testing.assert_allclose(posed.quats * signs, g.quats.numpy(), atol=1e-5)
    # Colours of the renderer, evaluated in each actor's box, are those of the turned harmonics.
    centre = np.array([1.0, -6.0, 2.0])
    at = torch.from_numpy(centre[None])
    views = evaluate_sh_colors_by_view(graph, [FRAMES[index]], centre[None])[0]
    # Laid out with what does not move first.
    moving = graph.nodes >= FIRST_ACTOR
    laid_out = torch.cat([torch.nonzero(~moving)[:, 0], torch.nonzero(moving)[:, 0]])
    expected = torch.empty_like(views)
    expected[laid_out] = views
    resting = SceneGraph(
        Gaussians.unpack(g.pack()), torch.zeros(len(g), dtype=torch.int64), (), spherical_harmonics=_to(posed.sh_rest)
    )
    found = evaluate_sh_colors_by_view(resting, [0], at.numpy())[0]
    np.testing.assert_allclose(found.numpy(), expected[order][there].numpy(), atol=2e-5)


def _to(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.copy())


@pytest.mark.parametrize("harmonics", [0, 3, 8, 15])
def test_back_to_a_scene_graph(harmonics: int) -> None:
    graph = make_graph(harmonics)
    back = to_scene_graph(take_apart(graph))
    order = torch.argsort(graph.nodes, stable=True)
    assert torch.equal(back.nodes, graph.nodes[order])
    assert back.antialiased
    torch.testing.assert_close(back.gaussians.pack(), graph.gaussians.pack()[order], atol=2e-7, rtol=0)
    if harmonics:
        assert back.spherical_harmonics is not None and graph.spherical_harmonics is not None
        assert torch.equal(back.spherical_harmonics, graph.spherical_harmonics[order])
    else:
        assert back.spherical_harmonics is None
    for before, after in zip(graph.actors, back.actors, strict=True):
        assert (after.track_id, after.label, after.size_m) == (before.track_id, before.label, before.size_m)
        assert np.array_equal(after.frames, before.frames)
        np.testing.assert_allclose(after.chunk_SE3_box, before.chunk_SE3_box, atol=1e-12)


def test_deformation_is_a_loss() -> None:
    graph = make_graph()
    bent = replace(graph, deformation=Deformation.zero(graph.actors, (1,), FRAMES))
    losses = take_apart(bent).losses
    assert losses[0] == "The deformation of pedestrian-2 is left out: actors are rigid in the file."
    assert losses[1:] == ("Exposure is left out.",)


def test_harmonics_of_degree_4_are_cut_and_named() -> None:
    scene = make_driving_scene(sh_degree=4)
    cut = limit_sh_degree(scene)
    assert cut.losses == ("Spherical harmonics of degree 4 are cut to degree 3.",)
    assert limit_sh_degree(cut) is cut
    graph = to_scene_graph(scene)
    assert graph.spherical_harmonics is not None and graph.spherical_harmonics.shape[1] == 15
    expected = np.concatenate([node.cloud.sh_rest[:, :15] for node in scene.nodes])
    assert np.array_equal(graph.spherical_harmonics.numpy(), expected)


def test_files_without_frames_count_from_0() -> None:
    graph = to_scene_graph(replace(make_driving_scene(moments=4), frames=()))
    assert graph.actors[1].frames.tolist() == [0, 2, 3]


def test_actors_without_a_name_get_a_number() -> None:
    scene = to_exchange_scene(make_graph(), FRAMES, range(6), np.eye(4), names={})
    assert [node.name for node in scene.nodes][2:] == ["actor-1", "actor-2"]


def test_names_and_times_must_fit() -> None:
    with pytest.raises(ValueError, match="distinct names"):
        to_exchange_scene(make_graph(), FRAMES, range(6), np.eye(4), names={"t1": "a", "t2": "a"})
    with pytest.raises(ValueError, match="5 times for 6 frames"):
        to_exchange_scene(make_graph(), FRAMES, range(5), np.eye(4), names={})


def test_without_a_moment_there_are_no_actors() -> None:
    scene = make_driving_scene(sh_degree=1)
    rest = pose_scene(scene, None)
    assert same_bits(rest, merge_clouds([scene.nodes[0].cloud, scene.nodes[1].cloud]))
    # The pedestrian is absent at the second moment.
    assert len(pose_scene(scene, 1)) == len(rest) + len(scene.nodes[2].cloud)
    for index in (-1, len(scene.times_s)):
        with pytest.raises(IndexError):
            pose_scene(scene, index)


def test_a_cloud_that_is_moved_and_moved_back() -> None:
    cloud = make_cloud(50, 4)
    pose = take_apart(make_graph()).nodes[2].motion
    assert pose is not None
    there = pose.scene_SE3_node[3]
    back = transform_cloud(transform_cloud(cloud, there), np.linalg.inv(there))
    errors = compare_clouds(cloud, back)
    assert not errors.exceed(ROUNDING), errors
    assert same_bits(transform_cloud(cloud, np.eye(4)), cloud)


def test_clouds_of_different_kinds_merge() -> None:
    parts = [replace(make_cloud(3, 1), antialiased=True), replace(make_cloud(2, 3), antialiased=True)]
    merged = merge_clouds(parts)
    assert merged.sh_degree == 3 and merged.antialiased is True
    assert np.array_equal(merged.sh_rest[:3, :3], parts[0].sh_rest) and not merged.sh_rest[:3, 3:].any()
    assert merge_clouds([parts[0], replace(parts[1], antialiased=None)]).antialiased is None
    assert len(merge_clouds([])) == 0
    assert with_sh_degree(parts[1], 3) is parts[1]
