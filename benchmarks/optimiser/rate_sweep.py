"""Tunes rates on validation seeds: Adam's for each length, for ``configs/baselines.yaml``, or a network's.

python -m benchmarks.optimiser.rate_sweep --folder F [--seeds 900,901,902] [--lengths 24x6,48x3,240x1] [--start 240x1]
python -m benchmarks.optimiser.rate_sweep --folder F --weights FILE --lengths 72x3 [--real LOG] [--beside 0.5]
python -m benchmarks.optimiser.rate_sweep --folder F --weights FILE --lengths 72x3 --enet [--real LOG] --beside 2

A pattern search by factors of two from the rates in use, or from those of a variant (``--start``): all together, the
schedule, then each by itself, each as long as it helps (:mod:`benchmarks.optimiser.rate_search`). A network's
rates (and c₀ of its residuals) are tuned as they are in its configuration: meta-training looks a few iterations ahead
and is blind to what pays later. Scores and scenes are kept in the folder: a sweep that was stopped goes on from there.
Prints the variants as YAML with their mean score: the held-out PSNR, plus ``--beside`` times that at 3 m on streets.

With ``--enet`` scenes are GNet's with FNet's images of the preset ``small``, split as the preset says; as many fixed
views as source views are rendered, and the score has the kernel distance at 3 m in it, in dB.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import yaml

from benchmarks.optimiser.rate_search import Setting, moves, network_moves, search
from benchmarks.optimiser.tuning_scenes import TuningScene, load_enet_scene, load_gnet_scene, scene_uris
from flows.paper_tables.baselines import load_baselines
from flows.training.optimiser_training import mean_psnr
from genre_tasks.atomic_path import write_atomically
from genre_tasks.config import LearningRates, LossConfig
from genre_tasks.errors import ConfigError
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.weights import load_optimiser
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.optimiser.tuned_adam import GNET_LEARNING_RATES, TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from storage.files import digest_file
from storage.local import LocalStore

LENGTHS = "24x6,48x3,72x2,144x1,240x1,24x30,960x1,2880x1"
POINTS = 40_000
LOSS = LossConfig(perceptual=0.0)
"""What GNet sees in the presets demo and small."""
SEEDS_FILE = Path(__file__).resolve().parents[2] / "configs" / "seeds.yaml"


def make_adam(setting: Setting) -> StepRule:
    """Makes tuned Adam with a setting's learning rates and schedule."""
    return TunedAdam(LearningRates.from_sequence(setting.rates), setting.schedule)


def load_network(weights: Path) -> tuple[Setting, Callable[[Setting], StepRule]]:
    """Loads a network for tuning.

    Args:
        weights: file of the network.

    Returns:
        The setting that the network has, and a function that makes the network with another one.
    """
    # The file is read once; every setting gets a copy of the weights under another configuration.
    network = load_optimiser(weights)
    config = network.config

    def tuned(setting: Setting) -> StepRule:
        update = {"rates": setting.rates, "relaxation": setting.relaxation}
        out = LearnedOptimiser(config.model_copy(update=update))
        out.load_state_dict(network.state_dict())
        return out.eval().requires_grad_(False)

    return Setting(config.rates, relaxation=config.relaxation), tuned


class Scores:
    """Scores in dB of settings, each measured once and then read from the file.

    A scene's name is the seed of its views' order, or 0. Where a scene has fixed views, as many of them as of the
    source views are rendered.
    """

    def __init__(
        self,
        file: Path,
        scenes: Mapping[int | str, Callable[[], TuningScene]],
        rule_of: Callable[[Setting], StepRule] = make_adam,
        novel_weight: float = 0.0,
        origins: Mapping[int | str, str] | None = None,
    ) -> None:
        """Reads the scores that an earlier sweep measured.

        Args:
            file: JSON of the scores; written after every measurement.
            scenes: makers of the scenes, by name; a scene is made when its first score is missing.
            rule_of: makes the step rule of a setting.
            novel_weight: factor of the PSNR at novel views, where a scene has their truth.
            origins: what scenes are made of, by name, where the name alone does not say it.
        """
        self.file = file
        self._scenes = scenes
        self._rule_of = rule_of
        self._novel_weight = novel_weight
        self._origins = origins or {}
        self._made: dict[int | str, TuningScene] = {}
        self._known: dict[str, float] = json.loads(file.read_text()) if file.is_file() else {}

    def mean(self, setting: Setting, iterations: int, views: int) -> float:
        """Averages a setting's score over the scenes.

        Args:
            setting: to score.
            iterations: length of a run.
            views: source views of an iteration.

        Returns:
            dB.
        """
        return statistics.fmean(self._one(name, setting, iterations, views) for name in self._scenes)

    def _one(self, name: int | str, setting: Setting, iterations: int, views: int) -> float:
        # Another log under the same name, or fewer points of it, would have other scores.
        scene = self._origins.get(name, name)
        key = json.dumps({"scene": scene, "iterations": iterations, "views": views, **asdict(setting)})
        if key not in self._known:
            # Scenes are made only when a score is missing: a finished sweep is read in a second.
            if name not in self._made:
                self._made[name] = self._scenes[name]()
            self._known[key] = self._measure(name, setting, iterations, views)
            # A sweep takes hours: every score is on disk before the next one is measured.
            write_atomically(self.file, json.dumps(self._known, indent=0).encode())
        return self._known[key]

    def _measure(self, name: int | str, setting: Setting, iterations: int, views: int) -> float:
        subject = self._made[name]
        scene = subject.scene
        # Another order of views for each street, so that rates are not tuned to one order.
        seed = name if isinstance(name, int) else 0
        # GNet's scenes have no fixed views.
        novel = views if scene.fixed else 0
        settings = UnrollSettings(iterations, views, novel, seed=seed, split_fraction=subject.split)
        end = unroll(self._rule_of(setting), scene.scene, scene.source, scene.fixed, Objective(LOSS), settings).scene
        novel_db = self._novel_weight * mean_psnr(end, scene.truth) if self._novel_weight and scene.truth else 0.0
        closeness_db = subject.closeness(end) if subject.closeness else 0.0
        return mean_psnr(end, scene.heldout) + novel_db + closeness_db


