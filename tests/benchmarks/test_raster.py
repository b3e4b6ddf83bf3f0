"""The renderer's benchmark: its scenes, its peer, and the arithmetic between seconds and claims. Times are made up."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
import torch

from benchmarks.common.bench import NotMeasuredError
from benchmarks.common.timing import Action, Measured, ratio, take_turns
from benchmarks.raster import BENCH, cells, gsplat_comparison
from benchmarks.raster.gsplat_torch import forward_backward_peer, pairs_of, reference, render_peer
from benchmarks.raster.machine_limits import GEMM_FLOP
from benchmarks.raster.scenes import ATTRIBUTES, CASES, Case, forward, forward_backward, leaves_of, scene, street
from benchmarks.raster.work_count import FLOP_PER_LANE_BACKWARD, FLOP_PER_LANE_FORWARD, Work, count_work

SMALL = Case("small", 300, 48, 64)


def test_the_street_is_the_same_every_time_and_sound() -> None:
    s, again, other = street(300), street(300), street(300, seed=8)
    assert all(torch.equal(getattr(s, n), getattr(again, n)) for n in ATTRIBUTES)
    assert not torch.equal(s.means, other.means)
    assert all(torch.isfinite(getattr(s, n)).all() for n in ATTRIBUTES)
    assert s.means.shape == (300, 3) and s.quats.norm(dim=1).sub(1).abs().max() < 1e-6
    assert s.opacities.min() >= 0.1 and s.opacities.max() <= 0.95
    ground = (s.means[:, 1] - 1.6).abs() < 0.1
    assert 90 <= int(ground.sum()) <= 110  # 30 % of them, and a few cars' wheels


def test_cameras_go_ahead_along_the_street() -> None:
    poses = torch.linalg.inv(scene(SMALL, views=3).cameras.camera_SE3_chunk)
    assert torch.allclose(poses[:, :3, 3], torch.tensor([[0.0, 0, 0], [0, 0, 0.5], [0, 0, 1.0]]), atol=1e-6)


def test_the_peer_renders_what_the_renderer_renders() -> None:
    try:
        gsplat = reference()
    except NotMeasuredError as reason:
        pytest.skip(str(reason))
    s = scene(SMALL)
    pairs = pairs_of(gsplat, s)
    image, alpha = render_peer(gsplat, s.splats, s, pairs)
    own = forward(s, 1)
    assert (own.color - image[..., :3]).abs().max() < 2e-3
    assert (own.alpha - alpha[..., 0]).abs().max() < 2e-3
    assert abs(len(pairs.gaussians) - count_work(s.splats, s.cameras).contributions) <= 1e-3 * len(pairs.gaussians)
    ours = leaves_of(s.splats)
    theirs = leaves_of(s.splats)
    forward_backward(s, ours, 1)
    forward_backward_peer(gsplat, theirs, s, pairs)
    for name in ATTRIBUTES:
        a, b = getattr(ours, name).grad, getattr(theirs, name).grad
        assert (a - b).norm() < 5e-3 * b.norm(), name


def test_a_missing_peer_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.raster.gsplat_torch.VERSION", "0.0.1")
    with pytest.raises(NotMeasuredError, match=r"needs gsplat 0\.0\.1"):
        gsplat_comparison.measure_peer(SMALL, 1)


def test_actions_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.common.timing.seconds_of", lambda action: float(action() or 0))
    called: list[str] = []
    actions = {name: (lambda name=name: called.append(name)) for name in "ab"}
    assert take_turns(actions, 2) == {"a": [0.0, 0.0], "b": [0.0, 0.0]}
    assert "".join(called) == "ab" + "ab" + "ba"


def test_a_ratio_is_taken_round_by_round() -> None:
    assert ratio([2.0, 8.0, 3.0], [1.0, 2.0, 1.0]) == Measured(3.0, 2.5, 3.5, 3)


def test_numbers_follow_from_seconds_and_work(monkeypatch: pytest.MonkeyPatch) -> None:
    work = Work(drawn=10, tile_pairs=20, lanes=4000, contributions=1000)
    seconds = {"forward+backward 1": 6e-6, "forward+backward 2": 4e-6, "gemm 2": 0.5}

    def made_up(actions: Mapping[str, Action], rounds: int) -> dict[str, list[float]]:
        return {name: [seconds.get(name, 1.0)] * rounds for name in actions}

    monkeypatch.setattr(cells, "take_turns", made_up)
    monkeypatch.setattr(cells, "copy", lambda threads: None)
    monkeypatch.setattr(cells, "gemm", lambda threads: None)
    monkeypatch.setattr(cells, "count_work", lambda splats, cameras: work)
    row = cells.measure_scene(SMALL, 3)
    flop = FLOP_PER_LANE_FORWARD + FLOP_PER_LANE_BACKWARD
    assert row["ns_per_pair"] == pytest.approx({"median": 4.0, "low": 4.0, "high": 4.0, "n": 3})
    assert row["lane_density"] == 0.25 and row["two_threads_gain"]["median"] == pytest.approx(1.5)
    assert row["gflop_s"]["median"] == pytest.approx(flop * 4000 / 4e-6 / 1e9)
    assert row["gemm_share"]["median"] == pytest.approx(flop * 4000 / 4e-6 / (GEMM_FLOP / 0.5))
    assert row["gemm_share_of_contributing"]["median"] == pytest.approx(row["gemm_share"]["median"] / 4)
    rows = _nothing_measured() | {f"scene/{case.name}": row for case in CASES}
    claims = {c.id: c for c in BENCH.claims(rows)}
    assert (claims["raster.ns_per_pair"].measured, claims["raster.ns_per_pair"].holds) == (pytest.approx(4.0), False)
    assert claims["raster.ns_per_pair"].n == 3 and claims["raster.ns_per_pair"].spread is not None
    assert claims["raster.vs_gsplat_torch"].measured is None
    table = "\n".join(BENCH.table(rows))
    assert "| ns a contributing pair | 4.00 (4.00–4.00) |" in table
    assert "| peer/300k | not measured: no such machine |" in table


def _nothing_measured() -> dict[str, dict[str, object]]:
    return {c.name: {"not_measured": "no such machine"} for c in BENCH.cells({}, quick=False)}


def test_claims_that_were_not_measured_fail() -> None:
    claims = list(BENCH.claims(_nothing_measured()))
    assert {c.id.split(".")[1] for c in claims} == {
        "vs_gsplat_torch",
        "ns_per_pair",
        "gemm_share",
        "many_views",
        "threads",
        "avx2",
        "build_s",
    }
    assert not any(c.holds for c in claims)
