"""Fixing rollouts: what the fixer may change, what it looks up, and that a camera's noise stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from genre_tasks.config import FnetConfig
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.recorded_path import join_recorded_path
from genre_tasks.errors import InputError
from genre_tasks.rollout import fix_rollout
from genre_tasks.rollout.fix_rollout import RolloutFixer
from genre_tasks.rollout.render_rollout import render_rollout
from genre_tasks.rollout.rig import estimate_rig
from genre_tasks.scene_edits.chunk_scene import SceneSource
from tests.fakes import END_X_M, SENSOR_HEIGHT_M
from tests.fixer.conftest import toy
from tests.rollout.small_rollout import (
    OneChunk,
    TwoChunks,
    covered_by_car,
    images_at,
    recorded,
    remove_car,
    two_chunks,
    without_car,
)


def fixer(source: SceneSource | None = None, **settings: object) -> RolloutFixer:
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


def test_what_is_filled_has_the_depth_of_the_background():
    images = images_at(without_car(), 2.0)[0]
    # A hole shows anything: the render looks through thin Gaussians there.
    images = replace(images, depth=torch.full_like(images.depth, 500.0))
    lens = images.views[0].lens
    rows = torch.arange(lens.height_px) + 0.5 - lens.cy_px
    # The camera is level, 0.2 m below the sensor and 0.3 m ahead of it.
    ground = torch.where(rows > 0, (SENSOR_HEIGHT_M - 0.2) * lens.fy_px / rows, torch.inf)
    truth = ground.clamp(max=END_X_M - 0.6 - 0.3)[:, None].expand(lens.height_px, lens.width_px)
    for repair in (fixer().fill, fixer().fix):
        fixed = repair(images)
        area = fixed.filled[0]
        assert area.any() and (fixed.depth[0][~area] == 500.0).all()
        error = (fixed.depth[0] - truth).abs() / truth
        assert error[area].median() < 0.1


def test_what_was_hidden_is_filled_at_moments_of_another_chunk_too():
    parts = two_chunks().chunk_scenes
    path = join_recorded_path([part.chunk for part in parts])
    # The vehicle stands where the first chunk shows the street, and the traffic drives on into the second.
    standing = EgoPath(np.array([0.9]), np.array([9.0]), path.world_SE3_ego[[6]])
    rig = estimate_rig([part.chunk for part in parts])
    edited = TwoChunks(tuple(remove_car(part) for part in parts))
    (images,) = render_rollout(edited, standing, rig)
    assert images.chunk == 0
    area = fixer(two_chunks()).fill(images).filled
    # What the first chunk's images lack is where the car was at the last of them.
    last = replace(standing, frames=np.array([7.0]))
    shown, hidden = (next(iter(render_rollout(source, last, rig))) for source in (two_chunks(), edited))
    covered = (shown.color - hidden.color).abs().amax(-1) > 2 / 255
    assert area.any() and (area & ~covered).sum() <= 0.1 * area.sum()


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
