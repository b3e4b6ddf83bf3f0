"""What the stages return that reconstruct a scene."""

from __future__ import annotations

from dataclasses import dataclass, field

from genre_tasks.scene.graph import SceneGraph


@dataclass(frozen=True)
class Reconstruction:
    """A scene and how it came about: the output of ``initial``, ``gnet`` and ``enet``.

    Attributes:
        scene: the result.
        losses: [T] training loss of each iteration.
        snapshots: iteration count → the scene after so many iterations; 0 and T need not be in it.
        seconds_per_iteration: [T], a measurement and no payload: it goes into the manifest.
        culled: Gaussians that the last render left out, by reason.
    """

    scene: SceneGraph
    losses: tuple[float, ...] = ()
    snapshots: dict[int, SceneGraph] = field(default_factory=dict)
    seconds_per_iteration: tuple[float, ...] = ()
    culled: dict[str, int] = field(default_factory=dict)
