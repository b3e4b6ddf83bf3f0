"""Training pairs: joined, crops, perturbed scenes."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from genre_tasks.fixer.inputs import FixerInputs
from genre_tasks.fixer.pairs import Pairs, concatenate_pairs, perturb_scene, render_pairs, sample_crops
from genre_tasks.fixer.source_images import load_source_images
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.lidar_map import build_lidar_scene
from tests.fixer.conftest import random_views

INPUT_NAMES = [f.name for f in fields(FixerInputs)]


def some_pairs(count: int = 3, height: int = 48, width: int = 64) -> Pairs:
    views = random_views(count, height, width)
    generator = torch.Generator().manual_seed(9)
    truth = torch.randint(0, 256, (count, 3, height, width), generator=generator, dtype=torch.uint8)
    as_bytes = FixerInputs(*((getattr(views, n) * 255).round().to(torch.uint8) for n in INPUT_NAMES))
    return Pairs(as_bytes, truth, ("beside",) * count, np.arange(count, dtype=np.float32))


def test_sets_of_pairs_are_joined_in_order():
    pairs = some_pairs()
    both = concatenate_pairs([pairs, replace(pairs, kinds=("sparse",) * 3)])
    assert len(both) == 6 and both.shift_m.tolist() == [0, 1, 2, 0, 1, 2]
    assert both.kinds == ("beside",) * 3 + ("sparse",) * 3
    assert torch.equal(both.truth[3:], pairs.truth)
    assert all(torch.equal(getattr(both.views, n)[:3], getattr(pairs.views, n)) for n in INPUT_NAMES)
    with pytest.raises(ValueError, match="at least one"):
        concatenate_pairs([])


def test_crops_follow_their_seed():
    pairs = some_pairs()
    first, again = (sample_crops(pairs, torch.Generator().manual_seed(1), 4, (32, 48), 0.0) for _ in range(2))
    assert torch.equal(first[1], again[1]) and torch.equal(first[0].color, again[0].color)
    other = sample_crops(pairs, torch.Generator().manual_seed(2), 4, (32, 48), 0.0)
    assert first[1].shape == (4, 3, 32, 48) and not torch.equal(first[1], other[1])


def test_a_crop_is_the_same_window_of_every_image():
    pairs = some_pairs()
    ramp = torch.arange(48 * 64, dtype=torch.float32).reshape(48, 64).remainder(251).to(torch.uint8)
    same = {n: ramp.expand_as(getattr(pairs.views, n)).contiguous() for n in INPUT_NAMES}
    pairs = replace(pairs, views=FixerInputs(**same), truth=ramp.expand_as(pairs.truth).contiguous())
    views, truth = sample_crops(pairs, torch.Generator().manual_seed(3), 6, (32, 48), 0.0)
    for name in INPUT_NAMES:
        assert torch.equal(getattr(views, name)[:, :1], truth[:, :1])


def test_a_clean_crop_is_the_truth_itself():
    views, truth = sample_crops(some_pairs(), torch.Generator().manual_seed(1), 4, (32, 48), 1.0)
    assert torch.equal(views.color, truth) and views.alpha.min() == 1


def scene_of(count: int = 200) -> SceneGraph:
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 6.0])
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    g = Gaussians(
        means, torch.full((count, 3), -1.5), quats, torch.full((count,), 2.0), torch.rand(count, 3, generator=generator)
    )
    return SceneGraph(g, torch.zeros(count, dtype=torch.int64), ())


def test_perturbation_follows_its_seed_and_strength():
    scene = scene_of()
    first, again = (perturb_scene(scene, torch.Generator().manual_seed(4), 0.5).gaussians.pack() for _ in range(2))
    assert torch.equal(first, again)
    assert torch.equal(
        perturb_scene(scene, torch.Generator().manual_seed(4), 0.0).gaussians.pack(), scene.gaussians.pack()
    )
    weak = perturb_scene(scene, torch.Generator().manual_seed(4), 0.1).gaussians.means - scene.gaussians.means
    strong = perturb_scene(scene, torch.Generator().manual_seed(4), 1.0).gaussians.means - scene.gaussians.means
    torch.testing.assert_close(strong, 10 * weak, rtol=1e-3, atol=1e-5)


def test_rendered_pairs_hold_render_reference_and_truth(scene):
    chunk, novel = scene
    truth = [np.full((36, 52, 3), 10 * k, np.uint8) for k in range(5)]
    pairs = render_pairs(
        "beside", chunk, scene_of(), build_lidar_scene(chunk, 100), novel.views, truth, load_source_images(chunk)
    )
    assert len(pairs) == 5 and pairs.kinds == ("beside",) * 5 and pairs.shift_m.tolist() == [3.0] * 5
    assert pairs.truth[3].unique().tolist() == [30]
    assert pairs.views.color.float().std() > 1 and pairs.views.alpha.max() > 100
    assert not pairs.views.lidar_alpha.any()  # the chunk has no points
    views, _ = pairs.as_floats(slice(0, 1))
    assert views.reference.shape == (1, 3, 36, 52) and views.warp_mask.mean() > 0.05
