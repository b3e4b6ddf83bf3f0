"""Tunes rates on validation seeds: Adam's for each length, for ``configs/baselines.yaml``, or a network's.

python -m benchmarks.optimiser.rate_sweep --folder F [--seeds 900,901,902] [--lengths 24x6,48x3,240x1] [--start 240x1]
python -m benchmarks.optimiser.rate_sweep --folder F --weights FILE --lengths 72x3 [--real LOG] [--beside 0.5]
python -m benchmarks.optimiser.rate_sweep --folder F --weights FILE --lengths 72x3 --enet [--real LOG] --beside 2

A pattern search by factors of two from the rates in use, or from those of a variant (``--start``): all together, the
schedule, then each by itself, each as long as it helps, again until a round brings less than ``ENOUGH_DB``. A network's
rates (and c₀ of its residuals) are tuned as they are in its configuration: meta-training looks a few iterations ahead
and is blind to what pays later. Scores and scenes are kept in the folder: a sweep that was stopped goes on from there.
Prints the variants as YAML with their mean score: the held-out PSNR, plus ``--beside`` times that at 3 m on streets.

With ``--enet`` scenes are GNet's with FNet's images of the preset ``small``, split as the preset says; as many fixed
views as source views are rendered, and the score has the kernel distance at 3 m in it, in dB.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import yaml

from benchmarks.common.novel_view_truth import true_targets, views_at
from benchmarks.common.pipeline_inputs import steps_of
from benchmarks.common.task import HELDOUT_VIEWS, SIDE_M, Task
from benchmarks.optimiser.distillation import KERNEL_VIEWS, Judge
from flows.configuration import load_configuration
from flows.paper_tables.baselines import load_baselines
from flows.training.optimiser_training import psnr
from flows.training.training_scenes import SceneRecipe, prepare, spread, training_scene
from genre_tasks.config import LossConfig
from genre_tasks.errors import ConfigError
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.learned.weights import load, write_atomically
from genre_tasks.metrics.scoring import real_images
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.optimiser.tuned_adam import GNET_RATES, TunedAdam
from genre_tasks.optimiser.unroll import Plan, unroll
from genre_tasks.scene.graph import SceneGraph
from storage.files import digest_file
from storage.local import LocalStore

LENGTHS = "24x6,48x3,72x2,144x1,240x1,24x30,960x1,2880x1"
ENOUGH_DB = 0.02
LOSS = LossConfig(perceptual=0.0)
"""What GNet sees in the presets demo and small."""
SEEDS_FILE = Path(__file__).resolve().parents[2] / "configs" / "seeds.yaml"


@dataclass(frozen=True)
class Setting:
    """One point of the search."""

    rates: tuple[float, ...] = GNET_RATES
    schedule: Literal["cosine", "constant"] = "cosine"
    relaxation: float = 0.0

    def scaled(self, factor: float, which: int | None = None) -> Setting:
        """With one rate, or all, times ``factor``."""
        rates = (r * factor if which in (None, k) else r for k, r in enumerate(self.rates))
        return replace(self, rates=tuple(float(f"{r:.4g}") for r in rates))

    def relaxed(self, more: float) -> Setting:
        """With another c₀."""
        return replace(self, relaxation=round(self.relaxation + more, 4))

    def turned(self) -> Setting:
        """With the other schedule."""
        return replace(self, schedule="constant" if self.schedule == "cosine" else "cosine")


def moves(factor: float = 2.0) -> Iterator[Callable[[Setting], Setting]]:
    """All rates divided and multiplied, the other schedule, then each rate multiplied and divided."""
    yield lambda s: s.scaled(1 / factor)
    yield lambda s: s.scaled(factor)
    yield Setting.turned
    yield from each_rate(factor)


def each_rate(factor: float) -> Iterator[Callable[[Setting], Setting]]:
    """Each multiplied and divided."""
    for which in range(len(GNET_RATES)):
        for by in (factor, 1 / factor):
            yield partial(Setting.scaled, factor=by, which=which)


def network_moves(factor: float) -> Iterator[Callable[[Setting], Setting]]:
    """A network has its own schedule, and where it is told residuals a relaxation beside the rates."""
    yield from each_rate(factor)
    for more in (math.log(factor), -math.log(factor)):
        yield partial(Setting.relaxed, more=more)


def adam_of(setting: Setting) -> StepRule:
    """Tuned Adam."""
    return TunedAdam(setting.rates, setting.schedule)


def network_of(weights: Path) -> tuple[Setting, Callable[[Setting], StepRule]]:
    """The setting that a network has, and the network with another one."""
    network = load(weights)
    config = network.config

    def tuned(setting: Setting) -> StepRule:
        update = {"rates": setting.rates, "relaxation": setting.relaxation}
        out = LearnedOptimiser(config.model_copy(update=update))
        out.load_state_dict(network.state_dict())
        return out.eval().requires_grad_(False)

    return Setting(config.rates, relaxation=config.relaxation), tuned


@dataclass(frozen=True)
class Subject:
    """A scene to optimise, ``split`` as ENet's; ``closeness`` in dB of its result: what counts beside PSNR, if any."""

    scene: TrainingScene
    split: float = 0.0
    closeness: Callable[[SceneGraph], float] | None = None


