"""The search for Adam's rates: it finds a known optimum, remembers scores, and keeps away from claims."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks.sweep_adam import Scores, Setting, search, validation_seeds
from genre_tasks.errors import ConfigError
from genre_tasks.optimiser.adam import GNET_RATES
from genre_tasks.optimiser.episodes import TrainingScene
from tests.optimiser import street


def test_it_finds_rates_that_are_all_far_off_and_a_schedule() -> None:
    best = Setting(
        tuple(r * f for r, f in zip(GNET_RATES, (0.125, 0.125, 0.25, 0.03125, 2.0), strict=True)), "constant"
    )

    def measure(setting: Setting) -> float:
        distance = sum(abs(math.log2(a / b)) for a, b in zip(setting.rates, best.rates, strict=True))
        return -distance - (setting.schedule != best.schedule)

    found, score = search(measure, Setting(), rounds=4)
    assert found.schedule == "constant" and found.rates == pytest.approx(best.rates, rel=1e-3)
    assert score == pytest.approx(0, abs=1e-2)


def test_scores_are_kept_and_not_measured_again(tmp_path: Path) -> None:
    def scene() -> TrainingScene:
        truth = street.scene()
        return TrainingScene("tiny", street.blurred(truth), street.targets(truth), street.targets(truth, novel=True))

    def never() -> TrainingScene:
        raise AssertionError("measured again")

    first = Scores(tmp_path / "scores.json", {900: scene}).mean(Setting(), 2, 2)
    again = Scores(tmp_path / "scores.json", {900: never})
    assert again.mean(Setting(), 2, 2) == first > 5.0
    for setting, iterations in ((Setting(), 3), (Setting(schedule="constant"), 2)):
        with pytest.raises(AssertionError, match="measured again"):
            again.mean(setting, iterations, 2)


def test_only_validation_seeds_are_tuned_on() -> None:
    assert validation_seeds("900,999") == [900, 999]
    for seeds in ("900,1001", "899"):
        with pytest.raises(ConfigError, match="not of validation"):
            validation_seeds(seeds)
