"""The search for Adam's rates: it finds a known optimum, remembers scores, and keeps away from claims."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from benchmarks.optimiser.rate_search import Setting, network_moves, search
from benchmarks.optimiser.rate_sweep import Scores, load_network, main, validation_seeds
from benchmarks.optimiser.tuning_scenes import TuningScene
from genre_tasks.errors import ConfigError
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.learned.weights import save_optimiser
from genre_tasks.optimiser.tuned_adam import GNET_LEARNING_RATES
from genre_tasks.scene.graph import SceneGraph
from tests.optimiser import street_scenes


def test_it_finds_rates_that_are_all_far_off_and_a_schedule() -> None:
    best = Setting(
        tuple(r * f for r, f in zip(GNET_LEARNING_RATES.as_tuple(), (0.125, 0.125, 0.25, 0.03125, 2.0), strict=True)),
        "constant",
    )

    def measure(setting: Setting) -> float:
        distance = sum(abs(math.log2(a / b)) for a, b in zip(setting.rates, best.rates, strict=True))
        return -distance - (setting.schedule != best.schedule)

    found, score = search(measure, Setting(), rounds=4)
    assert found.schedule == "constant" and found.rates == pytest.approx(best.rates, rel=1e-3)
    assert score == pytest.approx(0, abs=1e-2)


def test_scores_are_kept_and_not_measured_again(tmp_path: Path) -> None:
    def scene() -> TuningScene:
        truth = street_scenes.scene()
        views, novel = street_scenes.targets(truth), street_scenes.targets(truth, novel=True)
        return TuningScene(TrainingScene("tiny", street_scenes.blurred(truth), views, novel))

    def never() -> TuningScene:
        raise AssertionError("measured again")

    first = Scores(tmp_path / "scores.json", {900: scene}).mean(Setting(), 2, 2)
    again = Scores(tmp_path / "scores.json", {900: never})
    assert again.mean(Setting(), 2, 2) == first > 5.0
    for setting, iterations in ((Setting(), 3), (Setting(schedule="constant"), 2)):
        with pytest.raises(AssertionError, match="measured again"):
            again.mean(setting, iterations, 2)


def test_scores_of_another_log_or_of_other_points_are_measured_anew(tmp_path: Path) -> None:
    truth = street_scenes.scene()
    made: list[str] = []

    def score(origin: str) -> None:
        def scene() -> TuningScene:
            made.append(origin)
            return TuningScene(TrainingScene("tiny", street_scenes.blurred(truth), views, views))

        Scores(tmp_path / "scores.json", {"real": scene}, origins={"real": origin}).mean(Setting(), 1, 2)

    views = street_scenes.targets(truth)
    origins = ["pandaset:a, 40000 points", "pandaset:b, 40000 points", "pandaset:b, 100 points"]
    for origin in [*origins, *origins]:
        score(origin)
    assert made == origins


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--enet", "--points", "100"), "--points is of GNet's scenes"),
        (("--split", "0.1"), "--split is ENet's"),
        (("--start", "240x1", "--rates", "1,1,1,1,1"), "give one of them"),
        (("--weights", "w.safetensors", "--rates", "1,1,1,1,1"), "are Adam's"),
    ],
)
def test_options_without_effect_are_refused(
    arguments: tuple[str, ...], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["--folder", str(tmp_path / "sweep"), *arguments])
    assert reason in capsys.readouterr().err
    assert not (tmp_path / "sweep").exists()


def test_a_networks_rates_are_searched_with_its_relaxation(tmp_path: Path) -> None:
    config = NetworkConfig(hidden=8, channels=(4,), residuals=True, rates=(0.1,) * 5, relaxation=0.2)
    save_optimiser(LearnedOptimiser(config), tmp_path / "w.safetensors")
    start, rule_of = load_network(tmp_path / "w.safetensors")
    assert start == Setting((0.1,) * 5, relaxation=0.2)

    def measure(setting: Setting) -> float:
        return -abs(math.log(setting.rates[2] / 0.4)) - abs(setting.relaxation + 0.9)

    found, _ = search(measure, start, 3, partial(network_moves, 1.6))
    assert found.rates[2] == pytest.approx(0.4, rel=0.3) and found.relaxation == pytest.approx(-0.9, abs=0.24)
    assert found.rates[:2] == start.rates[:2] and found.schedule == "cosine"
    tuned = rule_of(found)
    assert isinstance(tuned, LearnedOptimiser)
    assert (tuned.config.rates, tuned.config.relaxation) == (found.rates, found.relaxation)


def test_what_is_beside_the_path_counts_where_it_is_asked_for(tmp_path: Path) -> None:
    truth = street_scenes.scene()
    views, novel = street_scenes.targets(truth), street_scenes.targets(truth, novel=True)
    scenes = {900: lambda: TuningScene(TrainingScene("s", street_scenes.blurred(truth), views, views, truth=novel))}
    at, there = (
        Scores(tmp_path / f"{weight}.json", scenes, novel_weight=weight).mean(Setting(), 2, 2) for weight in (0.0, 0.5)
    )
    assert there > at + 2.5


def test_an_enhancer_is_scored_by_what_it_is_given_and_by_how_close_it_comes(tmp_path: Path) -> None:
    truth = street_scenes.scene()
    views, novel = street_scenes.targets(truth), street_scenes.targets(truth, novel=True)
    scene = TrainingScene("s", street_scenes.blurred(truth), views, views, fixed=novel)
    seen: list[int] = []

    def closeness(result: SceneGraph) -> float:
        seen.append(len(result))
        return 7.0

    plain = Scores(tmp_path / "a.json", {900: lambda: TuningScene(scene)}).mean(Setting(), 2, 2)
    alone = Scores(tmp_path / "b.json", {900: lambda: TuningScene(replace(scene, fixed=()))}).mean(Setting(), 2, 2)
    whole = Scores(tmp_path / "c.json", {900: lambda: TuningScene(scene, closeness=closeness)}).mean(Setting(), 2, 2)
    split = Scores(tmp_path / "d.json", {900: lambda: TuningScene(scene, 0.1, closeness)}).mean(Setting(), 2, 2)
    assert plain != alone and whole == plain + 7.0 and split != whole
    assert seen == [300, 330]


def test_only_validation_seeds_are_tuned_on() -> None:
    assert validation_seeds("900,999") == [900, 999]
    for seeds in ("900,1001", "899"):
        with pytest.raises(ConfigError, match="not of validation"):
            validation_seeds(seeds)
