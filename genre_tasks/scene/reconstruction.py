"""What the reconstructing and the evaluating stages return."""

from __future__ import annotations

from dataclasses import dataclass, field

from genre_tasks.scene.graph import SceneGraph


@dataclass(frozen=True)
class Reconstruction:
    """A scene and how it came about (output of ``initial``, ``gnet`` and ``enet``).

    ``losses`` [T] training loss per iteration; ``snapshots`` maps an iteration count to the scene after so many
    iterations (0 and T need not be in it); ``seconds_per_iteration`` is a measurement and no payload: it goes into the
    manifest. ``culled`` counts left-out Gaussians by reason in the last render.
    """

    scene: SceneGraph
    losses: tuple[float, ...] = ()
    snapshots: dict[int, SceneGraph] = field(default_factory=dict)
    seconds_per_iteration: tuple[float, ...] = ()
    culled: dict[str, int] = field(default_factory=dict)
