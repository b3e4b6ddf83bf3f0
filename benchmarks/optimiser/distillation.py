"""ENet beside per-scene distillation of the same fixed images, from the same scene: GNet's.

Judged at 3 m, at views that neither is given: the kernel distance to the chunk's real images and, on synthetic logs,
the PSNR against ray-cast truth.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from benchmarks.common.bench import Row
from benchmarks.common.novel_view_truth import true_targets, views_at
from benchmarks.common.pipeline_inputs import images_of, steps_of
from benchmarks.common.task import HELDOUT_VIEWS, SIDE_M, Task
from benchmarks.optimiser import race
from flows.training.training_scenes import spread
from genre_tasks.config import AdamConfig, LearningRates, OptimiserConfig, PerSceneConfig
from genre_tasks.losses.targets import Target
from genre_tasks.metrics.distribution_distances import kernel_distance
from genre_tasks.metrics.perceptual import perceptual_distance
from genre_tasks.metrics.scoring import FeatureSet, real_images
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.tuned_adam import ENET_RATES
from genre_tasks.per_scene.run import snapshots
from genre_tasks.per_scene.training import PerSceneTraining
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.stages.optimise import distance, plan_of, step_rule

FAMILIES = ("adam", "adam_split", "standard")
"""What ENet stands beside: tuned Adam, the same on Gaussians that are split as ENet's are, the published recipe."""
KERNEL_VIEWS = 48
"""Of the views at ±3 m, spread evenly over sides, frames and cameras: an unbiased distance at any number."""
KERNEL_PART, PSNR_DB = 0.01, 0.1
"""As good as: the kernel distance at most this part above, the PSNR at most so much below."""
MOST_TIMES = 8.0
"""Tuned Adam distils for at most so many times ENet's seconds."""
SETTLED_FACTOR = 2.0
"""Tuned Adam has settled where its time grew by this factor, over ENet's and since it was better by ``KERNEL_PART``."""
ADAM_VARIANTS = ((1, 0.25, 0.1), (3, 0.5, 0.0))
"""Views of each kind in an iteration, the part of the baseline's rates, and the weight of the perceptual term. On seed
950 the first came to the lowest kernel distance and the second to the highest PSNR, at almost any time; 15 views at the
whole rates and 3 at half of them, both with the term, were behind in both.
"""
STANDARD_ITERATIONS = 7000
"""One view each; all schedules of the recipe scale with them. The shorter of the published lengths that the race has
(``configs/baselines.yaml``). After 1500 it is still getting better: on seed 1001 a fifth further in kernel distance.
"""
QUICK_STANDARD_ITERATIONS = 1500
STANDARD_LOOKS = 16
SHORTER = (1 / 3, 2 / 3)
"""ENet's lengths beside its own, of it: each a run told its length, as the distillations' variants each are a run."""


@dataclass(frozen=True)
class Judge:
    """Looks at a scene from 3 m beside the path."""

    views: tuple[NovelView, ...]
    real: FeatureSet
    task: Task  # its truth beside the path, its held-out views

    def mark(self, scene: SceneGraph, seconds: float, renders: int) -> Mark:
        """The scene's quality after so many seconds."""
        features = perceptual_distance().pooled_features(images_of(scene, self.views))
        frames = [v.frame for v in self.views]
        found = kernel_distance(features, self.real.features, frames, self.real.frames, bootstrap=0)
        assert found is not None
        return Mark(seconds, renders, found.value, self.task.psnr_beside(scene), self.task.psnr(scene))


