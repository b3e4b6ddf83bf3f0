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
    """The scene after ``iteration`` iterations, which took ``seconds`` of training and of nothing else."""

    seconds: float
    iteration: int
    scene: SceneGraph


def snapshots(
    training: PerSceneTraining,
    iterations: Sequence[int] = (),
    seconds: Sequence[float] = (),
    budget_s: float = float("inf"),
) -> Iterator[Snapshot]:
    """Trains to the end, or until ``budget_s`` are spent, and yields the scene on the way and at the end.

    After each of ``iterations``, and as soon as each of ``seconds`` has passed; the clock stands while the caller works
    with a scene. The training itself does not depend on when it is looked at, and can be taken up again.
    """
    due = sorted(s for s in seconds if s > training.seconds)
    total = training.config.iterations
    while training.iteration < total and training.seconds < budget_s:
        training.step()
        passed = [s for s in due if s <= training.seconds]
        due = due[len(passed) :]
        last = training.iteration == total or training.seconds >= budget_s
        if passed or last or training.iteration in iterations:
            yield Snapshot(training.seconds, training.iteration, training.scene)


def reconstruct(
    training: PerSceneTraining, keep: frozenset[int] = frozenset(), progress: Progress = silent
) -> Reconstruction:
    """The training run to its end, with the scenes after the iterations ``keep``. Raises ``NonFiniteError``."""
    losses, seconds, kept = [], [], {}
    total = training.config.iterations
    while training.iteration < total:
        before = training.seconds
        losses.append(training.step())
        seconds.append(training.seconds - before)
        if training.iteration in keep:
            kept[training.iteration] = training.scene
        progress(training.iteration, total, f"loss {losses[-1]:.3f}, {len(training)} Gaussians")
    return Reconstruction(training.scene, tuple(losses), kept, tuple(seconds), training.culled)
