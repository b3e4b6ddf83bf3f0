"""Exposure that swings: gains after the last source image, and images that are clipped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from genre_tasks.config import EffectsConfig, LossConfig
from genre_tasks.effects.plan import EFFECT_NAMES, plan_effects
from genre_tasks.logs.registry import open_log
from genre_tasks.losses.rendering_loss import image_gradients, residual_image, select_loss_terms
from genre_tasks.losses.ssim import SsimTarget
from genre_tasks.losses.targets import Target
from tests.effects.test_apply_plan import chunk
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
    gradient = image_gradients(config, color, torch.zeros(1, 32, 48), [target], terms)[1]
    residual = residual_image(color, [target])
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
    gradient = image_gradients(config, color, torch.zeros(1, 32, 48), [target], terms)[1]
    assert (gradient > 0).all()
    assert (residual_image(color, [replace(target, ego_mask=None)])[0] < 0).all()