class Scores:
    """Scores in dB of settings, each measured once and then read from the file.

    ``rule_of`` makes the rule of a setting; ``beside``: how much the PSNR at the novel views counts, where there is
    one. A scene's name is the seed of its views' order, or 0. Where a scene has fixed views, as many of them as of the
    source views are rendered.
    """

    def __init__(
        self,
        file: Path,
        scenes: Mapping[int | str, Callable[[], Subject]],
        rule_of: Callable[[Setting], StepRule] = adam_of,
        beside: float = 0.0,
    ) -> None:
        self.file, self._scenes, self._rule_of, self._beside = file, scenes, rule_of, beside
        self._made: dict[int | str, Subject] = {}
        self._known: dict[str, float] = json.loads(file.read_text()) if file.is_file() else {}

    def mean(self, setting: Setting, iterations: int, views: int) -> float:
        """Over the scenes."""
        return statistics.fmean(self._one(name, setting, iterations, views) for name in self._scenes)

    def _one(self, name: int | str, setting: Setting, iterations: int, views: int) -> float:
        key = json.dumps({"scene": name, "iterations": iterations, "views": views, **asdict(setting)})
        if key not in self._known:
            if name not in self._made:
                self._made[name] = self._scenes[name]()
            self._known[key] = self._measured(name, setting, iterations, views)
            write_atomically(self.file, json.dumps(self._known, indent=0).encode())
        return self._known[key]

    def _measured(self, name: int | str, setting: Setting, iterations: int, views: int) -> float:
        subject = self._made[name]
        scene = subject.scene
        seed, novel = name if isinstance(name, int) else 0, views if scene.fixed else 0
        plan = Plan(iterations, views, novel, seed=seed, split=subject.split)
        end = unroll(self._rule_of(setting), scene.scene, scene.source, scene.fixed, Objective(LOSS), plan).scene
        beside = self._beside * psnr(end, scene.truth) if self._beside and scene.truth else 0.0
        return psnr(end, scene.heldout) + beside + (subject.closeness(end) if subject.closeness else 0.0)


def search(
    measure: Callable[[Setting], float],
    start: Setting,
    rounds: int,
    ways: Callable[[], Iterable[Callable[[Setting], Setting]]] = moves,
) -> tuple[Setting, float]:
    """The best setting found from ``start`` by ``ways``, and its score."""
    best, found = start, measure(start)
    for _ in range(rounds):
        before = found
        for move in ways():
            while (value := measure(move(best))) > found:
                best, found = move(best), value
                say(f"{found:7.3f} dB  {best}")
        if found - before < ENOUGH_DB:
            break
    return best, found


def setting_of(variant: str) -> Setting:
    """What ``configs/baselines.yaml`` has for tuned Adam. Raises ``ConfigError`` for an unknown variant."""
    adam = load_baselines("small")["tuned_adam"].at(variant).adam
    rates = GNET_RATES if adam.learning_rates is None else adam.learning_rates.as_tuple()
    return Setting(rates, adam.schedule)


def validation_seeds(text: str) -> list[int]:
    """Raises ``ConfigError`` for a seed that is not of validation: claims are never tuned on."""
    low, high = yaml.safe_load(SEEDS_FILE.read_text())["validation"]
    seeds = [int(part) for part in text.split(",")]
    if bad := [s for s in seeds if not low <= s <= high]:
        raise ConfigError(f"seeds {bad} are not of validation", remedy=f"Give seeds of {low}–{high}.", file=SEEDS_FILE)
    return seeds


