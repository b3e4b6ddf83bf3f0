"""Accuracy over seconds and renders: the unrolled methods and per-scene 3DGS, each as points along its way.

The clock runs from the scene and the decoded images in memory, loading of weights included, and stands while a scene is
judged.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch

from benchmarks.common.task import Task
from genre_tasks.checks import check_finite
from genre_tasks.config import GnetConfig
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.residual_splitting import split_where_images_have_more
from genre_tasks.optimiser.state import Frame, State
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.optimiser.unroll import Plan, camera_centre, moved_scene
from genre_tasks.optimiser.view_sampler import ViewSampler
from genre_tasks.per_scene.run import snapshots
from genre_tasks.per_scene.setup import world_static
from genre_tasks.per_scene.training import PerSceneTraining
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.stages.optimise import plan_of, refine_plan, refine_rule, step_rule

LOOK_FACTOR = 1.25
"""Seconds between two looks grow by this: a time is known to a quarter, and interpolated in between."""
FIRST_LOOK = 0.25
"""Of GNet's seconds."""


@dataclass(frozen=True)
class Moment:
    """After ``iteration`` steps, which took ``seconds`` and so many views rendered, those of a split among them."""

    seconds: float
    iteration: int
    renders: int
    frame: Frame
    state: State

    @property
    def scene(self) -> SceneGraph:
        return moved_scene(self.frame, self.state)


@dataclass(frozen=True)
class Point:
    """One point of a curve; ``beside``: PSNR 3 m beside the path, where there is truth."""

    seconds: float
    renders: int
    psnr: float
    gaussians: int
    beside: float | None = None


def walk(
    make: Callable[[], tuple[StepRule, Objective]], task: Task, plan: Plan, novel: Sequence[Target] = ()
) -> Iterator[Moment]:
    """``genre_tasks.optimiser.unroll.unroll`` step by step and without end; the plan's T is what the rule is told.

    ``make`` loads the rule and what its objective needs: its time counts.
    """
    began = time.perf_counter()
    rule, objective = make()
    generator = torch.Generator().manual_seed(plan.seed)
    samplers = ViewSampler(task.source, plan.views, generator), ViewSampler(novel, plan.novel_views, generator)
    scene = split_where_images_have_more(task.scene, [*task.source, *novel], plan.split)
    frame, state = Frame.of(scene, plan.constrain_ground), State.start(len(scene), scene.gaussians.means)
    step = rule.start(frame, camera_centre(task.source))
    seconds, renders = time.perf_counter() - began, len(task.source) + len(novel) if plan.split else 0
    for i in itertools.count():
        began = time.perf_counter()
        batch = [target for sampler in samplers for target in sampler.draw()]
        sight = objective(frame, state.offsets, batch, i, generator, residuals=rule.residuals)
        check_finite(sight.gradient, "gradient", "bench")
        state = state.saw(sight.gradient, sight.residuals)
        state = state.moved(frame, step(state, sight.gradient, plan.iterations))
        check_finite(state.offsets, "updated Gaussians", "bench")
        renders += len(batch)
        seconds += time.perf_counter() - began
        yield Moment(seconds, i + 1, renders, frame, state)


def at_end(moments: Iterator[Moment], iterations: int) -> Moment:
    """The last of so many moments, > 0. Those before are let go: fresh memory for each state takes milliseconds."""
    (last,) = deque(itertools.islice(moments, iterations), maxlen=1)
    return last


def configured(task: Task, config: GnetConfig, seed: int) -> Iterator[Moment]:
    """The stage's own rules, loss, views and T, without its perceptual term: the preset has none. Without end."""
    config = config.model_copy(update={"seed": seed})
    objective, plan, finish = Objective(config.loss), plan_of("gnet", config), config.refinement
    first = walk(lambda: (step_rule("gnet", config), objective), task, plan)
    if finish is None:
        yield from first
        return
    for moment in itertools.islice(first, plan.iterations):
        before = moment
        yield moment
    then = replace(task, scene=before.scene)
    for moment in walk(lambda: (refine_rule(finish), objective), then, refine_plan(config, finish)):
        yield replace(
            moment,
            seconds=before.seconds + moment.seconds,
            iteration=before.iteration + moment.iteration,
            renders=before.renders + moment.renders,
        )


