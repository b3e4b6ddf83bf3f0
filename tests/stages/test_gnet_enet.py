"""The stages gnet and enet on a small ray-cast street, with the weights that ship."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from genre_tasks.config import IngestConfig, InitialConfig, LossConfig, OptimiserConfig
from genre_tasks.errors import InputError
from genre_tasks.learned.weights import load_optimiser
from genre_tasks.logs.registry import open_log
from genre_tasks.losses.targets import Target, novel_targets, source_targets, view_targets
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.render import render_views
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import FixedViews
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.enet import enet
from genre_tasks.stages.gnet import gnet
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial
from genre_tasks.weights import resolve_weights
from tests.optimiser import street_scenes

LOG = "synthetic:street?seed=903&width=96&height=54&samples=1&lidar_beams=32&lidar_azimuths=450&frames=9&cameras=2"
LOSS = LossConfig(perceptual=0.0)


@pytest.fixture(scope="module")
def chunk() -> Chunk:
    return ingest(IngestConfig(width_px=96, height_px=54), open_log(LOG), 0)


@pytest.fixture(scope="module")
def start(chunk: Chunk) -> Reconstruction:
    return initial(InitialConfig(max_points=3000, distant_count=300), chunk)


@pytest.fixture(scope="module")
def reconstructed(chunk: Chunk, start: Reconstruction) -> Reconstruction:
    return gnet(OptimiserConfig(iterations=12, views_per_iteration=4, loss=LOSS, snapshots=2), chunk, start)


def _psnr(scene: SceneGraph, targets: tuple[Target, ...]) -> float:
    with torch.no_grad():
        images = render_views(scene, targets).color.clamp(0, 1)
    error = (images - torch.stack([t.image.pixels for t in targets])).square().mean((1, 2, 3))
    return float((-10 * torch.log10(error)).mean())


def test_gnet_improves_frames_that_it_did_not_see(
    chunk: Chunk, start: Reconstruction, reconstructed: Reconstruction
) -> None:
    heldout = view_targets(chunk, chunk.views_with_role("heldout"))
    assert _psnr(reconstructed.scene, heldout) > _psnr(start.scene, heldout) + 1.0
    assert sorted(reconstructed.snapshots) == [4, 8]
    assert reconstructed.losses[-1] < reconstructed.losses[0]


def test_enet_takes_up_what_the_fixed_views_show(chunk: Chunk, reconstructed: Reconstruction) -> None:
    log = open_log(LOG)
    views = place_novel_views(chunk, (3.0, -3.0))
    assert log.truth is not None
    images = [log.truth.image(v.frame, chunk.world_SE3_chunk @ v.chunk_SE3_camera, v.lens) for v in views]
    fixed = FixedViews(views, torch.from_numpy(np.stack(images).astype(np.float32) / np.float32(255)))
    config = OptimiserConfig(iterations=12, views_per_iteration=4, novel_views_per_iteration=4, loss=LOSS)
    result = enet(config, chunk, reconstructed, fixed)
    novel, heldout = novel_targets(fixed), view_targets(chunk, chunk.views_with_role("heldout"))
    assert _psnr(result.scene, novel) > _psnr(reconstructed.scene, novel) + 0.3
    assert _psnr(result.scene, heldout) > _psnr(reconstructed.scene, heldout) - 0.5


def test_adam_needs_no_weights_and_missing_ones_are_named(chunk: Chunk, start: Reconstruction, tmp_path: Path) -> None:
    config = OptimiserConfig(iterations=2, views_per_iteration=2, loss=LOSS, weights=str(tmp_path / "none.safetensors"))
    assert len(gnet(config.model_copy(update={"method": "adam"}), chunk, start).losses) == 2
    with pytest.raises(InputError, match="do not exist") as raised:
        gnet(config, chunk, start)
    assert raised.value.file == str(tmp_path / "none.safetensors")


def test_an_unreadable_image_is_named(chunk: Chunk, start: Reconstruction) -> None:
    broken = tuple(replace(v, image=v.image[:100]) if v.role == "source" else v for v in chunk.views)
    with pytest.raises(InputError, match="decode") as raised:
        gnet(OptimiserConfig(iterations=1, loss=LOSS, method="adam"), replace(chunk, views=broken), start)
    first = chunk.views_with_role("source")[0]
    assert (raised.value.camera, raised.value.frame, raised.value.log) == (first.camera, first.frame, chunk.log)


def test_a_chunk_without_source_views_is_refused(chunk: Chunk) -> None:
    with pytest.raises(InputError, match="no source view"):
        source_targets(replace(chunk, views=chunk.views_with_role("heldout")), depth=False)


@pytest.mark.parametrize("name", ["gnet", "enet"])
def test_the_shipped_weights_stay_stable_at_ten_times_their_horizon(name: str) -> None:
    path = resolve_weights(name, "builtin")
    assert path.stat().st_size < 2_000_000
    rule, truth = load_optimiser(path), street_scenes.scene()
    start, views, objective = street_scenes.blurred(truth), street_scenes.targets(truth), Objective(LOSS)
    horizon = 24 if name == "gnet" else 12
    short = unroll(rule, start, views, (), objective, UnrollSettings(horizon, 4))
    long = unroll(rule, start, views, (), objective, UnrollSettings(10 * horizon, 4))
    assert long.losses[-1] <= short.losses[-1] * 1.05
    assert bool(torch.isfinite(long.scene.gaussians.pack()).all())
