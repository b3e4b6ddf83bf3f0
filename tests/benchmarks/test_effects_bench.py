"""The benchmark of effects: which logs, what is claimed, where a threshold sits."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.common.bench import TINY_SETTINGS, TINY_STREET, NotMeasuredError
from benchmarks.effects import EFFECTS
from benchmarks.effects.cases import CASES, LONGEST_S, MILD_FACTOR
from benchmarks.effects.cells import ChunkLocation, evaluate_settings, measure_on_pandaset
from benchmarks.effects.measures import (
    FOOTPRINT_RATIO,
    heldout_psnr,
    masked_cameras_psnr,
    psnr_where_footprints_change,
)
from benchmarks.effects.report import find_threshold
from benchmarks.effects.whole_plans import compare_trained
from flows.cli.bench import load_bench
from flows.training.train_job import TrainJob
from genre_tasks.config import IngestConfig, InitialConfig
from genre_tasks.effects.anti_aliasing import footprint_ratios
from genre_tasks.effects.plan import EFFECT_NAMES as NAMES
from genre_tasks.effects.types import EffectParameters
from genre_tasks.logs.registry import open_log
from genre_tasks.metrics.scoring import decode_view_image
from genre_tasks.render.api import render_views
from genre_tasks.scene.visibility import find_visible_points
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial


def row(name: str, factor: float, on: float, off: float, value: float = 3.0, unit: str = "dB") -> dict:
    each = {"heldout_db": 20.0, "beside_db": None, "gnet_s": 2.0, "plan_s": 3.0}
    return {
        "effect": name,
        "log": f"synthetic:street?seed={factor}",
        "chunk": 0,
        "factor": factor,
        "unit": unit,
        "value": value,
        "threshold": 1.0,
        "property_unit": "px",
        "choice": "on",
        "on": each | {"measure": on},
        "off": each | {"measure": off},
    }


def test_it_is_registered_and_its_cases_are_effects() -> None:
    assert load_bench("effects") is EFFECTS and set(CASES) < set(NAMES)


@pytest.mark.parametrize("name", list(CASES))
def test_streets_can_be_asked_to_call_for_each(name: str) -> None:
    case = CASES[name]
    for factor in (0.0, 1.0, 4.0):
        if factor == 0 and name == "lidar_depth":
            continue
        # A parameter that streets do not have would be refused here.
        assert open_log(f"synthetic:street?seed=1{case.query(factor, 340.0)}").frame_count


def test_no_street_is_without_a_use_for_lidar_depth() -> None:
    with pytest.raises(ValueError, match="every street"):
        CASES["lidar_depth"].query(0.0, 340.0)
    cells = EFFECTS.cells(dict(EFFECTS.options) | {"seeds": "1", "effects": "lidar_depth", "pandaset": ""}, False)
    assert [c.name for c in cells] == ["lidar_depth street 1 x 4"]
    claims = [c.id for c in EFFECTS.claims({}) if c.id.endswith("lidar_depth")]
    assert claims == ["effects.gain_lidar_depth"]


def test_a_slow_street_takes_longer_for_as_many_pixels() -> None:
    case = CASES["rolling_shutter"]
    seconds = [float(case.query(*at).rpartition("=")[2]) for at in ((4.0, 800.0), (4.0, 400.0), (0.0, 400.0))]
    assert seconds == pytest.approx([seconds[0], 2 * seconds[0], 2 * seconds[0] * MILD_FACTOR / 4], rel=1e-3)
    assert float(case.query(4.0, 1.0).rpartition("=")[2]) == LONGEST_S


def test_cells_are_streets_with_and_without_and_the_real_chunks() -> None:
    options = dict(EFFECTS.options) | {"seeds": "1,2", "effects": "exposure,ego_mask"}
    assert len(EFFECTS.cells(options, False)) == 2 * (2 * 2 + 2)
    assert len(EFFECTS.cells(options | {"pandaset": ""}, False)) == 8
    assert len(EFFECTS.cells(options | {"chunks": ""}, False)) == 8
    assert len(EFFECTS.cells(options, True)) == 4
    whole = [c.name for c in EFFECTS.cells(options | {"effects": "auto_vs_on,plain_cost"}, False)]
    assert whole == ["auto_vs_on street 1", "auto_vs_on street 2", "plain_cost street 1"]


def test_a_log_without_what_an_effect_needs_is_not_measured(tmp_path: Path) -> None:
    location = ChunkLocation(f"synthetic:street?seed={TINY_STREET}", 0, str(tmp_path), tuple(TINY_SETTINGS.split()))
    # As PandaSet's logs, this street states no exposure time.
    with pytest.raises(NotMeasuredError, match="states no exposure time"):
        measure_on_pandaset("motion_blur", location)


def test_claims_are_of_four_times_the_threshold_and_of_plain_streets() -> None:
    rows = {
        "a": row("exposure", 4.0, 27.0, 26.2),
        "b": row("exposure", 0.0, 27.0, 26.8),
        "c": row("lidar_depth", 4.0, -3.0, -4.0, unit="%"),
        "d": row("exposure", -1.0, 9.0, 1.0),
        "e": {"not_measured": "no data"},
    }
    claims = {c.id: c for c in EFFECTS.claims(rows)}
    assert claims["effects.gain_exposure"].measured == pytest.approx(0.8) and claims["effects.gain_exposure"].holds
    assert claims["effects.loss_exposure"].measured == pytest.approx(0.2) and not claims["effects.loss_exposure"].holds
    assert claims["effects.gain_lidar_depth"].measured == pytest.approx(25.0)
    assert claims["effects.gain_ego_mask"].measured is None and not claims["effects.gain_ego_mask"].holds
    assert claims["effects.plain_cost"].measured is None and claims["effects.auto_vs_on"].measured is None
    table = list(EFFECTS.table(rows))
    assert len([line for line in table if line.startswith("| ")]) == 5 and "e: not measured: no data" in table[-1]


def test_whole_plans_are_claimed_by_what_auto_leaves_and_what_a_plan_adds() -> None:
    streets = [(25.0, 25.1), (25.0, 24.9), (25.0, 25.3)]
    each = [{"auto": {"heldout_db": a}, "on": {"heldout_db": b}} for a, b in streets]
    rows = {str(k): r | {"whole": "auto_vs_on", "log": f"street {k}"} for k, r in enumerate(each)}
    rows["n"] = {"whole": "plain_cost", "log": "plain", "cost_percent": {"planned": 0.1, "planning": 30.0}}
    claims = {c.id: c for c in EFFECTS.claims(rows)}
    assert claims["effects.auto_vs_on"].measured == pytest.approx(0.1) and claims["effects.auto_vs_on"].holds
    assert claims["effects.plain_cost"].measured == 0.1 and claims["effects.plain_cost"].holds
    assert any("+30.00 % with making it" in line for line in EFFECTS.table(rows))


def test_a_threshold_is_read_between_two_measurements() -> None:
    rows = [row("exposure", f, 27.0 + g, 27.0, value=v) for f, g, v in ((1.0, 0.0, 2.0), (2.0, 0.2, 4.0))]
    assert find_threshold(rows, 0.1) == pytest.approx(3.0)
    assert find_threshold(rows[:1], 0.1) is None
    assert any("0.1 dB at 3 px" in line for line in EFFECTS.table(dict(zip("ab", rows, strict=True))))


def test_all_cameras_are_judged_but_for_the_ego_mask() -> None:
    street = open_log("synthetic:street?seed=1020&frames=8&cameras=2&width=96&height=54&samples=1")
    chunk = ingest(IngestConfig(width_px=96, height_px=54), street, 0)
    scene = initial(InitialConfig(max_points=2000, distant_count=200), chunk).scene
    camera, other = chunk.camera_names
    by_camera = {c: replace(chunk, views=tuple(v for v in chunk.views if v.camera == c)) for c in (camera, other)}
    each = {c: heldout_psnr(part, scene) for c, part in by_camera.items()}
    assert each[camera] != each[other]
    nothing = np.zeros((54, 96), bool)
    masked = replace(chunk, views=tuple(replace(v, ego_mask=nothing) if v.camera == camera else v for v in chunk.views))
    assert masked_cameras_psnr(masked, scene) == pytest.approx(each[camera])
    assert heldout_psnr(masked, scene) == pytest.approx(np.mean(list(each.values())))
    assert masked_cameras_psnr(chunk, scene) == heldout_psnr(chunk, scene)
    assert CASES["ego_mask"].measure is masked_cameras_psnr and CASES["exposure"].measure is heldout_psnr


def test_what_is_seen_from_far_and_near_is_judged_alone() -> None:
    street = open_log("synthetic:street?seed=1020&frames=8&cameras=2&width=160&height=90&samples=1")
    chunk = ingest(IngestConfig(width_px=160, height_px=90), street, 0)
    scene = initial(InitialConfig(max_points=2000, distant_count=200), chunk).scene
    view = chunk.views_with_role("heldout")[0]
    image = decode_view_image(view).numpy()
    points = chunk.static.positions[chunk.static.frames >= 0]
    index, uv, _ = find_visible_points(points, view)
    u, v = uv[footprint_ratios(chunk, points)[index] > FOOTPRINT_RATIO].astype(int).T
    judged = np.zeros(image.shape[:2], bool)
    judged[v, u] = True
    assert 0.01 < judged.mean() < 0.5
    inside, outside = image.copy(), image.copy()
    inside[judged], outside[~judged] = 1 - inside[judged], 1 - outside[~judged]
    as_it_is, elsewhere, there = (
        psnr_where_footprints_change(chunk, scene, [(view, x)]) for x in (image, outside, inside)
    )
    assert elsewhere == as_it_is and there < as_it_is - 1
    assert np.isnan(psnr_where_footprints_change(chunk, scene, []))
    # Where nothing differs there is no logarithm.
    with torch.no_grad():
        drawn = render_views(scene, [view]).color.clamp(0, 1)[0].numpy()
    assert psnr_where_footprints_change(chunk, scene, [(view, drawn)]) == pytest.approx(100.0)


def test_a_measure_of_nothing_ends_its_cell_alone(tmp_path: Path) -> None:
    location = ChunkLocation(f"synthetic:street?seed={TINY_STREET}", 0, str(tmp_path), tuple(TINY_SETTINGS.split()))
    with pytest.raises(NotMeasuredError, match="no pixel"):
        evaluate_settings(location, EffectParameters(), lambda *_: math.nan)


def test_a_trainings_weights_are_in_the_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = dict(EFFECTS.options) | {"effects": "trained", "seeds": "900", "pandaset": ""}

    def digests(folder: Path | str) -> set[str | None]:
        (first, *_) = EFFECTS.cells(options | {"training": str(folder)}, False)
        return set(first.parameters["training"].values())

    assert (digests(""), digests(tmp_path)) == (set(), {None})
    with pytest.raises(NotMeasuredError, match="not trained yet"):
        compare_trained(ChunkLocation("synthetic:street?seed=900", 0, "store"), str(tmp_path))
    weights = tmp_path / "weights.safetensors"
    monkeypatch.setattr(TrainJob, "stage_weights", lambda job, name: weights)
    found = []
    for content in (b"first", b"second"):
        weights.write_bytes(content)
        (digest,) = digests(tmp_path)
        found.append(digest)
    assert None not in found and found[0] != found[1]
