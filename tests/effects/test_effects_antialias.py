"""Anti-aliasing in a plan: the gate, and the scene that says so from stage to stage and in its file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from genre_tasks.config import EffectsConfig, GnetConfig, InitialConfig, LossConfig
from genre_tasks.effects.plan import EFFECT_NAMES, load_effect, plan_effects
from genre_tasks.effects.types import DEFAULT_PLAN
from genre_tasks.optimiser.autograd_render import AutogradRender
from genre_tasks.optimiser.kernel_render import KernelRender
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.render import RenderSettings, render_views
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.gnet import gnet
from genre_tasks.stages.initial import initial
from storage.codecs import reconstruction as codec
from tests.effects.test_apply_plan import DEFAULT_EFFECTS, chunk, with_
from tests.effects.test_effects_plan import cameras
from tests.optimiser import street_scenes

SMALL = InitialConfig(max_points=2000, distant_count=200)


def _choice(of: Chunk) -> tuple[str, float]:
    setting = EffectsConfig.model_validate({n: "auto" if n == "anti_aliasing" else "off" for n in EFFECT_NAMES})
    found = plan_effects(setting, of, cameras())["anti_aliasing"]
    return found.choice, found.value


def _two_resolutions(ratio: float) -> Chunk:
    """The first source view, and a camera beside it whose images show everything so much larger."""
    view = chunk().views_with_role("source")[0]
    lens = view.lens.resized(round(ratio * view.lens.width_px), round(ratio * view.lens.height_px))
    other = replace(view, camera=chunk().camera_names[1], lens=lens)
    return replace(chunk(), views=(view, other))


def test_the_gate_flips_at_its_threshold() -> None:
    limit = load_effect("anti_aliasing").threshold
    for factor, choice in ((0.98, "off"), (1.02, "on")):
        assert _choice(_two_resolutions(factor * limit)) == (choice, pytest.approx(factor * limit, rel=0.005))
    choice, value = _choice(replace(chunk(), views=()))
    assert choice == "off" and np.isnan(value)


def test_the_scene_says_so_from_its_start_to_its_file(tmp_path) -> None:
    on = with_(*DEFAULT_EFFECTS, "anti_aliasing")
    first = initial(SMALL, chunk(), on)
    assert first.scene.antialiased and not initial(SMALL, chunk(), DEFAULT_PLAN).scene.antialiased
    config = GnetConfig(iterations=2, views_per_iteration=2, method="adam", loss=LossConfig(perceptual=0), snapshots=1)
    done = gnet(config, chunk(), first, on)
    assert done.scene.antialiased and all(s.antialiased for s in done.snapshots.values())
    plain = gnet(config, chunk(), initial(SMALL, chunk()), with_(*DEFAULT_EFFECTS))
    assert not plain.scene.antialiased and plain.losses != done.losses
    for name, value in (("on", done), ("off", plain)):
        (tmp_path / name).mkdir()
        codec.write(tmp_path / name, value)
        again = codec.read(tmp_path / name)
        assert again.scene.antialiased is value.scene.antialiased
        assert all(s.antialiased is value.scene.antialiased for s in again.snapshots.values())
    assert (tmp_path / "on" / "rendering.parquet").exists() and not (tmp_path / "off" / "rendering.parquet").exists()


def test_every_way_to_render_a_scene_asks_it() -> None:
    scene = street_scenes.scene()
    smooth, views = replace(scene, antialiased=True), street_scenes.targets(scene)
    plain, image = render_views(scene, views), render_views(smooth, views)
    assert (plain.color - image.color).abs().max() > 0.01
    reference = render_views(smooth, views, RenderSettings("reference"))
    torch.testing.assert_close(image.color, reference.color, atol=1e-4, rtol=0)
    offsets, frame = torch.zeros(len(scene), 14), Parameterization.from_scene(smooth)
    by_color, by_depth = torch.randn(image.color.shape), torch.randn(image.depth.shape)
    ours, theirs = (p(frame, offsets, views, RenderSettings()) for p in (KernelRender, AutogradRender))
    torch.testing.assert_close(ours.color, image.color, atol=1e-4, rtol=0)
    expected = theirs.gradient(by_color, by_depth.clone()).gaussians
    found = ours.gradient(by_color, by_depth.clone()).gaussians
    assert float((found - expected).abs().max()) <= 1e-3 * float(expected.abs().max())
    assert Reconstruction(smooth).scene.antialiased
