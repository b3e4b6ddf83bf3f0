"""The renderer's benchmark: its scenes, its peer, and the arithmetic between seconds and claims. Times are made up."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from benchmarks.common.bench import NotMeasuredError
from benchmarks.common.timing import Action, Quartiles, ratio, time_in_turns
from benchmarks.raster import BENCH, ablation, cells, gsplat_comparison
from benchmarks.raster.gsplat_torch import forward_backward_reference, list_pairs, load_reference, render_reference
from benchmarks.raster.machine_limits import GEMM_FLOP
from benchmarks.raster.scenes import ATTRIBUTES, CASES, Case, forward, forward_backward, gradient_leaves, scene, street
from benchmarks.raster.work_count import FLOP_PER_LANE_BACKWARD, FLOP_PER_LANE_FORWARD, Work, count_work
from genre_tasks.compiled.loader import candidate_instruction_sets
from genre_tasks.render import RenderSettings, cpu, render
from genre_tasks.render.kernel.build import ABLATIONS, KERNEL
from genre_tasks.render.kernel.library import load_kernel

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
        gsplat = load_reference()
    except NotMeasuredError as reason:
        pytest.skip(str(reason))
    s = scene(SMALL)
    pairs = list_pairs(gsplat, s)
    image, alpha = render_reference(gsplat, s.splats, s, pairs)
    own = forward(s, 1)
    assert (own.color - image[..., :3]).abs().max() < 2e-3
    assert (own.alpha - alpha[..., 0]).abs().max() < 2e-3
    assert abs(len(pairs.gaussians) - count_work(s.splats, s.cameras).contributions) <= 1e-3 * len(pairs.gaussians)
    ours = gradient_leaves(s.splats)
    theirs = gradient_leaves(s.splats)
    forward_backward(s, ours, 1)
    forward_backward_reference(gsplat, theirs, s, pairs)
    for name in ATTRIBUTES:
        a, b = getattr(ours, name).grad, getattr(theirs, name).grad
        assert (a - b).norm() < 5e-3 * b.norm(), name


def test_a_missing_peer_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.raster.gsplat_torch.VERSION", "0.0.1")
    with pytest.raises(NotMeasuredError, match=r"needs gsplat 0\.0\.1"):
        gsplat_comparison.measure_torch_reference(SMALL, 1)


def test_actions_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.common.timing.median_call_seconds", lambda action: float(action() or 0))
    called: list[str] = []
    actions = {name: (lambda name=name: called.append(name)) for name in "ab"}
    assert time_in_turns(actions, 2) == {"a": [0.0, 0.0], "b": [0.0, 0.0]}
    assert "".join(called) == "ab" + "ab" + "ba"


def test_a_ratio_is_taken_round_by_round() -> None:
    assert ratio([2.0, 8.0, 3.0], [1.0, 2.0, 1.0]) == Quartiles(3.0, 2.5, 3.5, 3)


def test_numbers_follow_from_seconds_and_work(monkeypatch: pytest.MonkeyPatch) -> None:
    work = Work(drawn=10, tile_pairs=20, lanes=4000, contributions=1000)
    seconds = {"forward+backward 1": 6e-6, "forward+backward 2": 4e-6, "gemm 2": 0.5}

    def made_up(actions: Mapping[str, Action], rounds: int) -> dict[str, list[float]]:
        return {name: [seconds.get(name, 1.0)] * rounds for name in actions}

    monkeypatch.setattr(cells, "time_in_turns", made_up)
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
    assert "peer/300k: not measured: no such machine" in table


def _nothing_measured() -> dict[str, dict[str, object]]:
    return {c.name: {"not_measured": "no such machine"} for c in BENCH.cells({}, quick=False)}


def test_the_kernel_has_every_switch_that_is_ablated() -> None:
    text = "".join((KERNEL.folder / name).read_text() for name in KERNEL.sources if Path(name).suffix in (".cpp", ".h"))
    assert set(ablation.SWITCHES.values()) == set(ABLATIONS)
    assert all(re.search(rf"#ifn?def {switch}\b", text) for switch in ABLATIONS)


@pytest.mark.slow
def test_a_kernel_without_its_guards_renders_the_same_and_culls_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    isa = candidate_instruction_sets()[0]
    monkeypatch.setenv("GENRE_RENDER_ISA", isa)
    library = ablation.build_without("guards", tmp_path, isa)
    assert library.parent == tmp_path and [p.name for p in tmp_path.iterdir()] == [KERNEL.library_name(isa)]
    s = scene(SMALL)
    zero = s.splats.quats.clone()
    zero[0] = 0.0
    without_direction = replace(s.splats, quats=zero)
    ordinary = forward(s, 1)
    assert render(without_direction, s.cameras, RenderSettings("cpu", 1)).culled == {"quaternion": 1}
    monkeypatch.setattr(cpu, "load_kernel", partial(load_kernel, tmp_path))
    ablated = forward(s, 1)
    torch.testing.assert_close(ablated.color, ordinary.color, atol=1e-5, rtol=0)
    torch.testing.assert_close(ablated.depth, ordinary.depth, atol=1e-4, rtol=0)
    assert render(without_direction, s.cameras, RenderSettings("cpu", 1)).culled == {}


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