@dataclass(frozen=True)
class Mark:
    """Quality after so many seconds and view renders; ``beside``: PSNR at 3 m, ``None`` on a real log."""

    seconds: float
    renders: int
    kernel: float
    beside: float | None
    heldout: float

    def lacks(self, other: Mark) -> tuple[float, float]:
        """How far it is from being as good as the other, in kernel distance and in dB; ≤ 0: it is."""
        kernel = self.kernel - other.kernel - KERNEL_PART * abs(other.kernel)
        if self.beside is None or other.beside is None:
            return kernel, 0.0
        return kernel, other.beside - PSNR_DB - self.beside

    def as_good_as(self, other: Mark) -> bool:
        return max(self.lacks(other)) <= 0

    def as_row(self) -> list[float | None]:
        """Seconds, renders, kernel distance, PSNR at 3 m, held-out PSNR."""
        beside = None if self.beside is None else round(self.beside, 3)
        return [round(self.seconds, 3), self.renders, round(self.kernel, 5), beside, round(self.heldout, 3)]


Marks = Sequence[Mark]


def measure_distillation(
    log: str,
    chunk: int,
    store: str,
    order: int,
    cap: float,
    standard: int = STANDARD_ITERATIONS,
    families: Sequence[str] = FAMILIES,
) -> Row:
    """One cell: ENet, then those of the ``FAMILIES`` that are asked for."""
    steps = steps_of(log, chunk, store, order, enet=False)
    heldout = spread(steps.heldout, HELDOUT_VIEWS)
    task = Task(steps.gnet, steps.source, heldout, true_targets(log, store, steps.chunk, SIDE_M))
    judge = Judge(views_at(steps.chunk, SIDE_M, KERNEL_VIEWS), real_images(steps.chunk), task)
    row = distillation_row(steps.config.enet, PerSceneConfig(iterations=standard), judge, steps.fixed, families)
    return {"log": log, "chunk": chunk, "order": order, "cap": cap} | row


def adam_variants(enet: OptimiserConfig, split: float = 0.0) -> dict[str, OptimiserConfig]:
    """ENet's objective with tuned Adam at constant rates, on the Gaussians that it is given, or split as ENet's are."""
    out = {}
    for count, part, perceptual in ADAM_VARIANTS:
        if split and perceptual:
            continue  # on split Gaussians the term brought nothing that its time would not have
        views, novel = min(count, enet.views_per_iteration), min(count, enet.novel_views_per_iteration)
        changes = {
            "split_fraction": split,
            "views_per_iteration": views,
            "novel_views_per_iteration": novel,
            "method": "adam",
            "adam": AdamConfig(learning_rates=LearningRates.of([part * r for r in ENET_RATES]), schedule="constant"),
            "loss": enet.loss.model_copy(update={"perceptual": perceptual, "perceptual_every": 1}),
        }
        name = f"{views}+{novel} at {part:g}{'' if perceptual else ', no perceptual'}{', split' if split else ''}"
        out[name] = enet.model_copy(update=changes)
    return out


def distillation_row(
    enet: OptimiserConfig,
    standard: PerSceneConfig,
    judge: Judge,
    fixed: Sequence[Target],
    families: Sequence[str] = FAMILIES,
) -> Row:
    """Each family of distillations: the best it came to, when it first was as good as that, whether ENet is.

    ENet at ``SHORTER`` lengths stands beside: the first that is as good says when it can be, if no better is asked.
    Where ENet splits Gaussians, tuned Adam is measured on split ones too, beside what the claims are about.
    """
    task = judge.task
    start = judge.mark(task.scene, 0.0, 0)
    lengths = [max(1, round(part * enet.iterations)) for part in SHORTER]
    shorter = {t: ended(enet.model_copy(update={"iterations": t}), judge, fixed) for t in lengths}
    own = ended(enet, judge, fixed)
    budget_s = MOST_TIMES * own.seconds
    shares = {"adam": 0.0} | ({"adam_split": enet.split_fraction} if enet.split_fraction else {})
    runs = {
        name: {
            variant: distilled(walked(config, task, fixed), judge, start, own.seconds, budget_s)
            for variant, config in adam_variants(enet, share).items()
        }
        for name, share in shares.items()
        if name in families
    }
    if "standard" in families:
        runs["standard"] = {str(standard.iterations): [start, *by_recipe(standard, judge, fixed, enet.seed)]}
    return {
        "start": start.as_row(),
        "enet": own.as_row(),
        "enet_shorter": {str(t): mark.as_row() for t, mark in shorter.items()},
        **{name: family(curves, own, shorter.values()) for name, curves in runs.items()},
    }