def learned(task: Task, config: GnetConfig, seed: int) -> list[Point]:
    """GNet to its end, judged at each quarter of its way."""
    quarters = {round(config.iterations * k / 4) for k in (1, 2, 3, 4)}
    steps = configured(task, config, seed)
    out = [start(task)]
    for moment in itertools.islice(steps, config.iterations):
        if moment.iteration in quarters:
            out.append(point(task, moment.seconds, moment.renders, moment.scene))
    return out


def adam(task: Task, config: GnetConfig, seed: int, goal: Point, cap_s: float) -> list[Point]:
    """Tuned Adam until it has reached the goal's PSNR and made as many renders, or the cap.

    A constant schedule does not know its length and goes on after it; the cosine ends with it.
    """
    steps = configured(task, config, seed)
    length = config.iterations if config.adam.schedule == "cosine" else None
    due, out = looks(goal.seconds, cap_s), [start(task)]
    for moment in itertools.islice(steps, length):
        equal = out[-1].renders < goal.renders <= moment.renders
        capped = out[-1].seconds < cap_s <= moment.seconds
        passed = bool(due) and due[0] <= moment.seconds
        if passed or equal or capped or moment.iteration == length:
            out.append(point(task, moment.seconds, moment.renders, moment.scene))
            due = [s for s in due if s > moment.seconds]
        if out[-1].renders >= goal.renders and (moment.seconds >= cap_s or _best(out) >= goal.psnr):
            break
    return out


def per_scene(task: Task, config: GnetConfig, seed: int, goal: Point, cap_s: float) -> list[Point]:
    """Per-scene 3DGS until it has reached the goal's PSNR, or to its end, or the cap. One view a step."""
    began = time.perf_counter()
    scene = task.scene if config.method == "street_gs" else world_static(task.scene)
    training = PerSceneTraining(config.per_scene, scene, task.source, seed)
    training.seconds = time.perf_counter() - began
    out = [point(task, 0.0, 0, scene)]
    for s in snapshots(training, seconds=looks(goal.seconds, cap_s), budget_s=cap_s):
        out.append(point(task, s.seconds, s.iteration, s.scene))
        if out[-1].psnr >= goal.psnr:
            break
    return out


def looks(unit_s: float, cap_s: float) -> list[float]:
    """Seconds at which a method is judged, below the cap."""
    times = (unit_s * FIRST_LOOK * LOOK_FACTOR**k for k in itertools.count())
    return list(itertools.takewhile(lambda s: s < cap_s, times))


def reached(points: Sequence[Point], psnr: float) -> float | None:
    """Seconds at which the curve, linear between its points, first has this PSNR; ``None``: it never has."""
    for before, after in itertools.pairwise(points):
        if after.psnr >= psnr:
            part = max(psnr - before.psnr, 0.0) / max(after.psnr - before.psnr, 1e-12)
            return before.seconds + min(part, 1.0) * (after.seconds - before.seconds)
    return None


def at_renders(points: Sequence[Point], renders: int) -> float | None:
    """PSNR at the first point with so many renders; ``None`` where the curve ends before."""
    return next((p.psnr for p in points if p.renders >= renders), None)


def _best(points: Sequence[Point]) -> float:
    return max(p.psnr for p in points)


def start(task: Task) -> Point:
    """Before the first step."""
    return point(task, 0.0, 0, task.scene)


def point(task: Task, seconds: float, renders: int, scene: SceneGraph) -> Point:
    """The scene judged; the clock stands meanwhile."""
    return Point(seconds, renders, task.psnr(scene), len(scene), task.psnr_beside(scene))
