"""The race on real logs: on a tiny street with exposures that swing, and its claims from rows."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import pytest
import torch

from benchmarks.common.bench import TINY_SETTINGS
from benchmarks.common.task import load_planned_task
from benchmarks.real_logs import optimiser_race
from benchmarks.real_logs.measures import LogOfBench
from flows.training.optimiser_training import mean_psnr
from tests.benchmarks.small_races import ADAM
from tests.optimiser import street_scenes

STREET = (
    "synthetic:street?seed=900&width=64&height=36&samples=1&frames=8&cameras=2&lidar_beams=32&lidar_azimuths=300"
    "&exposure_jitter=0.3"
)


def test_both_sides_of_the_race_show_the_planned_exposures(
    tmp_path: os.PathLike[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optimiser_race, "variants", lambda method: {"6x2": ADAM})
    settings = (*TINY_SETTINGS.split(), "effects.exposure=on")
    log = LogOfBench(STREET, 0, "small", settings, str(tmp_path))
    task = load_planned_task(log.job(()))
    assert task.plan.is_on("exposure")
    assert all(target.log_gain is not None for target in (*task.source, *task.heldout))
    row = optimiser_race.measure_race(log, 1, "tuned_adam")
    assert (row["order"], row["method"], row["gaussians"]) == (1, "tuned_adam", len(task.scene))
    assert row["threads"] == 2
    assert row["gnet"]["renders"] > 0 and list(row["variants"]) == ["6x2"]
    assert row["gnet"]["psnr"] > task.psnr(task.scene)


def test_psnr_is_at_the_images_exposure_and_outside_of_the_vehicle() -> None:
    scene = street_scenes.scene()
    target = street_scenes.targets(scene)[0]
    assert mean_psnr(scene, [target]) == pytest.approx(100.0)
    # The scene renders as the image, so a gain that the image does not have is an error.
    brighter = replace(target, log_gain=(0.5, 0.5, 0.5))
    assert mean_psnr(scene, [brighter]) < 40.0
    spoiled = target.image.pixels.clone()
    spoiled[:10] = 1.0
    mask = torch.zeros(spoiled.shape[:2], dtype=torch.bool)
    mask[:10] = True
    image = replace(target.image, pixels=spoiled)
    assert mean_psnr(scene, [replace(target, image=image)]) < 40.0
    assert mean_psnr(scene, [replace(target, image=image, ego_mask=mask)]) == pytest.approx(100.0)


def race_of(log: str, gnet_psnr: float, equal: float | None, reached_s: float | None) -> dict[str, Any]:
    variant = {"reached_s": reached_s, "psnr_at_equal_renders": equal, "best_psnr": 21.0, "renders": 240}
    gnet = {"seconds": 4.0, "psnr": gnet_psnr, "renders": 240}
    shared = {"kind": "race", "log": log, "order": 0, "method": "tuned_adam", "cap": 5.0}
    return {**shared, "gnet": gnet, "variants": {"72x3": variant}}


def test_a_claim_takes_the_middle_gain_and_the_worst_time() -> None:
    log = "kitti drive chunk 0"
    rows = [race_of(log, 22.0, 21.5, 12.0), race_of(log, 22.0, 20.0, None), race_of(log, 22.0, 20.8, 6.0)]
    gain, time_ratio, *other_log = optimiser_race.make_race_claims(rows)
    assert (gain.id, gain.measured, gain.target) == ("real_logs.kitti_equal_renders", pytest.approx(1.2), 1.0)
    assert (time_ratio.measured, time_ratio.n, time_ratio.holds) == (1.5, 3, False)
    lines = list(optimiser_race.format_races(rows))
    assert lines[2] == "| kitti drive chunk 0 | 0 | tuned_adam | 4.0 | 22.00 | 21.50 | 21.00 | 3.0 |"
    assert lines[3].endswith("| ≥ 5.0 |")
    # A log that did not race does not hold its claims.
    assert [(c.measured, c.holds) for c in other_log] == 2 * [(None, False)]
    assert len(list(optimiser_race.make_race_claims([]))) == 4
