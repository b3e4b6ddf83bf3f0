"""What recorded images show at a render's pixels: the same as the fixer's inputs tell, looked up with less work."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from genre_tasks.config import IngestConfig, RangeConfig
from genre_tasks.errors import InputError
from genre_tasks.fixer.inputs import build_inputs
from genre_tasks.fixer.source_images import load_source_images
from genre_tasks.fixer.view_surface import unproject_surface
from genre_tasks.fixer.warping import SourceImage
from genre_tasks.logs.registry import open_log
from genre_tasks.reliability.guards import MIN_COVERAGE, compute_guards
from genre_tasks.reliability.recorded_support import look_up_support, select_actors_in_view
from genre_tasks.reliability.reliable_range import measure_guards
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.lidar_map import build_lidar_scene
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import NovelViews
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.novel_views import render_novel
from genre_tasks.threads import torch_threads

LOG = "synthetic:street?seed=901&frames=6&cameras=6&width=96&height=54"


@pytest.fixture(scope="module")
def chunk() -> Chunk:
    return ingest(IngestConfig(width_px=96, height_px=54), open_log(LOG), 0)


@pytest.fixture(scope="module")
def sources(chunk: Chunk) -> tuple[SourceImage, ...]:
    return load_source_images(chunk)


@pytest.fixture(scope="module")
def novel(chunk: Chunk) -> NovelViews:
    """Views on the path and beside it. A sparse LiDAR scene stands for the scene, with surfaces of its own."""
    views = place_novel_views(chunk, (0.0, 2.0), chunk.frames[1:3])
    return render_novel(chunk, build_lidar_scene(chunk, 2000), views, 8000)


def test_support_is_what_the_fixer_would_be_given(
    chunk: Chunk, sources: tuple[SourceImage, ...], novel: NovelViews
) -> None:
    for index in range(len(novel.views)):
        support = look_up_support(chunk, novel, index, sources)
        inputs = build_inputs(chunk, novel, [index], sources)
        covered = inputs.lidar_warp_mask[0, 0] > MIN_COVERAGE
        assert torch.equal(support.shown, inputs.warp_mask[0, 0] > MIN_COVERAGE)
        assert torch.equal(support.covered, covered)
        torch.testing.assert_close(support.colors, inputs.lidar_warped[0][:, covered], rtol=0, atol=1e-6)
    shown = [look_up_support(chunk, novel, index, sources).shown.any() for index in range(len(novel.views))]
    assert sum(map(bool, shown)) > 0.8 * len(shown)


def test_support_counts_distortion(chunk: Chunk, sources: tuple[SourceImage, ...], novel: NovelViews) -> None:
    distorted = tuple(replace(s, lens=replace(s.lens, distortion=(0.05, -0.02, 0.0, 0.0))) for s in sources)
    views = tuple(replace(v, lens=replace(v.lens, distortion=(0.05, -0.02, 0.0, 0.0))) for v in novel.views)
    bent = replace(novel, views=views)
    for index in (0, len(views) - 1):
        support = look_up_support(chunk, bent, index, distorted)
        inputs = build_inputs(chunk, bent, [index], distorted)
        assert torch.equal(support.shown, inputs.warp_mask[0, 0] > MIN_COVERAGE)
        assert torch.equal(support.covered, inputs.lidar_warp_mask[0, 0] > MIN_COVERAGE)


def test_a_view_without_any_depth_has_no_support(
    chunk: Chunk, sources: tuple[SourceImage, ...], novel: NovelViews
) -> None:
    empty = replace(novel, alpha=torch.zeros_like(novel.alpha), lidar_alpha=torch.zeros_like(novel.lidar_alpha))
    support = look_up_support(chunk, empty, 0, sources)
    assert not support.shown.any() and not support.covered.any() and support.colors.shape == (3, 0)
    assert compute_guards(chunk, empty, sources)[0].agreement_db == 0


def test_no_actor_with_a_point_in_view_is_left_out(chunk: Chunk, novel: NovelViews) -> None:
    seen: set[str] = set()
    left_out = 0
    for index, view in enumerate(novel.views):
        arguments = (novel.depth[index], novel.alpha[index], view.chunk_SE3_camera, view.lens)
        actor_of_pixel = unproject_surface(*arguments, chunk.actors, view.frame).actor
        visible = {chunk.actors[k].track_id for k in torch.unique(actor_of_pixel).tolist() if k >= 0}
        selected = select_actors_in_view(chunk.actors, view)
        seen |= visible
        assert visible <= {actor.track_id for actor in selected}
        assert selected == [actor for actor in chunk.actors if any(actor is s for s in selected)]
        left_out += len(chunk.actors) - len(selected)
    assert seen and left_out > 0


def test_guards_do_not_depend_on_the_number_of_threads(
    chunk: Chunk, sources: tuple[SourceImage, ...], novel: NovelViews
) -> None:
    guards = []
    for count in (1, 3):
        with torch_threads(count):
            guards.append(compute_guards(chunk, novel, sources))
    assert guards[0] == guards[1]


def test_the_range_looks_at_frames_that_have_images(chunk: Chunk) -> None:
    config = RangeConfig(shifts_m=(2.0,), every=4, lidar_max_points=2000)
    # The middle of the only interval, and of every camera half of the images.
    for kept in (chunk.frames[:1], chunk.frames[::2]):
        slow = replace(chunk, views=tuple(view for view in chunk.views if view.frame in kept))
        found = {
            n.views[0].frame for n, _ in measure_guards(config, slow, build_lidar_scene(chunk, 500), lambda *_: None)
        }
        assert found and found <= set(kept)
    with pytest.raises(InputError, match="no image"):
        list(measure_guards(config, replace(chunk, views=()), build_lidar_scene(chunk, 500), lambda *_: None))


def test_the_range_renders_what_the_stage_renders(chunk: Chunk) -> None:
    scene = build_lidar_scene(chunk, 2000)
    config = RangeConfig(shifts_m=(2.0,), every=3, lidar_max_points=8000)
    measured = [novel for novel, _ in measure_guards(config, chunk, scene, lambda *_: None)]
    frames = chunk.frames[1::3]
    assert [(n.views[0].shift_m, n.views[0].frame) for n in measured] == [
        (shift, frame) for shift in (0.0, 2.0, -2.0) for frame in frames
    ]
    expected = render_novel(chunk, scene, place_novel_views(chunk, (2.0,), frames), 8000)
    beside = [novel for novel in measured if novel.views[0].shift_m == 2.0]
    for name in ("color", "alpha", "depth", "lidar_color", "lidar_alpha", "lidar_depth"):
        joined = torch.cat([getattr(novel, name) for novel in beside])
        assert np.array_equal(joined.numpy(), getattr(expected, name).numpy())
