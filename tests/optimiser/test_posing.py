"""The compiled way from offsets to splats and back against torch's, which defines it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from genre_tasks.compiled.loader import supported_instruction_sets
from genre_tasks.config import LossConfig
from genre_tasks.errors import NonFiniteError
from genre_tasks.logs.types import MotionBlur, RollingShutter
from genre_tasks.losses.ssim import SsimTarget
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser import objective as objective_module
from genre_tasks.optimiser.autograd_render import AutogradRender
from genre_tasks.optimiser.differentiable_render import render_differentiable
from genre_tasks.optimiser.kernel_render import KernelRender
from genre_tasks.optimiser.kernels import posing as module
from genre_tasks.optimiser.kernels.posing import allocate_splats, load_posing
from genre_tasks.optimiser.motion_blur_render import MotionBlurRender
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.render import render_views
from genre_tasks.render.types import Render, RenderSettings
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, SceneGraph
from genre_tasks.scene.transforms import compose_se3
from tests.optimiser import street_scenes

NAMES = ("means", "scales", "quats", "opacities", "colors")
FRAMES = (1, 7, 0, 2)
"""Both actors, none, the first alone, the second alone."""
SETTINGS = RenderSettings()


def _scene(count: int = 3000, actors: int = 2) -> SceneGraph:
    """Actors that turn, each absent at times, whose Gaussians lie among the others."""
    plain = street_scenes.scene(count, actor=False)
    paths = []
    for k in range(actors):
        turns = Rotation.from_euler("zyx", [[0.3 + k, 0.1, -0.2], [2.9, -0.4, 0.5 * k]]).as_matrix()
        poses = compose_se3(turns, np.array([[0.5, 0.2, 7.0 + k], [1.0, -0.1 * k, 6.0]]))
        paths.append(ActorNode(f"a{k}", "Car", (1.0, 1.0, 1.0), np.array([k, k + 1]), poses))
    nodes, at = plain.nodes.clone(), torch.arange(count)
    for k in range(actors):
        nodes[at % 5 == 2 * k + 1] = FIRST_ACTOR + k
    means = torch.where((nodes >= FIRST_ACTOR)[:, None], plain.gaussians.means / 10, plain.gaussians.means)
    return SceneGraph(replace(plain.gaussians, means=means), nodes, tuple(paths))


def _offsets(scene: SceneGraph) -> Tensor:
    return 0.1 * torch.randn(len(scene), 14, generator=torch.Generator().manual_seed(5))


def _exact(scene: SceneGraph) -> Parameterization:
    wide = Gaussians.unpack(scene.gaussians.pack().double())
    return replace(
        Parameterization.from_scene(scene),
        scene=scene.with_gaussians(wide),
        unit_m=Parameterization.from_scene(scene).unit_m.double(),
    )


def _both(scene: SceneGraph, frames: tuple[int, ...] = FRAMES) -> list[tuple[list[Tensor], Tensor]]:
    """Splats, and the gradient of a random linear function of them, compiled and as torch has them in float64."""
    offsets, parameterization = _offsets(scene), Parameterization.from_scene(scene)
    leaf, exact = offsets.double().requires_grad_(), _exact(scene)
    splats = exact.scene.with_gaussians(exact.gaussians_at(leaf)).gaussians_at_frames(frames)[0].activate()
    theirs = [getattr(splats, name) for name in NAMES]
    generator = torch.Generator().manual_seed(6)
    by_splats = [torch.randn(t.shape, generator=generator) for t in theirs]
    torch.autograd.backward(theirs, [g.double() for g in by_splats])
    posed = parameterization.posing.pose(offsets, frames, 2)
    gradient = parameterization.posing.offsets_gradient(posed, tuple(by_splats), 2)
    assert leaf.grad is not None
    return [(list(posed.splats), gradient), ([t.detach() for t in theirs], leaf.grad)]


def _close(ours: Tensor, exact: Tensor, bound: float) -> None:
    assert ours.shape == exact.shape and ours.dtype == torch.float32
    assert float((ours - exact).abs().max()) <= bound * float(exact.abs().max())


def _check(scene: SceneGraph, frames: tuple[int, ...] = FRAMES) -> None:
    (ours, gradient), (exact, expected) = _both(scene, frames)
    for a, b in zip(ours, exact, strict=True):
        _close(a, b, 1e-6)
    for k in (1, 3):  # scales and opacities, each by its own size
        assert float(((ours[k] - exact[k]) / exact[k]).abs().max()) <= 2e-6
    for columns in ((0, 3), (3, 6), (6, 10), (10, 11), (11, 14)):
        _close(gradient[:, slice(*columns)], expected[:, slice(*columns)], 1e-5)


@pytest.mark.parametrize("actors", [0, 1, 2])
def test_values_and_gradients_are_the_oracles(actors: int) -> None:
    scene = _scene(actors=actors)
    assert bool((scene.nodes == DISTANT).any()) and int((scene.nodes >= FIRST_ACTOR).sum()) == 600 * actors
    _check(scene)


@pytest.mark.parametrize("frames", [(1,), (0,), (7,), (0, 2, 1)])
def test_at_any_frames(frames: tuple[int, ...]) -> None:
    _check(_scene(200), frames)


@pytest.mark.parametrize("count", [1, 5, 63, 64, 65])
def test_at_the_ends_of_blocks(count: int) -> None:
    _check(_scene(count))


def test_every_gaussian_an_actors() -> None:
    scene = _scene(100)
    _check(replace(scene, nodes=torch.full_like(scene.nodes, FIRST_ACTOR)))


def test_actors_without_gaussians_and_gaussians_of_no_actor() -> None:
    scene = _scene(100)
    _check(replace(scene, nodes=torch.zeros_like(scene.nodes)))
    (ours, _), (exact, _) = _both(replace(scene, actors=()))
    assert len(ours[0]) == len(exact[0]) == 100


@pytest.mark.parametrize("isa", supported_instruction_sets())
def test_every_instruction_set_is_right(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENRE_RENDER_ISA", isa)
    monkeypatch.setattr(module, "load_posing", load_posing.__wrapped__)
    _check(_scene())


def test_no_gaussian_at_all() -> None:
    full = _scene(100)
    parameterization = Parameterization.from_scene(
        replace(full, gaussians=Gaussians.unpack(torch.empty(0, 14)), nodes=full.nodes[:0])
    )
    posed = parameterization.posing.pose(torch.empty(0, 14), FRAMES, 2)
    assert parameterization.posing.offsets_gradient(posed, allocate_splats(0), 2).shape == (0, 14)


def test_the_same_bits_at_any_thread_count() -> None:
    scene = _scene()
    parameterization, offsets = Parameterization.from_scene(scene), _offsets(scene)
    results = []
    for threads in (1, 2, 3):
        posed = parameterization.posing.pose(offsets, FRAMES, threads)
        results.append([*posed.splats, parameterization.posing.offsets_gradient(posed, posed.splats, threads)])
    assert all(torch.equal(a, b) for r in results[1:] for a, b in zip(results[0], r, strict=True))


def test_extreme_and_broken_values_are_torchs() -> None:
    scene = _scene(12, actors=0)
    packed = scene.gaussians.pack()
    packed[:, 3:6] = torch.tensor([-100.0, -80, -30, 0, 30, 80, 87, 90, 200, torch.nan, torch.inf, -torch.inf])[:, None]
    packed[:, 10] = torch.tensor([-200.0, -80.1, -80, -79.9, -30, -9, 0, 9, 30, torch.nan, torch.inf, -torch.inf])
    packed[9, 0], packed[10, 12] = torch.nan, torch.inf
    scene = scene.with_gaussians(Gaussians.unpack(packed))
    parameterization, leaf = Parameterization.from_scene(scene), torch.zeros(12, 14, requires_grad=True)
    parameterization = replace(parameterization, unit_m=torch.ones(12, 1))
    splats = parameterization.gaussians_at(leaf).activate()
    theirs = [getattr(splats, name) for name in NAMES]
    ones = allocate_splats(12)
    for t in ones:
        t.fill_(1.0)
    torch.autograd.backward(theirs, list(ones))
    assert leaf.grad is not None
    posed = parameterization.posing.pose(torch.zeros(12, 14), FRAMES, 1)
    ours = [*posed.splats, parameterization.posing.offsets_gradient(posed, ones, 1)]
    for a, b in zip(ours, [*theirs, leaf.grad], strict=True):
        torch.testing.assert_close(a, b, rtol=4e-5, atol=2e-35, equal_nan=True)


def test_expected_depth_and_its_gradient_are_torchs() -> None:
    generator = torch.Generator().manual_seed(0)
    alpha, depth, by_expected = (torch.rand(2, 7, 9, generator=generator) + 0.1 for _ in range(3))
    alpha[:, ::2] = 0
    depth[:, ::2] = 0
    a, d = alpha.clone().requires_grad_(), depth.clone().requires_grad_()
    expected = Render(torch.zeros(2, 7, 9, 3), a, d).expected_depth()
    expected.backward(by_expected)
    ours = module.expected_depth(alpha, depth)
    assert torch.equal(ours, expected)
    by_alpha, by_depth = module.expected_depth_gradient(alpha, ours, by_expected)
    torch.testing.assert_close(by_alpha, a.grad, rtol=1e-6, atol=0)
    torch.testing.assert_close(by_depth, d.grad, rtol=1e-6, atol=0)


ROLLING = RollingShutter(0.05, velocity_m_s=(1.0, 0.2, 4.0), turn_rad_s=(0.1, -0.3, 0.2), frame_s=0.1)


def _passes(
    scene: SceneGraph, settings: RenderSettings = SETTINGS, shutter: RollingShutter | None = None
) -> list[KernelRender | AutogradRender]:
    parameterization = Parameterization.from_scene(scene)
    kinds = (KernelRender, AutogradRender)
    return [kind(parameterization, _offsets(scene), _views(shutter), settings) for kind in kinds]


def _views(shutter: RollingShutter | None) -> list[_Rolling]:
    targets = street_scenes.targets(street_scenes.scene())
    return [_Rolling(target, frame, shutter) for target, frame in zip(targets, (1, 7, 1, 2), strict=True)]


class _Rolling:
    """A target at another frame, with a shutter and, if it has one, a lens that distorts."""

    def __init__(self, target: Target, frame: int, shutter: RollingShutter | None) -> None:
        self.frame, self.chunk_SE3_camera, self.shutter = frame, target.chunk_SE3_camera, shutter
        self.blur: MotionBlur | None = None
        self.lens = replace(target.lens, distortion=(-0.2, 0.03, 0.001, 0.0, 0.0) if shutter else ())


def test_lens_shutter_and_moving_actors_are_in_the_pass() -> None:
    scene = _scene()
    still, rolled = (_passes(scene, shutter=s)[0] for s in (None, ROLLING))
    resting = _passes(scene, shutter=replace(ROLLING, frame_s=0.0))[0]
    assert (still.color - rolled.color).abs().max() > 0.1
    assert (resting.color - rolled.color)[[0, 2, 3]].abs().max() > 0.01
    assert torch.equal(resting.color[1], rolled.color[1]), "no actor at that frame"


@pytest.mark.parametrize("shutter", [None, ROLLING], ids=["global", "rolling"])
def test_a_whole_pass_is_torchs(shutter: RollingShutter | None) -> None:
    ours, torchs = _passes(_scene(), shutter=shutter)
    assert ours.culled == torchs.culled
    torch.testing.assert_close(ours.color, torchs.color, atol=1e-4, rtol=0)
    by_color, by_depth = torch.randn(ours.color.shape), torch.randn(ours.depth.shape)
    expected = torchs.gradient(by_color, by_depth.clone()).gaussians
    _close(ours.gradient(by_color, by_depth).gaussians, expected, 1e-3)


@pytest.mark.parametrize("shutter", [None, ROLLING], ids=["global", "rolling"])
def test_a_blurred_pass_is_torchs_and_that_of_its_moments(shutter: RollingShutter | None) -> None:
    """The render that is chosen, and autograd through ``render_views``; the second time at moments that it knows."""
    scene = _scene()
    blur = MotionBlur(0.05, velocity_m_s=ROLLING.velocity_m_s, turn_rad_s=ROLLING.turn_rad_s, frame_s=0.1)
    views = _views(shutter)
    for view in views[:3]:
        view.blur = blur
    parameterization, offsets = Parameterization.from_scene(scene), _offsets(scene)
    leaf = offsets.clone().requires_grad_()
    image = render_views(scene.with_gaussians(parameterization.gaussians_at(leaf)), views)
    by_color, by_depth = torch.randn(image.color.shape), torch.randn(image.depth.shape)
    torch.autograd.backward([image.color, image.expected_depth()], [by_color, by_depth])
    for _ in range(2):
        ours = render_differentiable(parameterization, offsets, views, SETTINGS)
        assert isinstance(ours, MotionBlurRender) and len(ours.color) == 4
        torch.testing.assert_close(ours.color, image.color.detach(), atol=1e-4, rtol=0)
        _close(ours.gradient(by_color, by_depth.clone()).gaussians, leaf.grad, 1e-3)
    sharp = render_differentiable(parameterization, offsets, [_Rolling(views[3], 2, shutter)], SETTINGS)
    assert not isinstance(sharp, MotionBlurRender) and torch.equal(sharp.color[0], ours.color[3])


def test_a_blurred_street_is_recovered_sharp_where_blur_is_known() -> None:
    """By the PSNR of what an ideal camera would see, of images 48 px wide that are blurred by four."""
    truth = _scene(600)
    # 40 px / 7 m of depth · 0.7 m
    blur = MotionBlur(0.1, velocity_m_s=(7.0, 0.0, 0.0), turn_rad_s=(0.0, 0.0, 0.0), frame_s=0.1)
    plain = street_scenes.targets(truth)
    moving = [replace(t, blur=blur) for t in plain]
    with torch.no_grad():
        images = render_views(truth, moving).color
    blurred = [replace(t, image=SsimTarget.from_image(i.contiguous())) for t, i in zip(moving, images, strict=True)]
    error = {}
    for name, views in (("known", blurred), ("ignored", [replace(t, blur=None) for t in blurred])):
        objective = Objective(LossConfig(perceptual=0, depth=0.0))
        found = unroll(TunedAdam(), street_scenes.blurred(truth), views, (), objective, UnrollSettings(60, 4)).scene
        with torch.no_grad():
            seen = render_views(found, plain).color
        true = torch.stack([t.image.pixels for t in plain])
        error[name] = float((seen - true).square().mean())
    assert 10 * np.log10(error["ignored"] / error["known"]) > 0.5, error


@pytest.mark.parametrize("depth", [0.0, 0.1])
def test_an_unrolled_optimisation_with_actors_is_torchs(depth: float, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = _scene(600)
    start, views, settings = street_scenes.blurred(truth), street_scenes.targets(truth), UnrollSettings(6, 3)
    objective = Objective(LossConfig(perceptual=0, depth=depth))
    ours = unroll(TunedAdam(), start, views, (), objective, settings)
    monkeypatch.setattr(objective_module, "render_differentiable", AutogradRender)
    torchs = unroll(TunedAdam(), start, views, (), objective, settings)
    assert ours.losses == pytest.approx(torchs.losses, rel=1e-4)
    assert ours.losses[-1] < ours.losses[0] and ours.culled == torchs.culled
    difference = (ours.scene.gaussians.pack() - torchs.scene.gaussians.pack()).abs()
    assert float(difference.median()) < 1e-5 and float(difference.mean()) < 1e-3


def test_it_is_for_float32_on_the_cpu_and_its_backend() -> None:
    scene, views = _scene(50), street_scenes.targets(street_scenes.scene())[:1]
    parameterization, offsets = Parameterization.from_scene(scene), torch.zeros(50, 14)
    for settings in (SETTINGS, RenderSettings("cpu", 1)):
        assert isinstance(render_differentiable(parameterization, offsets, views, settings), KernelRender)
    assert isinstance(
        render_differentiable(parameterization, offsets, views, RenderSettings("reference")), AutogradRender
    )
    assert isinstance(render_differentiable(_exact(scene), offsets.double(), views, SETTINGS), AutogradRender)


def test_what_does_not_fit_is_refused() -> None:
    parameterization = Parameterization.from_scene(_scene(50))
    with pytest.raises(ValueError, match=r"expected offsets of shape \[50, 14\], got \[49, 14\]"):
        parameterization.posing.pose(torch.zeros(49, 14), FRAMES, 1)
    pose = street_scenes.pose(torch.nan)
    view = replace(street_scenes.targets(street_scenes.scene())[0], chunk_SE3_camera=pose)
    with pytest.raises(NonFiniteError):
        KernelRender(parameterization, torch.zeros(50, 14), [view], SETTINGS)


def test_offsets_need_not_be_contiguous() -> None:
    scene = _scene(100)
    parameterization, offsets = Parameterization.from_scene(scene), _offsets(scene)
    a, b = (parameterization.posing.pose(o, FRAMES, 1) for o in (offsets, offsets.T.contiguous().T))
    assert all(torch.equal(x, y) for x, y in zip(a.splats, b.splats, strict=True))
