"""What Gaussians show of a residual image: the sums, the step towards their mean, and the network that is told them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from flows.training import checkpoint
from flows.training.optimiser_training import initialise_network
from genre_tasks.compiled.loader import supported_instruction_sets
from genre_tasks.config import LearningRates, LossConfig
from genre_tasks.errors import InputError
from genre_tasks.learned.features import FEATURE_COUNT
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.learned.meta_training import MetaConfig, MetaTraining
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.learned.weights import load_optimiser, save_optimiser
from genre_tasks.logs.types import MotionBlur
from genre_tasks.losses.exposed_renders import ExposedRenders
from genre_tasks.losses.rendering_loss import residual_image
from genre_tasks.losses.ssim import SsimTarget
from genre_tasks.optimiser.autograd_render import AutogradRender
from genre_tasks.optimiser.auxiliary import AuxiliaryParameters
from genre_tasks.optimiser.differentiable_render import render_differentiable
from genre_tasks.optimiser.kernel_render import KernelRender
from genre_tasks.optimiser.kernels.constants import IMAGE_RESIDUALS, VARYING_FEATURES
from genre_tasks.optimiser.motion_blur_render import MotionBlurRender
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.render import RenderSettings, render_views
from genre_tasks.render.kernel import library as renderer
from genre_tasks.weights import resolve_weights
from tests.learned.test_kernel_step import CENTRE, TOTAL, _kernel_step, _random, _states, _threads, _torch_step
from tests.optimiser import street_scenes
from tests.optimiser.test_posing import ROLLING, SETTINGS, _offsets, _passes, _Rolling, _scene

TOLD = NetworkConfig(hidden=16, channels=(8, 12), residuals=True)


def _residual(like: torch.Tensor) -> torch.Tensor:
    return torch.randn(like.shape, generator=torch.Generator().manual_seed(4))


@pytest.mark.parametrize("kind", ["plain", "rolling", "glossy", "glossy and still"])
def test_the_sums_are_torchs(kind: str) -> None:
    """The oracle takes them from autograd: the derivative of an image by a Gaussian's colour is its share."""
    scene, auxiliary = _scene(actors=0 if kind == "glossy and still" else 2), AuxiliaryParameters()
    if kind.startswith("glossy"):
        spherical_harmonics = 0.3 * torch.randn(len(scene), 3, 3, generator=torch.Generator().manual_seed(8))
        scene, auxiliary = (
            scene.with_spherical_harmonics(spherical_harmonics),
            AuxiliaryParameters(spherical_harmonics=spherical_harmonics),
        )
    views = [
        _Rolling(t, f, ROLLING if kind == "rolling" else None)
        for t, f in zip(street_scenes.targets(street_scenes.scene()), (1, 7, 1, 2), strict=True)
    ]
    fixed = Parameterization.from_scene(scene), _offsets(scene), views, SETTINGS, auxiliary
    ours, torchs = KernelRender(*fixed), AutogradRender(*fixed)
    residual = _residual(ours.color)
    found, expected = (
        one.gradient(_residual(ours.color), torch.zeros_like(ours.depth), residual).image_residuals
        for one in (ours, torchs)
    )
    assert found is not None and expected is not None
    assert found.shape == (len(scene), 5)
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=2e-3)
    actors = scene.nodes >= 2
    if kind != "glossy and still":
        assert float(found[actors, 4].max()) > 1, "actors are seen, at several frames"
    share = float(found[:, 4].sum())
    assert share == pytest.approx(float(ours._alpha.sum()), rel=1e-3), "all shares make up the images' alpha"


