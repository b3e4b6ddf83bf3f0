"""Ingest and initial scene of the real sequence's first chunk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from genre_tasks.config import IngestConfig, InitialConfig
from genre_tasks.logs.registry import open_log
from genre_tasks.render import render_views
from genre_tasks.scene.image_decoding import decode_image
from genre_tasks.scene.lidar_depth import compute_lidar_depth
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial

SEQUENCE = Path(__file__).parents[3] / "shared" / "data" / "pandaset" / "002"

pytestmark = [
    pytest.mark.real,
    pytest.mark.skipif(not SEQUENCE.is_dir(), reason="the PandaSet sequence is not beside the checkout"),
]


def test_first_chunk() -> None:
    chunk = ingest(IngestConfig(width_px=320, height_px=180), open_log(f"pandaset:{SEQUENCE}"), 0)
    assert len(chunk.views) == 120 and 10 <= len(chunk.actors) <= 40
    assert chunk.static.colored.mean() > 0.8
    assert sum(m.kind == "missing_sweep" for m in chunk.log_issues) == 0
    scene = initial(InitialConfig(max_points=20_000, distant_count=2000), chunk).scene
    views = chunk.views_with_role("heldout")[::7]
    images = render_views(scene, views).color.clamp(0, 1)
    truth = [decode_image(v.image, 320, 180) for v in views]
    scores = [float(-10 * ((c - t) ** 2).mean().log10()) for c, t in zip(images, truth, strict=True)]
    assert np.mean(scores) > 20.0
    depth = compute_lidar_depth(chunk, chunk.views[0])
    assert float((depth > 0).float().mean()) > 0.02 and float(depth.max()) < 250


def test_short_last_chunk_with_a_hole() -> None:
    chunk = ingest(IngestConfig(width_px=160, height_px=90), open_log(f"pandaset:{SEQUENCE}"), 1)
    assert chunk.frames == tuple(range(20, 32))
    assert sorted(m.frame for m in chunk.log_issues if m.kind == "missing_sweep") == [28, 29, 30]
