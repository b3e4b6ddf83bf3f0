"""Accuracy over seconds and renders: the unrolled methods and per-scene 3DGS, each as points along its way.

The clock runs from the scene and the decoded images in memory, and includes the loading of weights. It stands still
while a scene is scored.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from benchmarks.common.task import OptimisationTask
from genre_tasks.config import GnetConfig, OptimiserConfig
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.unroll import UnrolledLoop, unroll_steps
from genre_tasks.per_scene.run import train_with_snapshots
from genre_tasks.per_scene.setup import freeze_actors
from genre_tasks.per_scene.training import PerSceneTraining
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.stages.optimise import StageName, UnrolledOptimiser, method_for

SCORE_INTERVAL_GROWTH = 1.25
"""Time between two scores grows by this factor, so a time is known to a quarter; in between it is interpolated."""
FIRST_SCORE = 0.25
"""Time of the first score, as a fraction of GNet's seconds."""


@dataclass(frozen=True)
class Moment:
    """A run after some iterations.

    Attributes:
        seconds: time so far.
        iteration: iterations so far, over all parts.
        renders: views rendered so far, those for a split included.
        loop: the optimisation; it goes on when the next moment is asked for.
    """

    seconds: float
    iteration: int
    renders: int
    # No state of its own: a state that is kept makes the loop take fresh memory, which costs milliseconds.
    loop: UnrolledLoop

    @property
    def scene(self) -> SceneGraph:
        """The scene at this moment; ask for it before the next one."""
        return self.loop.scene()


@dataclass(frozen=True)
class Point:
    """One point of a curve.

    Attributes:
        seconds: time so far.
        renders: views rendered so far.
        psnr: mean over held-out views, dB.
        gaussians: how many the scene has.
        beside: PSNR 3 m beside the path, dB; ``None`` where there is no truth.
    """

    seconds: float
    renders: int
    psnr: float
    gaussians: int
    beside: float | None = None


def timed_steps(
    load: Callable[[], UnrolledOptimiser], task: OptimisationTask, novel: Sequence[Target] = ()
) -> Iterator[Moment]:
    """Runs an optimiser step by step on the clock, the last part without end.

    Args:
        load: loads the optimiser; its time counts.
        task: the scene and its views.
        novel: fixed novel views.

    Yields:
        Moment: after each iteration.
    """
    began = time.perf_counter()
    # Weights of all parts are loaded at once, as the stage does.
    optimiser = load()
    scene = task.scene
    seconds = 0.0
    iteration = 0
    renders = 0
    for part in optimiser.parts:
        loop = UnrolledLoop.start(part.rule, scene, task.source, novel, optimiser.objective, part.settings)
        if part.settings.split_fraction:
            renders += len(task.source) + len(novel)
        # The last part goes on past its length: what happens there is measured too.
        length = None if part is optimiser.parts[-1] else part.settings.iterations
        for _ in itertools.islice(unroll_steps(loop, "bench"), length):
            iteration += 1
            renders += loop.renders_per_iteration
            seconds += time.perf_counter() - began
            yield Moment(seconds, iteration, renders, loop)
            # The consumer scores the scene while this generator is suspended; that time does not count.
            began = time.perf_counter()
        scene = loop.scene()


def take_last(moments: Iterator[Moment], iterations: int) -> Moment:
    """Runs some iterations and returns the last moment.

    Args:
        moments: of one run.
        iterations: how many, at least one.

    Returns:
        Moment: the last. Those before it are let go of.
    """
    # Each moment may hold a scene; a deque of one lets the earlier ones go.
    (last,) = deque(itertools.islice(moments, iterations), maxlen=1)
    return last


def stage_steps(
    stage: StageName, task: OptimisationTask, config: OptimiserConfig, seed: int, novel: Sequence[Target] = ()
) -> Iterator[Moment]:
    """Runs a stage's optimiser as configured, on the clock and without end.

    Args:
        stage: gnet or enet.
        task: the scene and its views.
        config: the stage's section, of an unrolled method.
        seed: of the order of views.
        novel: fixed novel views.

    Returns:
        Iterator[Moment]: after each iteration.
    """

    def load() -> UnrolledOptimiser:
        optimiser = method_for(stage, config.model_copy(update={"seed": seed}))
        assert isinstance(optimiser, UnrolledOptimiser)
        return optimiser

    return timed_steps(load, task, novel)


def gnet_steps(task: OptimisationTask, config: GnetConfig, seed: int) -> Iterator[Moment]:
    """Runs GNet or tuned Adam in its place, without the perceptual term, which the preset does not have.

    Args:
        task: the scene and its views.
        config: GNet's section, of an unrolled method.
        seed: of the order of views.

    Returns:
        Iterator[Moment]: after each iteration, without end.
    """
    # The preset has no such term, and the clock must not count the loading of a network that it does not use.
    loss = config.loss.model_copy(update={"perceptual": 0.0})
    return stage_steps("gnet", task, config.model_copy(update={"loss": loss}), seed)


def warm_up(task: OptimisationTask, config: GnetConfig, seed: int) -> None:
    """Takes one step, so that the run on the clock does not pay for code and kernels that a process loads once.

    Args:
        task: the scene and its views.
        config: GNet's section.
        seed: of the order of views.
    """
    take_last(gnet_steps(task, config, seed), 1)