def scenes_of(
    seeds: Sequence[int], real: str | None, make: Callable[[str], Subject]
) -> dict[int | str, Callable[[], Subject]]:
    """Makers of the seeds' scenes and of a real chunk 0, by their URI."""
    uris: dict[int | str, str] = {seed: f"synthetic:street?seed={seed}" for seed in seeds}
    uris |= {} if real is None else {"real": real}
    return {name: partial(make, uri) for name, uri in uris.items()}


def initial(store: LocalStore, points: int, uri: str) -> Subject:
    """GNet's task: an initial scene at 320×180, with all source views and twelve held-out ones."""
    recipe = SceneRecipe(uri, max_points=points, distant_count=points // 10)
    return Subject(training_scene(prepare(store, recipe)))


def enhanced(store: str, split: float | None, uri: str) -> Subject:
    """ENet's task: GNet's scene and FNet's images in the preset ``small``."""
    split = load_configuration("small").enet.split_fraction if split is None else split
    steps = steps_of(uri, 0, store, 0, enet=False)
    heldout, truth = spread(steps.heldout, HELDOUT_VIEWS), true_targets(uri, store, steps.chunk, SIDE_M)
    scene = TrainingScene(uri, steps.gnet, steps.source, heldout, steps.fixed, truth)
    task = Task(steps.gnet, steps.source, heldout, truth)
    judge = Judge(views_at(steps.chunk, SIDE_M, KERNEL_VIEWS), real_images(steps.chunk), task)
    return Subject(scene, split, partial(kernel_db, judge))


def kernel_db(judge: Judge, scene: SceneGraph) -> float:
    """The kernel distance at 3 m to the real images, in dB: a tenth less is half a decibel."""
    return -10 * math.log10(max(judge.mark(scene, 0.0, 0).kernel, 1e-3))


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
    parser.add_argument("--factor", type=float, default=2.0, help="of a move")
    parser.add_argument("--weights", type=Path, help="a network's, to tune its rates instead of Adam's")
    parser.add_argument("--real", help="a log whose chunk 0 counts as one more scene")
    parser.add_argument("--enet", action="store_true", help="tune for ENet's task")
    parser.add_argument("--split", type=float, help="as enet.split; without it the preset's")
    parser.add_argument("--rates", help="five with commas, which the search for Adam's starts from, schedule constant")
    parser.add_argument("--beside", type=float, default=0.0, help="how much the PSNR at 3 m counts")
    options = parser.parse_args()
    if options.weights is not None and (options.start is not None or options.rates is not None):
        parser.error("--start and --rates are Adam's; a network's search starts from its own rates")
    options.folder.mkdir(parents=True, exist_ok=True)
    seeds, store = validation_seeds(options.seeds), options.folder / "store"
    make: Callable[[str], Subject] = partial(initial, LocalStore(store), options.points)
    if options.enet:
        make = partial(enhanced, str(store), options.split)
    makers = scenes_of(seeds, options.real, make)
    best = Setting() if options.start is None else setting_of(options.start)
    if options.rates is not None:
        best = Setting(tuple(float(rate) for rate in options.rates.split(",")), "constant")
    rule_of: Callable[[Setting], StepRule] = adam_of
    ways = partial(moves, options.factor)
    if options.weights is not None:
        best, rule_of = network_of(options.weights)
        ways = partial(network_moves, options.factor)
    digest = "" if options.weights is None else f"-{digest_file(options.weights)[:8]}"
    task = f"-enet{'' if options.split is None else f'-{options.split}'}" if options.enet else ""
    file = options.folder / f"scores{task}{digest}{f'-{options.beside}' if options.beside else ''}.json"
    scores = Scores(file, makers, rule_of, options.beside)
    for length in options.lengths.split(","):
        iterations, views = (int(part) for part in length.split("x"))

        def measure(setting: Setting, iterations: int = iterations, views: int = views) -> float:
            return scores.mean(setting, iterations, views)

        best, found = search(measure, best, options.rounds, ways)  # one length's best is the next one's start
        if options.weights is not None:
            sys.stdout.write(f"{length}: rates {list(best.rates)}, relaxation {best.relaxation}  # {found:.2f} dB\n")
            continue
        adam = f"adam: {{rates: {list(best.rates)}, schedule: {best.schedule}}}"
        variant = f"iterations: {iterations}, views_per_iteration: {views}, {adam}"
        sys.stdout.write(f'    "{length}": {{{variant}}}  # {found:.2f} dB\n')


if __name__ == "__main__":
    main()
