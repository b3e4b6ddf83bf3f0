"""Tunes Adam for each length on validation seeds: rates and schedule, for ``tuned_adam`` in ``configs/baselines.yaml``.

python -m benchmarks.sweep_adam --folder sweep [--seeds 900,901,902] [--lengths 24x6,48x3,240x1] [--start 240x1]

A pattern search by factors of two from the rates in use, or from those of a variant (``--start``): all together, the
schedule, then each by itself, each as long as it helps, again until a round brings less than ``ENOUGH_DB``. Scores and
scenes are kept in the folder: a sweep that was stopped goes on where it was. Prints the variants as YAML with their
mean held-out PSNR.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import yaml

from flows.baselines import load_baselines
from flows.train.optimiser import score
from flows.train.scenes import SceneRecipe, prepare, training_scene
from genre_tasks.config import LossConfig
from genre_tasks.errors import ConfigError
from genre_tasks.optimiser.adam import GNET_RATES, TunedAdam
from genre_tasks.optimiser.episodes import TrainingScene
from genre_tasks.optimiser.unroll import Plan
from genre_tasks.optimiser.weights import write_atomically
from storage.local import LocalStore

LENGTHS = "24x6,48x3,72x2,144x1,240x1,24x30,960x1,2880x1"
ENOUGH_DB = 0.02
LOSS = LossConfig(perceptual=0.0)
"""What GNet sees in the presets demo and small."""
SEEDS_FILE = Path(__file__).resolve().parent.parent / "configs" / "seeds.yaml"


@dataclass(frozen=True)
class Setting:
    """One point of the search."""

    rates: tuple[float, ...] = GNET_RATES
    schedule: Literal["cosine", "constant"] = "cosine"

    def scaled(self, factor: float, which: int | None = None) -> Setting:
        """With one rate, or all, times ``factor``."""
        rates = (r * factor if which in (None, k) else r for k, r in enumerate(self.rates))
        return replace(self, rates=tuple(float(f"{r:.4g}") for r in rates))

    def turned(self) -> Setting:
        """With the other schedule."""
        return replace(self, schedule="constant" if self.schedule == "cosine" else "cosine")


def moves() -> Iterator[Callable[[Setting], Setting]]:
    """All rates halved and doubled, the other schedule, then each rate doubled and halved."""
    yield lambda s: s.scaled(0.5)
    yield lambda s: s.scaled(2.0)
    yield Setting.turned
    for which in range(len(GNET_RATES)):
        for factor in (2.0, 0.5):
            yield partial(Setting.scaled, factor=factor, which=which)


class Scores:
    """Held-out PSNR in dB of settings, each measured once and then read from the file."""

    def __init__(self, file: Path, scenes: dict[int, Callable[[], TrainingScene]]) -> None:
        self.file, self._scenes = file, scenes
        self._made: dict[int, TrainingScene] = {}
        self._known: dict[str, float] = json.loads(file.read_text()) if file.is_file() else {}

    def mean(self, setting: Setting, iterations: int, views: int) -> float:
        """Over the seeds."""
        return statistics.fmean(self._one(seed, setting, iterations, views) for seed in self._scenes)

    def _one(self, seed: int, setting: Setting, iterations: int, views: int) -> float:
        key = json.dumps({"seed": seed, "iterations": iterations, "views": views, **asdict(setting)})
        if key not in self._known:
            if seed not in self._made:
                self._made[seed] = self._scenes[seed]()
            rule, plan = TunedAdam(setting.rates, setting.schedule), Plan(iterations, views, seed=seed)
            self._known[key] = score(rule, self._made[seed], LOSS, plan, None).heldout
            write_atomically(self.file, json.dumps(self._known, indent=0).encode())
        return self._known[key]


def search(measure: Callable[[Setting], float], start: Setting, rounds: int) -> tuple[Setting, float]:
    """The best setting found from ``start``, and its score."""
    best, found = start, measure(start)
    for _ in range(rounds):
        before = found
        for move in moves():
            while (value := measure(move(best))) > found:
                best, found = move(best), value
                say(f"{found:7.3f} dB  {best}")
        if found - before < ENOUGH_DB:
            break
    return best, found


def setting_of(variant: str) -> Setting:
    """What ``configs/baselines.yaml`` has for tuned Adam. Raises ``ConfigError`` for an unknown variant."""
    adam = load_baselines("small")["tuned_adam"].at(variant).adam
    return Setting(adam.rates or GNET_RATES, adam.schedule)


def validation_seeds(text: str) -> list[int]:
    """Raises ``ConfigError`` for a seed that is not of validation: claims are never tuned on."""
    low, high = yaml.safe_load(SEEDS_FILE.read_text())["validation"]
    seeds = [int(part) for part in text.split(",")]
    if bad := [s for s in seeds if not low <= s <= high]:
        raise ConfigError(f"seeds {bad} are not of validation", remedy=f"Give seeds of {low}–{high}.", file=SEEDS_FILE)
    return seeds


def scenes_of(store: LocalStore, seeds: Sequence[int], points: int) -> dict[int, Callable[[], TrainingScene]]:
    """Makers of the seeds' scenes at 320×180, with all source views and twelve held-out ones."""

    def maker(seed: int) -> Callable[[], TrainingScene]:
        recipe = SceneRecipe(f"synthetic:street?seed={seed}", max_points=points, distant_count=points // 10)
        return lambda: training_scene(prepare(store, recipe))

    return {seed: maker(seed) for seed in seeds}


def say(text: str) -> None:
    sys.stderr.write(text + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--seeds", default="900,901,902")
    parser.add_argument("--lengths", default=LENGTHS, help="iterations x views of each, with commas")
    parser.add_argument("--start", help="a variant of tuned_adam in configs/baselines.yaml to search from")
    parser.add_argument("--points", type=int, default=40_000)
    parser.add_argument("--rounds", type=int, default=4)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    makers = scenes_of(LocalStore(options.folder / "store"), validation_seeds(options.seeds), options.points)
    scores = Scores(options.folder / "scores.json", makers)
    best = Setting() if options.start is None else setting_of(options.start)
    for length in options.lengths.split(","):
        iterations, views = (int(part) for part in length.split("x"))

        def measure(setting: Setting, iterations: int = iterations, views: int = views) -> float:
            return scores.mean(setting, iterations, views)

        best, found = search(measure, best, options.rounds)  # one length's best is the next one's start
        adam = f"adam: {{rates: {list(best.rates)}, schedule: {best.schedule}}}"
        variant = f"iterations: {iterations}, views_per_iteration: {views}, {adam}"
        sys.stdout.write(f'    "{length}": {{{variant}}}  # {found:.2f} dB\n')


if __name__ == "__main__":
    main()
