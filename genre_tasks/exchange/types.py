"""What a file of Gaussians holds, and the protocol that every format keeps.

Values are those of 3DGS before activation, with the order and signs of its spherical harmonics, w-first quaternions
and metres. A format turns its own scales, opacities, axes and orders into these when it reads, and back when it writes.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Float64

SH_DC = 0.28209479177387814
"""The constant spherical harmonic: a colour is 0.5 + ``SH_DC`` times its coefficient (Kerbl et al. 2023)."""

SH_REST_COUNTS = (0, 3, 8, 15, 24)
"""How many coefficients a channel has beyond the constant one, for degrees 0 to 4."""


@dataclass(frozen=True)
class SplatCloud:
    """N Gaussians as files hold them.

    Attributes:
        means: [N, 3] float32 metres.
        log_scales: [N, 3] float32 natural logarithm of standard deviations in metres.
        quats: [N, 4] float32 rotations, w first; need not be unit.
        logit_opacities: [N] float32.
        sh_dc: [N, 3] float32 coefficients of the constant harmonic.
        sh_rest: [N, K, 3] float32 further coefficients, K in ``SH_REST_COUNTS``.
        antialiased: whether the Gaussians were made with anti-aliasing; ``None``: the file does not say.

    >>> cloud = SplatCloud.empty()
    >>> len(cloud), cloud.sh_degree
    (0, 0)
    """

    means: Float32
    log_scales: Float32
    quats: Float32
    logit_opacities: Float32
    sh_dc: Float32
    sh_rest: Float32
    antialiased: bool | None = None

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return SH_REST_COUNTS.index(self.sh_rest.shape[1])

    @staticmethod
    def empty(sh_degree: int = 0) -> SplatCloud:
        """Makes a cloud without Gaussians.

        Args:
            sh_degree: 0 to 4.
        """
        return SplatCloud(
            means=np.zeros((0, 3), np.float32),
            log_scales=np.zeros((0, 3), np.float32),
            quats=np.zeros((0, 4), np.float32),
            logit_opacities=np.zeros(0, np.float32),
            sh_dc=np.zeros((0, 3), np.float32),
            sh_rest=np.zeros((0, SH_REST_COUNTS[sh_degree], 3), np.float32),
        )

    def select(self, rows: NDArray[np.int64] | NDArray[np.bool_] | slice) -> SplatCloud:
        """Picks some of the Gaussians.

        Args:
            rows: indices, a mask [N] or a slice.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        arrays = {name: value[rows] for name, value in values.items() if isinstance(value, np.ndarray)}
        return SplatCloud(**(values | arrays))


@dataclass(frozen=True)
class NodeMotion:
    """Where a moving node is at each moment of its scene.

    Attributes:
        scene_SE3_node: [F, 4, 4] float64, one for each of ``ExchangeScene.times_s``; the identity where absent.
        present: [F] whether the node exists then.
    """

    scene_SE3_node: Float64
    present: NDArray[np.bool_]


@dataclass(frozen=True)
class ExchangeNode:
    """One part of a scene that moves as a whole.

    Attributes:
        name: unique in the scene, fit for a file's name: ``background``, ``distant``, ``car-3``.
        cloud: Gaussians in the node's own coordinates; for an actor its box, with x forward, y left and z up.
        motion: ``None``: the node rests, and its coordinates are the scene's.
        label: class of an actor, in the log's words; empty for other nodes.
        track_id: the log's name for an actor; empty for other nodes.
        size_m: length, width and height of an actor's box; zeros for other nodes.
    """

    name: str
    cloud: SplatCloud
    motion: NodeMotion | None = None
    label: str = ""
    track_id: str = ""
    size_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ExchangeScene:
    """A scene between GenRe and a file. Its coordinates are metres with z up.

    Attributes:
        nodes: with distinct names.
        times_s: [F] float64 seconds of the moments that motions are stated at, from 0 on; empty without motion.
        frames: the log frames of these moments; empty where none is known.
        world_SE3_scene: [4, 4] float64 the scene's place in the log's world.
        losses: sentences on what the scene lost on its way into this value, such as exposure or deformation.
    """

    nodes: tuple[ExchangeNode, ...]
    times_s: Float64
    frames: tuple[int, ...]
    world_SE3_scene: Float64
    losses: tuple[str, ...] = ()


class ExchangeFormat(Protocol):
    """A file format. Reading and writing never run code of a file, and bound memory by the file's size."""

    @property
    def name(self) -> str:
        """What ``--format`` takes: ``ply``, ``splat``, ``spz``, ``glb``, ``usdz``."""
        ...

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Ends of file names, in lower case, the one that is written first: ``(".ply",)``."""
        ...

    @property
    def can_write(self) -> bool:
        """Whether :meth:`write` is there."""
        ...

    @property
    def carries_nodes(self) -> bool:
        """Whether one file holds several nodes and their motion; else a file holds one node that rests."""
        ...

    def read(self, path: Path) -> ExchangeScene:
        """Reads a file.

        Args:
            path: of the file.

        Returns:
            The scene; ``losses`` says what of the file is not in it.

        Raises:
            InputError: the file is no such file, is cut off, claims more than it has, or holds what is not finite.
        """
        ...

    def write(self, path: Path, scene: ExchangeScene) -> None:
        """Writes a file; the caller renames it when it is complete.

        Args:
            path: of the file; an existing one is replaced.
            scene: with one resting node where the format carries no nodes.

        Raises:
            InputError: the scene does not fit into the format's ranges.
        """
        ...

    def describe_losses(self, scene: ExchangeScene) -> tuple[str, ...]:
        """Lists what of a scene the format cannot carry.

        Args:
            scene: to be written.

        Returns:
            Sentences, beside those in ``scene.losses``; empty where everything is kept.
        """
        ...
