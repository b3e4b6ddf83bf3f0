"""Per-scene 3DGS from start to end: scenes along the way for curves over seconds, and the stage's result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from genre_tasks.per_scene.training import PerSceneTraining
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.reconstruction import Reconstruction


@dataclass(frozen=True)
class Snapshot:
    """The scene at one moment of a training.

    Attributes:
        seconds: time spent on training so far, and on nothing else.
        iteration: iterations so far.
        scene: a copy of the scene.
    """

    seconds: float
    iteration: int
    scene: SceneGraph


def train_with_snapshots(
    training: PerSceneTraining,
    iterations: Sequence[int] = (),
    seconds: Sequence[float] = (),
    budget_s: float = float("inf"),
) -> Iterator[Snapshot]:
    """Trains to the end, or until a budget is spent, and yields the scene on the way and at the end.

    The clock stands while the caller works with a scene. Snapshots do not change the training, which can be continued
    after it was left.

    Args:
        training: the training to continue.
        iterations: yields the scene after each of these iterations.
        seconds: yields the scene as soon as each of these times has passed.
        budget_s: seconds of training after which it stops.

    Yields:
        The scenes in the order of time; the last one is at the end.
    """
    remaining = sorted(s for s in seconds if s > training.seconds)
    total = training.config.iterations
    while training.iteration < total and training.seconds < budget_s:
        training.step()
        passed = [s for s in remaining if s <= training.seconds]
        # Several times can pass within one iteration; they share one snapshot.
        remaining = remaining[len(passed) :]
        # The end is always yielded, so that a curve goes as far as the training did.
        is_last = training.iteration == total or training.seconds >= budget_s
        if passed or is_last or training.iteration in iterations:
            yield Snapshot(training.seconds, training.iteration, training.scene)


def reconstruct_per_scene(
    training: PerSceneTraining, keep: frozenset[int] = frozenset(), progress: Progress = silent
) -> Reconstruction:
    """Runs a training to its end.

    Args:
        training: the training to continue.
        keep: iterations after which the scene is kept for the curve.
        progress: called after every iteration with the loss and the number of Gaussians.

    Returns:
        The final scene with the loss and the seconds of every iteration, and the kept scenes.

    Raises:
        NonFiniteError: the loss or a Gaussian is no longer finite.
    """
    losses = []
    seconds = []
    kept = {}
    total = training.config.iterations
    while training.iteration < total:
        before = training.seconds
        losses.append(training.step())
        # By the training's own clock, which stands while scenes are copied and progress is shown.
        seconds.append(training.seconds - before)
        if training.iteration in keep:
            # A copy: the training goes on in place.
            kept[training.iteration] = training.scene
        progress(training.iteration, total, f"loss {losses[-1]:.3f}, {len(training)} Gaussians")
    return Reconstruction(training.scene, tuple(losses), kept, tuple(seconds), training.culled)
