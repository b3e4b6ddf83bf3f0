"""Spherical harmonics: their shapes, how they turn with an actor, and what a camera sees of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from genre_tasks.logs.types import Lens
from genre_tasks.render import RenderSettings, render_views
from genre_tasks.render.spherical_harmonics import compute_view_dependent_colors
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DEFAULT_SH_DEGREE, FIRST_ACTOR, SH_COUNTS, SceneGraph
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.spherical_harmonics import (
    evaluate_sh_basis,
    evaluate_sh_colors,
    evaluate_sh_colors_by_view,
    with_zero_spherical_harmonics,
)

LENS = Lens(40.0, 42.0, 16.5, 11.0, 32, 24)
KNOWN = pytest.mark.parametrize("count", SH_COUNTS.values())


def _pose(turn: Rotation, shift: tuple[float, float, float]) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn.as_matrix(), shift
    return out


def _view(chunk_SE3_camera: np.ndarray, frame: int) -> NovelView:
    return NovelView("front", frame, 0.0, chunk_SE3_camera, LENS, ("front", frame))


def _gaussians(count: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    spread = torch.tensor([1.5, 1.0, 0.8])
    return Gaussians(
        (torch.randn(count, 3, generator=g) * spread).to(dtype),
        (0.3 * torch.randn(count, 3, generator=g) - 1.5).to(dtype),
        torch.randn(count, 4, generator=g).to(dtype),
        torch.randn(count, generator=g).to(dtype),
        torch.rand(count, 3, generator=g).to(dtype),
    )


def _waves(count: int, k: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return (0.3 * torch.randn(count, k, 3, generator=torch.Generator().manual_seed(9))).to(dtype)


def _street(count: int = 60, k: int = 3, dtype: torch.dtype = torch.float32) -> SceneGraph:
    """A third stands, the others are of two actors that are turned differently at each of three frames."""
    paths = [
        np.stack(
            [_pose(Rotation.from_euler("xyz", [0.2, 0.3 * a, 0.9 * f + a]), (0.3 * f, 0.2 * a, 4.0)) for f in range(3)]
        )
        for a in (0, 1)
    ]
    actors = tuple(ActorNode(str(a), "Car", (3.0, 2.0, 2.0), np.arange(3), paths[a]) for a in (0, 1))
    scene = SceneGraph(
        _gaussians(count, dtype), torch.arange(count) % 3, actors, spherical_harmonics=_waves(count, k, dtype)
    )
    return replace(scene, nodes=torch.where(scene.nodes > 0, scene.nodes - 1 + FIRST_ACTOR, 0))


@KNOWN
def test_harmonics_are_orthonormal_and_without_a_constant(count: int) -> None:
    z, weight = np.polynomial.legendre.leggauss(12)
    angle = 2 * np.pi * np.arange(24) / 24
    grid = np.stack(
        [
            np.outer(np.sqrt(1 - z * z), np.cos(angle)),
            np.outer(np.sqrt(1 - z * z), np.sin(angle)),
            np.repeat(z[:, None], 24, 1),
        ],
        -1,
    )
    values = torch.stack(evaluate_sh_basis(torch.as_tensor(grid), count), -1).flatten(0, 1)
    area = torch.as_tensor(np.repeat(weight * 2 * np.pi / 24, 24))
    torch.testing.assert_close((values * area[:, None]).T @ values, torch.eye(count, dtype=torch.float64))
    torch.testing.assert_close((values * area[:, None]).sum(0), torch.zeros(count, dtype=torch.float64))
    with pytest.raises(ValueError, match="expected 3, 8, 15 harmonics, got 4"):
        evaluate_sh_basis(torch.zeros(3), 4)


@KNOWN
def test_an_actor_turned_with_its_camera_shows_the_same(count: int) -> None:
    """By 90 degrees, about each axis; harmonics in chunk axes would show another colour."""
    scene = _street(k=count, dtype=torch.float64)
    at = Rotation.from_euler("y", 0.3)
    for axis in np.eye(3):
        quarter = _pose(Rotation.from_rotvec(axis * np.pi / 2), (1.0, -2.0, 0.5))
        turned = tuple(replace(a, chunk_SE3_box=quarter @ a.chunk_SE3_box) for a in scene.actors)
        seen = []
        for actors, eye in ((scene.actors, np.eye(4)), (turned, quarter)):
            centre = (eye @ _pose(at, (0.5, 0.1, -1.0)))[:3, 3]
            seen.append(evaluate_sh_colors_by_view(replace(scene, actors=actors), [1], centre[None])[0])
        still = int((scene.nodes == 0).sum())
        torch.testing.assert_close(seen[0][still:], seen[1][still:])
        assert (seen[0][:still] - seen[1][:still]).abs().max() > 0.01


def test_a_scene_looks_as_its_actor_would() -> None:
    """All as one actor at its pose, or in the chunk's axes with the camera in the actor's."""
    count = 60
    pose = _pose(Rotation.from_euler("xyz", [0.4, -0.2, 1.3]), (0.2, 0.1, 5.0))
    actor = ActorNode("a", "Car", (3.0, 2.0, 2.0), np.arange(1), pose[None])
    moved = SceneGraph(
        _gaussians(count), torch.full((count,), FIRST_ACTOR), (actor,), spherical_harmonics=_waves(count, 3)
    )
    fixed = SceneGraph(
        _gaussians(count), torch.zeros(count, dtype=torch.int64), (), spherical_harmonics=_waves(count, 3)
    )
    images = []
    for scene, camera in ((moved, np.eye(4)), (fixed, np.linalg.inv(pose))):
        view = _view(camera, 0)
        images.append(render_views(scene, [view]).color)
    assert (images[0] - images[1]).abs().max() < 2e-5 and images[0].max() > 0.2
    plain = render_views(moved.with_spherical_harmonics(None), [view]).color
    assert (plain - images[0]).abs().max() > 0.02


@pytest.mark.parametrize("count", [3, 8])
def test_the_kernel_sees_what_torch_sees_to_the_gradient(count: int) -> None:
    frames, centres = [0, 2, 0, 1], np.random.default_rng(0).normal(size=(4, 3))
    found, exact = [], []
    for out, seen, dtype in (
        (found, compute_view_dependent_colors, torch.float32),
        (exact, evaluate_sh_colors_by_view, torch.float64),
    ):
        scene = _street(3000, count)
        g, waves = scene.gaussians, scene.spherical_harmonics
        leaves = [t.to(dtype).requires_grad_() for t in (g.means, g.colors, waves)]
        with_leaves = replace(
            scene, gaussians=replace(g, means=leaves[0], colors=leaves[1]), spherical_harmonics=leaves[2]
        )
        colors = seen(with_leaves, frames, centres)
        weights = torch.randn(colors.shape, generator=torch.Generator().manual_seed(1)).to(dtype)
        out += [colors.detach(), *torch.autograd.grad((colors * weights).sum(), leaves)]
    for a, b in zip(found, exact, strict=True):
        torch.testing.assert_close(a.double(), b, atol=3e-6, rtol=1e-5)
    assert (exact[0] == 0).any() and (exact[0] > 0).any()  # some are clamped


@pytest.mark.parametrize("settings", [RenderSettings("reference"), RenderSettings("cpu", 1)], ids=lambda s: s.backend)
def test_views_see_their_own_colours_whatever_the_backend(settings: RenderSettings) -> None:
    scene = _street()
    views = [_view(_pose(Rotation.from_euler("y", 0.1 * k), (0.4 * k, 0, 0)), f) for k, f in enumerate((0, 2, 0))]
    together = render_views(scene, views, settings).color
    alone = torch.cat([render_views(scene, [v], settings).color for v in views])
    assert torch.equal(together, alone)
    one = render_views(scene, views, RenderSettings("reference")).color
    assert (together - one).abs().max() < 1e-4
    assert (render_views(scene.with_spherical_harmonics(None), views, settings).color - together).abs().max() > 0.02


def test_gradients_are_those_of_finite_differences_on_the_reference() -> None:
    scene = _street(12, 8, torch.float64)
    view = _view(np.eye(4), 1)
    weights = torch.randn(1, 24, 32, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def loss(means: Tensor, waves: Tensor) -> Tensor:
        moved = replace(scene, gaussians=replace(scene.gaussians, means=means), spherical_harmonics=waves)
        return (render_views(moved, [view], RenderSettings("reference")).color * weights).sum()

    means, waves = scene.gaussians.means.clone().requires_grad_(), scene.spherical_harmonics.clone().requires_grad_()
    grads = torch.autograd.grad(loss(means, waves), (means, waves))
    generator = torch.Generator().manual_seed(4)
    for which, grad in enumerate(grads):
        way = torch.randn(grad.shape, generator=generator, dtype=torch.float64)
        at = means.detach(), waves.detach()
        steps = [[x + (s * way if k == which else 0) for k, x in enumerate(at)] for s in (1e-6, -1e-6)]
        found = float(loss(*steps[0]) - loss(*steps[1])) / 2e-6
        assert float((grad * way).sum()) == pytest.approx(found, rel=1e-3)
        assert abs(found) > 0.1


def _at_distance(distance: float, dtype: torch.dtype) -> tuple[Tensor, ...]:
    away = distance * torch.tensor([[0.48, -0.6, 0.64]], dtype=dtype)
    leaves = [away.clone(), torch.full((1, 3), 0.5, dtype=dtype), _waves(1, 8, dtype)]
    leaves = [t.requires_grad_() for t in leaves]
    seen = evaluate_sh_colors(torch.zeros(3, dtype=dtype), *leaves)
    return seen, *torch.autograd.grad(seen.sum(), leaves)


@pytest.mark.parametrize("distance", [0.0, 1e-30, 1e-12, 1e-4, 0.01, 1.0, 1e6, 1e15])
def test_a_direction_at_zero_distance_is_finite(distance: float) -> None:
    """Hard case 53, by torch and by the kernel."""
    seen, by_mean, *_ = parts = _at_distance(distance, torch.float32)
    assert all(bool(t.isfinite().all()) for t in parts)
    assert by_mean.abs().max() <= 100 * 3 * 8  # 1 / NEAREST_M, and what 8 harmonics of three channels add up to
    exact = _at_distance(distance, torch.float64)[0]
    torch.testing.assert_close(seen.double(), exact, atol=1e-6, rtol=0)
    g = replace(_gaussians(1), means=distance * torch.tensor([[0.48, -0.6, 0.64]]), colors=torch.full((1, 3), 0.5))
    g.means.requires_grad_()
    scene = SceneGraph(g, torch.zeros(1, dtype=torch.int64), (), spherical_harmonics=_waves(1, 8))
    compiled = compute_view_dependent_colors(scene, [0], np.zeros((1, 3)))
    torch.testing.assert_close(compiled[0].double(), exact, atol=1e-6, rtol=0)
    (by_compiled,) = torch.autograd.grad(compiled.sum(), [g.means])
    torch.testing.assert_close(by_compiled, by_mean, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("see", [compute_view_dependent_colors, evaluate_sh_colors_by_view], ids=["compiled", "torch"])
def test_what_is_not_finite_is_not_drawn_and_passes_no_gradient(see) -> None:
    scene = _street()
    means, waves = scene.gaussians.means.clone(), scene.spherical_harmonics.clone()
    means[0, 1], waves[3, 0, 2] = torch.nan, torch.inf
    leaves = [means.requires_grad_(), waves.requires_grad_()]
    broken = replace(scene, gaussians=replace(scene.gaussians, means=means), spherical_harmonics=waves)
    colors = see(broken, [1], np.zeros((1, 3)))
    assert int(colors.isnan().all(2).sum()) == 2 and int(colors.isnan().any(2).sum()) == 2
    kept = torch.where(colors.isnan(), torch.zeros_like(colors), colors)
    for grad in torch.autograd.grad(kept.sum(), leaves):
        assert bool(grad.isfinite().all()) and not grad[0].any() and not grad[3].any()
    view = _view(np.eye(4), 1)
    assert render_views(broken, [view]).culled["non_finite"] == 2


def test_harmonics_of_zero_change_nothing_but_colours_below_it() -> None:
    scene = _street().with_spherical_harmonics(None)
    begun = with_zero_spherical_harmonics(scene)
    assert begun.spherical_harmonics is not None and begun.spherical_harmonics.shape == (
        60,
        SH_COUNTS[DEFAULT_SH_DEGREE],
        3,
    )
    assert not begun.spherical_harmonics.any() and with_zero_spherical_harmonics(begun) is begun
    view = _view(np.eye(4), 1)
    assert torch.equal(render_views(begun, [view]).color, render_views(scene, [view]).color)
    with pytest.raises(ValueError, match="expected a scene with harmonics"):
        compute_view_dependent_colors(scene, [1], np.zeros((1, 3)))


def test_a_black_colour_that_is_not_clamped_has_a_gradient() -> None:
    scene = with_zero_spherical_harmonics(replace(_street(), spherical_harmonics=None))
    g = scene.gaussians
    gradients = []
    for see in (compute_view_dependent_colors, evaluate_sh_colors_by_view):
        colors = g.colors.clone()
        colors[0], colors[1, 2], colors[2, 0] = 0.0, 0.0, -0.1
        colors.requires_grad_()
        waves = torch.zeros(len(g), 3, 3, requires_grad=True)
        seen = see(
            scene.with_gaussians(replace(g, colors=colors)).with_spherical_harmonics(waves), [0, 2], np.zeros((2, 3))
        )
        gradients.append(torch.autograd.grad(seen.sum(), (colors, waves)))
    (ours, ours_of_waves), (theirs, theirs_of_waves) = gradients
    assert (ours[0] > 0).all() and ours[1, 2] > 0 and ours[2, 0] == 0
    torch.testing.assert_close(ours, theirs)
    torch.testing.assert_close(ours_of_waves, theirs_of_waves)
