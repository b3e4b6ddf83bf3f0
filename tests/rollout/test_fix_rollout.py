"""Fixing rollouts: what the fixer may change, what it looks up, and that a camera's noise stays."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from genre_tasks.config import FnetConfig
from genre_tasks.errors import InputError
from genre_tasks.rollout import fix_rollout
from genre_tasks.rollout.fix_rollout import RolloutFixer
from tests.fixer.conftest import toy
from tests.rollout.small_rollout import OneChunk, covered_by_car, images_at, recorded, without_car


def fixer(source: OneChunk | None = None, **settings: object) -> RolloutFixer:
    config = FnetConfig.model_validate({"half": False, **settings})
    return RolloutFixer(config, source or recorded(), 2000, toy())


def test_every_camera_comes_back_fixed():
    images = images_at(recorded(), 2.5)[0]
    fixed = fixer().fix(images)
    assert fixed.color.shape == images.color.shape
    assert fixed.color.min() >= 0 and fixed.color.max() <= 1
    assert not torch.allclose(fixed.color, images.color, atol=1e-2)
    assert not fixed.filled.any()
    # The network paints whole pixels, also where the render is thin.
    assert images.alpha.min() < 1 and (fixed.alpha == 1).all()


def test_the_same_view_is_fixed_alike_at_every_pose():
    first, second = images_at(recorded(), 2.0, 2.0)
    run = fixer()
    assert torch.equal(run.fix(first).color, run.fix(second).color)


def test_the_image_before_is_looked_up_where_the_configuration_says_so():
    first, second = images_at(recorded(), 2.0, 2.5)
    results = {}
    for temporal in (False, True):
        run = fixer(temporal=temporal)
        run.fix(first)
        results[temporal] = run.fix(second).color
    alone = fixer(temporal=True).fix(second).color
    assert torch.equal(results[False], alone)
    assert not torch.equal(results[True], alone)


def test_after_a_gap_no_image_is_looked_up():
    first, _, third = images_at(recorded(), 2.0, 2.5, 3.0)
    run = fixer(temporal=True)
    run.fix(first)
    assert torch.equal(run.fix(third).color, fixer(temporal=True).fix(third).color)


def test_filling_changes_what_the_actor_covered_and_nothing_else():
    images = images_at(without_car(), 2.0)[0]
    filled = fixer().fill(images)
    area = filled.filled
    assert area.any()
    assert torch.equal(filled.color[~area], images.color[~area])
    assert not torch.equal(filled.color[area], images.color[area])
    assert (filled.alpha[area] == 1).all() and torch.equal(filled.alpha[~area], images.alpha[~area])
    # What the car did not cover was never hidden by it.
    covered = covered_by_car(2.0)
    assert (area & ~covered).sum() <= 0.1 * area.sum()


def test_without_a_removed_actor_nothing_is_filled(monkeypatch):
    monkeypatch.setattr(fix_rollout, "load_source_images", lambda chunk: pytest.fail("read"))
    images = images_at(recorded(), 2.0)[0]
    filled = fixer().fill(images)
    assert torch.equal(filled.color, images.color) and not filled.filled.any()


def test_a_chunk_without_source_images_is_named():
    base = recorded().chunk_scene
    blind = OneChunk(replace(base, chunk=replace(base.chunk, views=())))
    with pytest.raises(InputError, match="no source image"):
        fixer(blind).fix(images_at(recorded(), 2.0)[0])
