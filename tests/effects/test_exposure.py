"""Exposure: gains, found and applied; after the last source image; and images that are clipped."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from genre_tasks.config import EffectsConfig, LossConfig
from genre_tasks.effects import color_gain
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.exposure import _interpolate_gain
from genre_tasks.effects.plan import EFFECT_NAMES, plan_effects
from genre_tasks.effects.types import EffectParameters
from genre_tasks.fixer.source_images import load_source_images
from genre_tasks.logs.registry import open_log
from genre_tasks.losses.exposed_renders import ExposedRenders
from genre_tasks.losses.rendering_loss import image_gradients, residual_image, select_loss_terms
from genre_tasks.losses.ssim import SsimTarget
from genre_tasks.losses.targets import Target, view_targets
from genre_tasks.stages.evaluation_renders import apply_view_gains
from tests.effects.test_apply_plan import DEFAULT_EFFECTS, chunk, with_
from tests.optimiser.street_scenes import LENS, pose

SWINGING = "synthetic:street?seed=1020&cameras=2&width=160&height=90&samples=1&exposure_jitter=0.3"
ONLY_EXPOSURE = EffectsConfig(**{name: "on" if name == "exposure" else "off" for name in EFFECT_NAMES})


def test_gains_go_on_along_their_line_after_the_last_source_image() -> None:
    log = open_log(SWINGING)
    found = plan_effects(ONLY_EXPOSURE, chunk(SWINGING), log.cameras).parameters.gains
    sources = {v.frame for v in chunk(SWINGING).views_with_role("source")}
    last, before = max(sources), max(sources - {max(sources)})
    after = [v for v in chunk(SWINGING).views if v.frame > last]
    assert after
    for view in after:
        at_last = np.array(found[view.camera, last])
        slope = (at_last - found[view.camera, before]) / (last - before)
        # One interval further the gain is held; no frame of this street lies beyond it.
        assert view.frame - last <= last - before
        np.testing.assert_allclose(found[view.camera, view.frame], at_last + slope * (view.frame - last), atol=1e-6)
    # The held gain would be off by what the exposure swings on.
    gains = log.camera_effects
    swung = [
        gains.log_gain(v.camera, 0.1 * v.frame).mean() - gains.log_gain(v.camera, 0.1 * last).mean() for v in after
    ]
    extended = [np.mean(found[v.camera, v.frame]) - np.mean(found[v.camera, last]) for v in after]
    assert np.abs(np.subtract(extended, swung)).mean() < 0.6 * np.abs(swung).mean()


@pytest.mark.parametrize("times_s", [(0.0, 0.4, 0.4), (5.0, 5.0, 5.0), (0.8, 0.4, 0.0)])
def test_gains_follow_the_frames_where_times_repeat_or_go_back(times_s: tuple[float, ...]) -> None:
    sources = [SimpleNamespace(frame=4 * k, timestamp_s=time_s) for k, time_s in enumerate(times_s)]
    known = [(source, (0.1 * k, 0.2 * k, 0.0)) for k, source in enumerate(sources)]
    for source, gain in known:
        assert _interpolate_gain(source, known) == pytest.approx(gain)  # type: ignore[arg-type]
    between = SimpleNamespace(frame=6, timestamp_s=times_s[1])
    assert _interpolate_gain(between, known) == pytest.approx((0.15, 0.3, 0.0))  # type: ignore[arg-type]


def _clipped_target(log_gain: tuple[float, float, float] | None) -> Target:
    image = torch.full((32, 48, 3), 0.5)
    image[:, :24] = 1.0
    return Target("c", 0, pose(0.0), LENS, SsimTarget.from_image(image), log_gain=log_gain)


@pytest.mark.parametrize("brightness", [0.95, 1.3])
def test_a_clipped_image_pulls_up_what_is_darker_and_leaves_what_is_brighter(brightness: float) -> None:
    target = _clipped_target((0.2, 0.2, 0.2))
    config = LossConfig(perceptual=0)
    terms = select_loss_terms(config, [target], 0, torch.Generator(), perceptual=False)
    # What the loss sees is brighter than this by the gain.
    color = torch.full((1, 32, 48, 3), brightness) / float(np.exp(0.2 / 2.4))
    color[..., 24:, :] = 0.8
    gradient = image_gradients(config, ExposedRenders.from_renders(color, [target]), torch.zeros(1, 32, 48), terms)[1]
    residual = residual_image(ExposedRenders.from_renders(color, [target]))
    # Where the image is not clipped, a render that is too bright is pulled down.
    assert (gradient[0, :, 32:] > 0).all() and (residual[0, :, 32:] < 0).all()
    if brightness > 1:
        assert not gradient[0, :, :24].any() and not residual[0, :, :24].any()
    else:
        assert (gradient[0, :, :16] < 0).all() and (residual[0, :, :24] > 0).all()


def test_without_gains_a_clipped_image_is_compared_as_it_is() -> None:
    target = _clipped_target(None)
    config = LossConfig(perceptual=0, ssim=0)
    terms = select_loss_terms(config, [target], 0, torch.Generator(), perceptual=False)
    color = torch.full((1, 32, 48, 3), 1.2)
    gradient = image_gradients(config, ExposedRenders.from_renders(color, [target]), torch.zeros(1, 32, 48), terms)[1]
    assert (gradient > 0).all()
    assert (residual_image(ExposedRenders.from_renders(color, [replace(target, ego_mask=None)]))[0] < 0).all()


def test_a_clipped_novel_view_pulls_nothing_down_where_exposures_differ() -> None:
    """Its scene's own colours go beyond 1, as images of a shorter exposure tell; the fixer's images end there."""
    targets = [_clipped_target((0.2, 0.2, 0.2)), replace(_clipped_target(None), novel=True)]
    config = LossConfig(perceptual=0)
    terms = select_loss_terms(config, targets, 0, torch.Generator(), perceptual=False)
    color = torch.full((2, 32, 48, 3), 1.3)
    renders = ExposedRenders.from_renders(color, targets)
    gradient = image_gradients(config, renders, torch.zeros(2, 32, 48), terms)[1]
    assert not gradient[:, :, :24].any() and (gradient[:, :, 32:] > 0).all()
    assert not residual_image(renders)[:, :, :24].any()


def test_the_exposures_derivatives_are_those_of_finite_differences() -> None:
    g = torch.Generator().manual_seed(0)
    color = torch.rand(2, 5, 4, 3, generator=g, dtype=torch.float64, requires_grad=True)
    gains = torch.randn(2, 1, 1, 3, generator=g, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(color_gain.apply_gain, (color, gains))


def test_the_loss_takes_its_gradient_through_the_gain() -> None:
    view = chunk().views_with_role("source")[0]
    (target,) = view_targets(chunk(), [replace(view, log_gain=(0.5, -0.3, 0.1))])
    g = torch.Generator().manual_seed(1)
    color = torch.rand(1, 90, 160, 3, generator=g)
    config = LossConfig(perceptual=0)
    loss_plan = select_loss_terms(config, [target], 0, g, perceptual=False)
    depth = torch.zeros(1, 90, 160)

    def loss(at: torch.Tensor) -> float:
        return image_gradients(config, ExposedRenders.from_renders(at, [target]), depth, loss_plan)[0]

    by_color = image_gradients(config, ExposedRenders.from_renders(color, [target]), depth, loss_plan)[1]
    way = by_color / by_color.abs().max()
    step = 1e-3
    found = (loss(color + step * way) - loss(color - step * way)) / (2 * step)
    assert float((by_color * way).sum()) == pytest.approx(found, rel=0.02)
    (plain,) = view_targets(chunk(), [view])
    without_gain = ExposedRenders.from_renders(color, [plain])
    assert image_gradients(config, without_gain, depth, loss_plan)[0] != pytest.approx(loss(color), rel=0.01)


@pytest.mark.parametrize("gain", [0.0, 1.5, -1.5, -30.0, 30.0])
def test_neutral_undoes_what_a_gain_does_and_stays_finite(gain: float) -> None:
    """Hard case 52: a gain towards zero, or without bound, is applied up to a factor of 55."""
    own = torch.rand(40, 30, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    gains = own.new_tensor([gain, 0.5 * gain, 0.0])
    shown = color_gain.apply_gain(own, gains)
    assert torch.isfinite(shown).all()
    back = color_gain.remove_gain(shown, gains)
    seen = shown < 1
    torch.testing.assert_close(back[seen], own[seen])
    assert torch.isfinite(back).all() and (back >= 0).all() and (back <= 1).all()


def test_gains_of_a_street_are_found_and_held_out_views_take_their_neighbours() -> None:
    uri = "synthetic:street?seed=1020&cameras=2&width=160&height=90&samples=1&exposure_jitter=0.3"
    log = open_log(uri)
    found = plan_effects(
        EffectsConfig(**{n: "on" if n == "exposure" else "off" for n in EFFECT_NAMES}), chunk(uri), log.cameras
    )
    views = chunk(uri).views
    true = np.array([log.camera_effects.log_gain(v.camera, v.frame * 0.1) for v in views])
    gains = np.array([found.parameters.gains[v.camera, v.frame] for v in views])
    assert true.std() > 0.1
    assert np.sqrt(np.square((gains - gains.mean(0)) - (true - true.mean(0))).mean()) < 0.06
    held = [k for k, v in enumerate(views) if v.role == "heldout"]
    assert np.abs((gains - gains.mean(0) - true + true.mean(0))[held]).max() < 0.2
    source = [gains[k] for k, v in enumerate(views) if v.role == "source"]
    np.testing.assert_allclose(np.mean(source, 0), 0, atol=1e-9)


def test_renders_take_a_views_gain_and_recorded_images_lose_it() -> None:
    view = chunk().views_with_role("source")[0]
    color = torch.rand(2, 90, 160, 3, generator=torch.Generator().manual_seed(5))
    gained = replace(view, log_gain=(0.4, 0.4, 0.4))
    assert apply_view_gains(color, [view, view]) is color
    shown = apply_view_gains(color, [view, gained])
    assert torch.equal(shown[0], color[0]) and (shown[1] > color[1]).all()
    gains = {(v.camera, v.frame): (0.4, 0.4, 0.4) for v in chunk().views}
    own = {view.camera: np.ones((90, 160), bool)}
    plain, planned = (
        load_source_images(chunk()),
        load_source_images(apply_plan(chunk(), with_(*DEFAULT_EFFECTS, parameters=EffectParameters(gains, own)))),
    )
    assert all(b.image.mean() < a.image.mean() for a, b in zip(plain, planned, strict=True))
    assert all((b.depth <= 0.11).all() == (b.camera == view.camera) for b in planned)