@pytest.mark.parametrize("isa", supported_instruction_sets())
def test_gradients_are_the_same_bits_with_them_on_every_instruction_set(
    isa: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GENRE_RENDER_ISA", isa)
    monkeypatch.setattr("genre_tasks.render.cpu.load_kernel", renderer.load_kernel.__wrapped__)
    one, other = (_passes(_scene())[0] for _ in range(2))
    residual, by_depth = _residual(one.color), torch.zeros_like(one.depth)
    without = one.gradient(residual.clone(), by_depth.clone())
    along = other.gradient(residual.clone(), by_depth.clone(), residual)
    assert torch.equal(without.gaussians, along.gaussians)
    assert without.image_residuals is None and along.image_residuals is not None


def test_the_sums_are_the_same_bits_at_any_number_of_threads() -> None:
    found = []
    for threads in (1, 2, 3):
        with _threads(threads):
            one = _passes(_scene(2000))[0]
            residual = _residual(one.color)
            gradients = one.gradient(residual.clone(), torch.zeros_like(one.depth), residual)
            found.append(gradients.image_residuals)
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


@pytest.mark.parametrize("kind", ["compiled", "torch"])
@pytest.mark.parametrize("count", [1, 2], ids=["one is sharp", "all are blurred"])
def test_of_blurred_views_each_moment_has_an_equal_share(kind: str, count: int) -> None:
    scene, still = _scene(), street_scenes.targets(street_scenes.scene())
    resting = MotionBlur(1e-6, velocity_m_s=(0.0, 0.0, 0.0), turn_rad_s=(0.0, 0.0, 0.0), frame_s=0.1)
    plain = [_Rolling(t, 1, None) for t in still]
    blurred = [_Rolling(t, 1, None) for t in still]
    for view in blurred[:count]:
        view.blur = resting
    settings = SETTINGS if kind == "compiled" else RenderSettings(backend="reference")
    sums = []
    for views in (plain[:2], blurred[:2]):
        one = render_differentiable(Parameterization.from_scene(scene), _offsets(scene), views, settings)
        assert isinstance(one, MotionBlurRender) == (views[0].blur is not None)
        residual = _residual(one.color)
        gradients = one.gradient(residual.clone(), torch.zeros_like(one.depth), residual)
        sums.append(gradients.image_residuals)
    torch.testing.assert_close(sums[1], sums[0], atol=1e-3, rtol=1e-3)


def test_the_residual_is_in_the_scenes_own_colours_and_not_of_the_vehicle() -> None:
    targets = street_scenes.targets(street_scenes.scene())[:2]
    own = torch.zeros(32, 48, dtype=torch.bool)
    own[20:] = True
    gain = (0.3, 0.0, -0.2)
    color = torch.stack([t.image.pixels for t in targets])
    from genre_tasks.effects.color_gain import apply_gain

    shown = apply_gain(color[1], torch.tensor(gain))
    bright = replace(targets[1], log_gain=gain, image=SsimTarget.from_image(shown.contiguous()))
    found = residual_image(ExposedRenders.from_renders(color - 0.1, [replace(targets[0], ego_mask=own), bright]))
    torch.testing.assert_close(found[0, :20], torch.full((20, 48, 3), 0.1))
    assert not found[0, 20:].any()
    torch.testing.assert_close(found[1], torch.full((32, 48, 3), 0.1), atol=1e-5, rtol=0)


def test_untrained_steps_bring_colours_home_where_adam_has_a_long_way() -> None:
    """Every colour is wrong by as much; the mean residual says by how much, a gradient in which direction."""
    truth = street_scenes.scene(600)
    g = truth.gaussians
    begun = truth.with_gaussians(replace(g, colors=g.colors + 0.3))
    objective, settings = Objective(LossConfig(perceptual=0, depth=0.0)), UnrollSettings(6, 4)
    still = (0.0, 0.0, 0.0, 0.0, 0.01)
    rules = (
        TunedAdam(LearningRates.from_sequence(still)),
        LearnedOptimiser(NetworkConfig(residuals=True, rates=still)).requires_grad_(False),
    )
    adam, ours = (unroll(r, begun, street_scenes.targets(truth), (), objective, settings).scene for r in rules)
    with torch.no_grad():
        views = street_scenes.targets(truth)
        error = [
            float((render_views(s, views).color - render_views(truth, views).color).abs().mean())
            for s in (begun, adam, ours)
        ]
    assert error[0] > 0.15 and error[1] > 0.7 * error[0] and error[2] < 0.1 * error[0]


@pytest.mark.parametrize(("hidden", "channels"), [(64, (16, 32, 48)), (33, (17, 3))])
def test_the_kernels_step_is_torchs(hidden: int, channels: tuple[int, ...]) -> None:
    scene, network = (
        street_scenes.scene(400),
        _random(NetworkConfig(hidden=hidden, channels=channels, residuals=True, relaxation=-0.4)),
    )
    parameterization = Parameterization.from_scene(scene)
    ours, torchs = _kernel_step(network, parameterization), _torch_step(network, parameterization)
    for state, gradient in _states(scene, with_residuals=True):
        step = ours(state, gradient, TOTAL)
        torch.testing.assert_close(step, torchs(state, gradient, TOTAL), atol=2e-5, rtol=1e-4)
        blind = replace(state, image_residuals=torch.zeros_like(state.image_residuals))
        assert not torch.equal(step, ours(blind, gradient, TOTAL))
        assert not step[state.visible[:, 0] == 0].any()
    with pytest.raises(ValueError, match="expected a state with residuals"):
        ours(replace(state, image_residuals=None), gradient, TOTAL)
    with pytest.raises(ValueError, match=r"expected residuals \[400, 5\], got \[400, 4\]"):
        ours(replace(state, image_residuals=state.image_residuals[:, :4]), gradient, TOTAL)
    with pytest.raises(ValueError, match="expected a state without residuals"):
        _kernel_step(_random(), parameterization)(state, gradient, TOTAL)


def test_weights_without_them_can_be_told_them(tmp_path: Path) -> None:
    """What is new counts for nothing but the step towards the mean residual."""
    start = tmp_path / "plain.safetensors"
    shipped = load_optimiser(Path(resolve_weights("gnet", "builtin")))
    values = dict(shipped.state_dict())
    values["entry.weight"] = values["entry.weight"][
        :, [*range(VARYING_FEATURES), *range(VARYING_FEATURES + IMAGE_RESIDUALS, FEATURE_COUNT + IMAGE_RESIDUALS)]
    ]
    values |= {name: values[name][:28] for name in ("head.weight", "head.bias")}
    without = LearnedOptimiser(NetworkConfig())
    without.load_state_dict(values)
    save_optimiser(without, start)
    plain, told = load_optimiser(start), initialise_network(NetworkConfig(residuals=True), 0, start)
    save_optimiser(told, tmp_path / "told.safetensors")
    told = load_optimiser(tmp_path / "told.safetensors")
    assert told.uses_image_residuals and not plain.uses_image_residuals
    scene = street_scenes.scene(400)
    steps = [network.prepare(Parameterization.from_scene(scene), CENTRE) for network in (plain, told)]
    for state, gradient in _states(scene, with_residuals=True):
        moved = [steps[0](replace(state, image_residuals=None), gradient, TOTAL), steps[1](state, gradient, TOTAL)]
        expected = state.mean_residual_rgb() * state.visible
        torch.testing.assert_close(moved[1][:, :11], moved[0][:, :11], atol=1e-6, rtol=1e-5)
        part = (moved[1] - moved[0])[:, 11:]
        ratio = part.norm() / expected.norm()
        torch.testing.assert_close(part, expected * ratio, atol=1e-5, rtol=1e-3)
    with pytest.raises(InputError, match="of a network with other residuals"):
        initialise_network(NetworkConfig(), 0, tmp_path / "told.safetensors")


def test_training_with_them_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    truth = street_scenes.scene(120)
    views, loss = street_scenes.targets(truth), LossConfig(perceptual=0)
    scene = TrainingScene("s", street_scenes.blurred(truth), views[:3], views[3:])
    config = MetaConfig(steps=40, segment=3, pool=2, iterations=(6, 9), views=(2, 3), loss=loss, held_out_loss=loss)
    whole = MetaTraining(initialise_network(TOLD, 0), [scene], config)
    for _ in range(5):
        whole.step()
    checkpoint.save(whole, tmp_path / "c.safetensors")
    again = MetaTraining(initialise_network(TOLD, 1), [scene], config)
    checkpoint.resume(again, tmp_path / "c.safetensors")
    assert [whole.step() for _ in range(4)] == [again.step() for _ in range(4)]
    pairs = zip(whole.network.parameters(), again.network.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    assert whole.network.head.weight[28].any(), "the relaxation is trained"