def load_setting(variant: str) -> Setting:
    """Reads a variant of tuned Adam from ``configs/baselines.yaml``.

    Args:
        variant: its name there.

    Returns:
        Setting: its learning rates and schedule.

    Raises:
        ConfigError: the variant is unknown.
    """
    adam = load_baselines("small")["tuned_adam"].variant(variant).adam
    rates = GNET_LEARNING_RATES.as_tuple() if adam.learning_rates is None else adam.learning_rates.as_tuple()
    return Setting(rates, adam.schedule)


def validation_seeds(text: str) -> list[int]:
    """Reads seeds of validation streets; nothing is tuned on the streets of claims.

    Args:
        text: seeds with commas.

    Returns:
        The seeds.

    Raises:
        ConfigError: a seed is not of validation.
    """
    low, high = yaml.safe_load(SEEDS_FILE.read_text())["validation"]
    seeds = [int(part) for part in text.split(",")]
    # Tuning on the streets of claims would make the claims worthless.
    if bad := [s for s in seeds if not low <= s <= high]:
        raise ConfigError(f"seeds {bad} are not of validation", remedy=f"Give seeds of {low}–{high}.", file=SEEDS_FILE)
    return seeds


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--seeds", default="900,901,902")
    parser.add_argument("--lengths", default=LENGTHS, help="iterations x views of each, with commas")
    parser.add_argument("--start", help="a variant of tuned_adam in configs/baselines.yaml to search from")
    parser.add_argument("--points", type=int, help=f"LiDAR points of GNet's scenes at most; {POINTS:,} without it")
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--factor", type=float, default=2.0, help="of a move")
    parser.add_argument("--weights", type=Path, help="a network's, to tune its rates instead of Adam's")
    parser.add_argument("--real", help="a log whose chunk 0 counts as one more scene")
    parser.add_argument("--enet", action="store_true", help="tune for ENet's task")
    parser.add_argument("--split", type=float, help="as enet.split; without it the preset's")
    parser.add_argument("--rates", help="five with commas, which the search for Adam's starts from, schedule constant")
    parser.add_argument("--beside", type=float, default=0.0, help="how much the PSNR at 3 m counts")
    return parser


def _refuse_options_without_effect(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    # A sweep takes hours, after which it would turn out that an option was not looked at.
    if options.weights is not None and (options.start is not None or options.rates is not None):
        parser.error("--start and --rates are Adam's; a network's search starts from its own rates")
    if options.start is not None and options.rates is not None:
        parser.error("--start and --rates both say where the search begins; give one of them")
    if options.enet and options.points is not None:
        parser.error("--points is of GNet's scenes; with --enet the preset says how many points there are")
    if options.split is not None and not options.enet:
        parser.error("--split is ENet's; give it with --enet")


def main(arguments: Sequence[str] | None = None) -> None:
    """Tunes every length in turn and prints its variant.

    Args:
        arguments: of the command; those of the process if ``None``.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    _refuse_options_without_effect(parser, options)
    options.folder.mkdir(parents=True, exist_ok=True)
    store = options.folder / "store"
    uris = scene_uris(validation_seeds(options.seeds), options.real)
    points = POINTS if options.points is None else options.points
    make: Callable[[str], TuningScene] = partial(load_gnet_scene, LocalStore(store), points)
    origins = {name: f"{uri}, {points} points" for name, uri in uris.items()}
    if options.enet:
        make = partial(load_enet_scene, str(store), options.split)
        origins = uris
    # Functions and not scenes: making one takes minutes, and all scores may be known already.
    makers = {name: partial(make, uri) for name, uri in uris.items()}
    best = Setting() if options.start is None else load_setting(options.start)
    if options.rates is not None:
        best = Setting(tuple(float(rate) for rate in options.rates.split(",")), "constant")
    rule_of: Callable[[Setting], StepRule] = make_adam
    ways = partial(moves, options.factor)
    if options.weights is not None:
        best, rule_of = load_network(options.weights)
        ways = partial(network_moves, options.factor)
    # Scores of other weights, tasks or mixtures are not comparable: each has a file of its own.
    digest = "" if options.weights is None else f"-{digest_file(options.weights)[:8]}"
    task = f"-enet{'' if options.split is None else f'-{options.split}'}" if options.enet else ""
    file = options.folder / f"scores{task}{digest}{f'-{options.beside}' if options.beside else ''}.json"
    scores = Scores(file, makers, rule_of, options.beside, origins)
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