def run_learned(task: OptimisationTask, config: GnetConfig, seed: int) -> list[Point]:
    """Runs GNet to its end, and scores it at each quarter of its way.

    Args:
        task: the scene and its views.
        config: GNet's section.
        seed: of the order of views.

    Returns:
        The curve, from the start on.
    """
    quarters = {round(config.iterations * k / 4) for k in (1, 2, 3, 4)}
    curve = [score_start(task)]
    for moment in itertools.islice(gnet_steps(task, config, seed), config.iterations):
        if moment.iteration in quarters:
            curve.append(score_scene(task, moment.seconds, moment.renders, moment.scene))
    return curve


def run_adam(task: OptimisationTask, config: GnetConfig, seed: int, goal: Point, cap_s: float) -> list[Point]:
    """Runs tuned Adam until it has reached the goal's PSNR and made as many renders, or the cap.

    A constant schedule does not know its length and goes on after it; the cosine ends with it.

    Args:
        task: the scene and its views.
        config: GNet's section with the method adam.
        seed: of the order of views.
        goal: GNet's end.
        cap_s: seconds after which the run is given up.

    Returns:
        The curve, from the start on.
    """
    moments = gnet_steps(task, config, seed)
    length = config.iterations if config.adam.schedule == "cosine" else None
    due = score_times(goal.seconds, cap_s)
    curve = [score_start(task)]
    for moment in itertools.islice(moments, length):
        last = curve[-1]
        is_due = bool(due) and due[0] <= moment.seconds
        # Three reasons to score: the next time is due, the goal's renders are made, the cap is passed.
        has_equal_renders = last.renders < goal.renders <= moment.renders
        passes_cap = last.seconds < cap_s <= moment.seconds
        if is_due or has_equal_renders or passes_cap or moment.iteration == length:
            curve.append(score_scene(task, moment.seconds, moment.renders, moment.scene))
            due = [second for second in due if second > moment.seconds]
        is_over = moment.seconds >= cap_s or _best_psnr(curve) >= goal.psnr
        # The comparison at equal renders needs a point there, also where the goal was reached before.
        if curve[-1].renders >= goal.renders and is_over:
            break
    return curve


def run_per_scene(task: OptimisationTask, config: GnetConfig, seed: int, goal: Point, cap_s: float) -> list[Point]:
    """Runs per-scene 3DGS until it has reached the goal's PSNR, or to its end, or the cap. It renders a view a step.

    Args:
        task: the scene and its views.
        config: GNet's section with a per-scene method.
        seed: of the order of views.
        goal: GNet's end.
        cap_s: seconds after which the run is given up.

    Returns:
        The curve, from the start on.
    """
    began = time.perf_counter()
    # The standard recipe knows no motion; Street Gaussians keeps the actors' tracks.
    scene = task.scene if config.method == "street_gs" else freeze_actors(task.scene)
    training = PerSceneTraining(config.per_scene, scene, task.source, seed)
    # Setting up the training counts, as loading weights does for the learned optimiser.
    training.seconds = time.perf_counter() - began
    curve = [score_scene(task, 0.0, 0, scene)]
    times = score_times(goal.seconds, cap_s)
    for snapshot in train_with_snapshots(training, seconds=times, budget_s=cap_s):
        curve.append(score_scene(task, snapshot.seconds, snapshot.iteration, snapshot.scene))
        if curve[-1].psnr >= goal.psnr:
            break
    return curve


def score_times(unit_s: float, cap_s: float) -> list[float]:
    """Lists the times at which a method is scored, with growing intervals.

    Args:
        unit_s: GNet's seconds.
        cap_s: seconds at which the run is given up.

    Returns:
        Seconds below the cap.

    >>> score_times(4.0, 2.0)
    [1.0, 1.25, 1.5625, 1.953125]
    """
    times = (unit_s * FIRST_SCORE * SCORE_INTERVAL_GROWTH**k for k in itertools.count())
    return list(itertools.takewhile(lambda second: second < cap_s, times))


def time_to_reach(curve: Sequence[Point], psnr: float) -> float | None:
    """Finds when a curve, linear between its points, first has a PSNR.

    Args:
        curve: in order of time.
        psnr: dB.

    Returns:
        Seconds; ``None`` where it never has it.

    >>> time_to_reach([Point(0.0, 0, 10.0, 1), Point(2.0, 4, 20.0, 1)], 15.0)
    1.0
    """
    for before, after in itertools.pairwise(curve):
        if after.psnr >= psnr:
            # Linear in between; a first point above the goal counts at its own time.
            # A flat stretch would divide by zero.
            fraction = max(psnr - before.psnr, 0.0) / max(after.psnr - before.psnr, 1e-12)
            return before.seconds + min(fraction, 1.0) * (after.seconds - before.seconds)
    return None


def psnr_at_renders(curve: Sequence[Point], renders: int) -> float | None:
    """Finds the PSNR at a number of renders.

    Args:
        curve: in order of time.
        renders: views rendered.

    Returns:
        dB at the first point with that many; ``None`` where the curve ends before.
    """
    return next((point.psnr for point in curve if point.renders >= renders), None)


def score_start(task: OptimisationTask) -> Point:
    """Scores the scene before the first step."""
    return score_scene(task, 0.0, 0, task.scene)


def score_scene(task: OptimisationTask, seconds: float, renders: int, scene: SceneGraph) -> Point:
    """Scores a scene; the clock stands still meanwhile.

    Args:
        task: with the held-out views.
        seconds: time so far.
        renders: views rendered so far.
        scene: to score.

    Returns:
        Point: of a curve.
    """
    return Point(seconds, renders, task.psnr(scene), len(scene), task.psnr_novel(scene))


def _best_psnr(curve: Sequence[Point]) -> float:
    return max(point.psnr for point in curve)
