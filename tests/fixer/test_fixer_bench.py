"""The fixer's benchmark: from images to numbers, from numbers to claims."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from benchmarks.common.bench import Row
from benchmarks.fixer import BENCH
from benchmarks.fixer.cells import compare_with_truth, measure_seconds
from benchmarks.fixer.flicker import flicker
from benchmarks.fixer.view_statistics import interval
from genre_tasks.config import FnetConfig
from tests.fixer.conftest import toy


def _street(seed: int, gain_db: float, part: float) -> Row:
    """A log whose two views gain so much."""
    before = {"psnr": [20.0, 22.0], "perceptual": [0.4, 0.6]}
    after = {
        "psnr": [x + gain_db for x in before["psnr"]],
        "perceptual": [x * (1 - part) for x in before["perceptual"]],
    }
    truth = {"render": before, "fixed": after, "clean": {"psnr": [36.0, 40.0], "perceptual": [0.0, 0.0]}}
    spent = {"psnr": [24.0, 25.0], "seconds": 0.2}
    inputs = {
        "render": spent | {"perceptual": [0.40, 0.50]},
        "render+reference": spent | {"perceptual": [0.38, 0.46]},
        "render+reference+lidar": spent | {"perceptual": [0.36, 0.43]},
    }
    gate = [{"shift": 0.5, "need": [0.1, 0.3], "render": [0.2, 0.4], "fixed": [0.21, 0.3]}]
    loose = truth | {"fixed": after | {"psnr": [x + 0.5 for x in after["psnr"]]}}
    own = {"truth": truth, "loose": loose, "inputs": inputs, "gate": gate}
    return _log(f"synthetic:street?seed={seed}", 0.9) | own


def _log(log: str, flicker_ratio: float) -> Row:
    spent = {"views": 10, "size": [180, 320], "batch": 4, "seconds": [1.0, 2.0, 9.0]}
    return {
        "log": log,
        "chunk": 0,
        "flicker": {"frames": 20, "render": 0.1, "fixed": 0.1 * flicker_ratio, "truth": 0.3},
        "time": spent,
    }


def test_claims_are_means_over_views_and_the_worst_log() -> None:
    kernel = {s: {"n": 8, "render": 0.2, "difference": -0.05, "low": -0.06, "high": -0.01} for s in ("1", "2")}
    kernel["3"] = kernel["1"] | {"high": 0.01}
    real = _log("pandaset:logs/002", 1.1) | {"kernel": kernel}
    rows = {"a": _street(1, 1.0, 0.2), "b": _street(2, 2.0, 0.4), "real": real}
    claims = {c.id: c for c in BENCH.claims(rows)}
    assert claims["fixer.psnr_3m"].measured == pytest.approx(1.5) and claims["fixer.psnr_3m"].holds
    assert claims["fixer.perceptual_3m"].measured == pytest.approx(0.3)
    assert claims["fixer.psnr_3m_loose"].measured == pytest.approx(2.0)
    assert claims["fixer.perceptual_3m_loose"].measured == pytest.approx(0.3)
    assert claims["fixer.identity"].measured == 36.0
    assert claims["fixer.flicker"].measured == pytest.approx(1.1) and not claims["fixer.flicker"].holds
    assert "of true images: 3.00 to 3.00" in claims["fixer.flicker"].data
    assert claims["fixer.real_kernel_1m"].holds and not claims["fixer.real_kernel_3m"].holds
    assert "-25.0% of 0.2000" in claims["fixer.real_kernel_3m"].data
    assert claims["fixer.seconds_per_frame"].measured == pytest.approx(0.2)
    assert claims["fixer.vs_src_ref"].measured == pytest.approx(0.025 / 0.42) and claims["fixer.vs_src_ref"].holds
    assert 0 < claims["fixer.vs_src_ref_low"].measured < claims["fixer.vs_src_ref"].measured
    assert claims["fixer.vs_src"].measured == pytest.approx(0.04 / 0.45) and claims["fixer.vs_src"].holds
    assert claims["fixer.vs_ref_lidar"].measured is None and not claims["fixer.vs_ref_lidar"].holds
    assert claims["fixer.no_view_worse"].measured == pytest.approx(0.05) and not claims["fixer.no_view_worse"].holds
    assert "the worst at 0.5 m" in claims["fixer.no_view_worse"].data
    text = "\n".join(BENCH.table(rows))
    assert "chunk 0 | not held | 21.000 | 22.500 | 0.500 | 0.400 |" in text
    assert "| 0.5 | 4 | 0.100 | 0.200 | 0.300 | 0.300 | 0.255 | +5.0% |" in text
    assert "| render+reference | 24.500 | 0.420 | 0.200 |" in text
    assert (
        "| 21.000 | 22.000 | 0.500 | 0.400 | 38.00 | 0.900 | 3.000 | 0.200 |" in text and "(-0.0600 … +0.0100)" in text
    )


def test_what_is_not_measured_is_said() -> None:
    rows: dict[str, Row] = {"real": {"not_measured": "no data"}}
    assert all(c.measured is None and not c.holds for c in BENCH.claims(rows))
    assert "no data" in "\n".join(BENCH.table(rows))


def test_the_interval_holds_the_mean_and_narrows() -> None:
    values = [0.0, 1.0] * 8
    low, high = interval(values) or (0, 0)
    assert low < 0.5 < high
    narrow = interval(values * 16) or (0, 0)
    assert narrow[1] - narrow[0] < 0.5 * (high - low)
    assert interval([]) is None


def test_a_quick_run_takes_one_street() -> None:
    assert len(BENCH.cells(BENCH.options, quick=False)) == 6
    (cell,) = BENCH.cells(BENCH.options, quick=True)
    assert "seed=1001" in cell.name


def test_flicker_is_the_difference_between_frames_that_see_the_same(scene):
    _, novel = scene
    first = novel.views[0]
    still = replace(novel, views=(first,) * 5, alpha=torch.ones_like(novel.alpha))
    images = torch.full_like(novel.color, 0.4)
    assert flicker(images, still) == pytest.approx(0, abs=1e-6)
    images[2] += 0.2
    assert flicker(images, still) == pytest.approx(0.2 * 2 / 4, rel=1e-3)
    assert flicker(images, replace(still, alpha=torch.zeros_like(novel.alpha))) == 0


def test_flicker_follows_the_camera(scene):
    _, novel = scene
    first = novel.views[0]
    pose = first.chunk_SE3_camera.copy()
    pose[0, 3] += 8.0 / first.lens.fx_px  # a pixel at this depth
    pair = replace(
        novel, views=(first, replace(first, chunk_SE3_camera=pose)), depth=novel.depth[:2], alpha=torch.ones(2, 36, 52)
    )
    before = torch.rand(36, 52, 3, generator=torch.Generator().manual_seed(0))
    after = before.roll(-1, 1)
    assert flicker(torch.stack([before, after]), pair) == pytest.approx(0, abs=1e-4)
    assert flicker(torch.stack([before, before]), pair) > 0.1


def test_render_fixed_and_clean_are_judged_against_the_truth(scene):
    chunk, novel = scene
    truth = torch.rand(novel.color.shape, generator=torch.Generator().manual_seed(1))
    row = compare_with_truth(toy(), FnetConfig(), chunk, novel, truth)
    assert set(row) == {"render", "fixed", "clean"} and all(len(v["psnr"]) == 5 for v in row.values())
    assert max(row["render"]["psnr"]) < 15 and min(row["clean"]["psnr"]) > max(row["render"]["psnr"])
    identity = compare_with_truth(toy(trained=False), FnetConfig(), chunk, novel, truth)
    assert min(identity["clean"]["psnr"]) > 60 and max(identity["clean"]["perceptual"]) < 1e-3


def test_every_run_is_timed(scene):
    chunk, novel = scene
    row = measure_seconds(toy(), FnetConfig(), chunk, novel)
    assert (row["views"], row["size"], len(row["seconds"])) == (5, [36, 52], 3)
    assert row["seconds"] == sorted(row["seconds"]) and row["seconds"][0] > 0