def ended(enet: OptimiserConfig, judge: Judge, fixed: Sequence[Target]) -> Mark:
    """ENet at its end."""
    last = race.at_end(walked(enet, judge.task, fixed), enet.iterations)
    return judge.mark(last.scene, last.seconds, last.renders)


def walked(config: OptimiserConfig, task: Task, fixed: Sequence[Target]) -> Iterator[race.Moment]:
    """The stage enet from the task's scene, without end; loading of networks counts, that for the loss too."""
    if distance(config) is not None:  # modules are imported here, before the clock starts; weights are loaded again
        perceptual_distance.cache_clear()
    plan = plan_of("enet", config)
    return race.walk(lambda: (step_rule("enet", config), Objective(config.loss, distance(config))), task, plan, fixed)


def distilled(moments: Iterator[race.Moment], judge: Judge, start: Mark, unit_s: float, budget_s: float) -> list[Mark]:
    """Marks from the start at growing intervals until it has settled, or the budget is spent."""
    out, best, due = [start], start, unit_s * race.FIRST_LOOK
    for moment in moments:
        over = moment.seconds >= budget_s
        if moment.seconds < due and not over:
            continue
        out.append(judge.mark(moment.scene, moment.seconds, moment.renders))
        due = moment.seconds * race.LOOK_FACTOR
        if out[-1].kernel < best.kernel - KERNEL_PART * abs(best.kernel):
            best = out[-1]
        if over or moment.seconds >= SETTLED_FACTOR * max(best.seconds, unit_s):
            break
    return out


def by_recipe(config: PerSceneConfig, judge: Judge, fixed: Sequence[Target], seed: int) -> Iterator[Mark]:
    """Marks of the published recipe on source and fixed views to its end; actors stay in their boxes."""
    training = PerSceneTraining(config, judge.task.scene, [*judge.task.source, *fixed], seed, "enet")
    looks = [max(1, round(config.iterations / race.LOOK_FACTOR**k)) for k in range(STANDARD_LOOKS)]
    for s in snapshots(training, iterations=looks):
        yield judge.mark(s.scene, s.seconds, s.iteration)


def family(runs: Mapping[str, Marks], own: Mark, shorter: Iterable[Mark] = ()) -> Row:
    """What the runs came to after their start, all together, when, whether ``own`` is as good, when they were as it.

    ``enet_first_s``: of ``own`` and the ``shorter`` runs of ENet the first that is as good.
    """
    best = min((m for marks in runs.values() for m in marks[1:]), key=lambda m: m.kernel)
    times = [t for marks in runs.values() if (t := first_as_good(marks, best)) is not None]
    own_times = [t for marks in runs.values() if (t := first_as_good(marks, own)) is not None]
    return {
        "best": best.as_row(),
        "reached_s": min(times),
        "enet_as_good": own.as_good_as(best),
        "enet_lacks": list(own.lacks(best)),
        "enet_first_s": min((m.seconds for m in (own, *shorter) if m.as_good_as(best)), default=None),
        "as_good_as_enet_s": min(own_times, default=None),
        "curves": {name: [m.as_row() for m in marks] for name, marks in runs.items()},
    }


def first_as_good(marks: Marks, best: Mark) -> float | None:
    """Seconds at which the curve, linear between its marks, first is as good as ``best``; the start does not count."""
    for before, after in itertools.pairwise(marks):
        if after.as_good_as(best):
            if before.as_good_as(best):  # the start was so good already: distillation brought nothing
                return after.seconds
            parts = [a / (a - b) if a > 0 else 0.0 for a, b in zip(before.lacks(best), after.lacks(best), strict=True)]
            return before.seconds + max(parts) * (after.seconds - before.seconds)
    return None
