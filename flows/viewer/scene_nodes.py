"""A scene graph as the arrays of a splat viewer: for each node centres, covariances, colours and opacities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.exchange.types import NodeMotion
from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC, SceneGraph
from genre_tasks.scene.rotations import quats_to_matrices
from genre_tasks.scene.transforms import compose_se3

MAX_SIGMA_M = 200.0
"""Covariances travel as float16, in which a standard deviation of 256 m is infinite."""

_SHARED_ROOM = 0.25
"""The part of a limited number of Gaussians that nodes share by their sizes, whatever the images show of them."""

# The distance that almost all of the background is within; single stray Gaussians do not count.
_BACKGROUND_PERCENT = 99.5


@dataclass(frozen=True)
class SplatNode:
    """A part of a scene that moves as a whole, as a viewer draws it.

    Attributes:
        name: ``background``, ``distant`` or an actor's readable name.
        centers: [N, 3] metres, in the node's coordinates.
        covariances: [N, 3, 3] square metres, no standard deviation above ``MAX_SIGMA_M``.
        rgbs: [N, 3] sRGB in [0, 1].
        opacities: [N, 1] in [0, 1].
        motion: where the node is at each frame; ``None``: it rests in the chunk's coordinates.
    """

    name: str
    centers: Float32
    covariances: Float32
    rgbs: Float32
    opacities: Float32
    motion: NodeMotion | None = None

    def __len__(self) -> int:
        return len(self.centers)


@dataclass(frozen=True)
class SceneNodes:
    """A scene for a viewer.

    Attributes:
        nodes: with distinct names; those without a Gaussian are not there.
        losses: sentences on what the scene lost on its way here.
    """

    nodes: tuple[SplatNode, ...]
    losses: tuple[str, ...]

    def __len__(self) -> int:
        return sum(len(node) for node in self.nodes)


def build_scene_nodes(
    scene: SceneGraph,
    frames: Sequence[int],
    names: Mapping[str, str],
    *,
    center: Float64,
    colors: Float32 | None = None,
    rows: NDArray[np.int64] | None = None,
) -> SceneNodes:
    """Turns a scene graph into nodes for a viewer.

    Args:
        scene: N Gaussians.
        frames: log frames at which the actors' poses are stated.
        names: readable name by track id.
        center: [3] metres, the middle of the path, towards which too large distant Gaussians are drawn.
        colors: [N, 3] sRGB to show; ``None``: the Gaussians' own.
        rows: Gaussians to take, in rising order; ``None``: all.

    Returns:
        The nodes, with a sentence for each loss.

    >>> from genre_tasks.scene.gaussians import Gaussians
    >>> packed = torch.tensor([[0.0, 0.0, 5.0, -1.0, -1.0, -1.0, 1.0, 0.0, 0.0, 0.0, 2.0, 1.0, 0.0, 0.0]])
    >>> scene = SceneGraph(Gaussians.unpack(packed), torch.zeros(1, dtype=torch.int64), ())
    >>> nodes = build_scene_nodes(scene, (0,), {}, center=np.zeros(3)).nodes
    >>> nodes[0].name, nodes[0].covariances.shape
    ('background', (1, 3, 3))
    """
    arrays = _Arrays.from_scene(scene, colors)
    taken = np.ones(len(scene), dtype=bool)
    losses = []
    if rows is not None:
        taken[:] = False
        taken[rows] = True
        if not taken.all():
            losses.append(f"{(~taken).sum():,} of {len(scene):,} Gaussians are left out, those that fill least.")
    finite = arrays.is_finite()
    _report(losses, taken & ~finite, "hold values that are not finite and are left out")
    taken &= finite
    moved, lost = _draw_near(arrays, taken & (arrays.node_of == DISTANT), center, arrays.measure_reach(center))
    lost |= taken & (arrays.node_of != DISTANT) & (arrays.largest_sigma() > MAX_SIGMA_M)
    _report(losses, moved, "of the distant region are too large for the viewer and are drawn nearer")
    _report(losses, lost, "are too large for the viewer and are left out")
    taken &= ~lost
    if scene.deformation is not None:
        losses.append("The deformation of actors is not shown: each moves as a rigid body.")
    if scene.spherical_harmonics is not None:
        losses.append("A Gaussian has the one colour in which the path sees it.")
    motions = _actor_motions(scene, frames)
    nodes = [arrays.cut("background", taken & (arrays.node_of == STATIC), None)]
    nodes.append(arrays.cut("distant", taken & (arrays.node_of == DISTANT), None))
    for k, actor in enumerate(scene.actors):
        name = names.get(actor.track_id, actor.track_id)
        nodes.append(arrays.cut(name, taken & (arrays.node_of == FIRST_ACTOR + k), motions[k]))
    return SceneNodes(tuple(node for node in nodes if len(node)), tuple(losses))


def select_rows(weights: Float32, node_of: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Selects the Gaussians that fill most of the images, with some of every node.

    Args:
        weights: [N] of ``PathColors``.
        node_of: [N] the node of each.
        count: how many at most.

    Returns:
        Indices in rising order.

    >>> select_rows(np.array([0.5, 3.0, 1.0], np.float32), np.zeros(3, np.int64), 2).tolist()
    [1, 2]
    """
    # Stable, so that equal weights give the same choice everywhere.
    order = np.argsort(-weights, kind="stable")
    # A distant actor fills few pixels and would vanish: a part of the room is shared out by numbers of Gaussians.
    rank_in_node = np.empty(len(weights), np.int64)
    room = np.zeros(len(weights))
    for node in np.unique(node_of):
        members = order[node_of[order] == node]
        rank_in_node[members] = np.arange(len(members))
        room[members] = _SHARED_ROOM * count * len(members) / len(weights)
    is_reserved = rank_in_node < np.floor(room)
    return np.sort(np.concatenate([order[is_reserved[order]], order[~is_reserved[order]]])[:count])


@dataclass
class _Arrays:
    # All Gaussians of a scene; `_draw_near` changes means and scales in place.
    means: Float32
    scales: Float32
    rotations: Float32
    opacities: Float32
    colors: Float32
    node_of: NDArray[np.int64]

    @staticmethod
    def from_scene(scene: SceneGraph, colors: Float32 | None) -> _Arrays:
        with torch.no_grad():
            splats = scene.gaussians.activate()
            return _Arrays(
                means=splats.means.cpu().numpy().copy(),
                scales=splats.scales.cpu().numpy().copy(),
                rotations=quats_to_matrices(splats.quats).cpu().numpy(),
                opacities=splats.opacities.cpu().numpy(),
                colors=np.clip(splats.colors.cpu().numpy() if colors is None else colors, 0.0, 1.0),
                node_of=scene.nodes.cpu().numpy(),
            )

    def is_finite(self) -> NDArray[np.bool_]:
        parts = (self.means, self.scales, self.rotations.reshape(len(self.means), 9), self.colors)
        finite = np.isfinite(self.opacities)
        for part in parts:
            finite &= np.isfinite(part).all(1)
        return finite

    def largest_sigma(self) -> Float32:
        return np.asarray(self.scales.max(1, initial=0.0))

    def measure_reach(self, center: Float64) -> float:
        # How far the background goes: what is drawn nearer must stay behind it.
        distance = np.linalg.norm(self.means[self.node_of == STATIC] - center, axis=1)
        distance = distance[np.isfinite(distance)]
        return float(np.percentile(distance, _BACKGROUND_PERCENT)) if len(distance) else 0.0

    def cut(self, name: str, mask: NDArray[np.bool_], motion: NodeMotion | None) -> SplatNode:
        # R diag(s) and its square, as 3DGS builds a covariance.
        scaled = self.rotations[mask] * self.scales[mask][:, None, :]
        covariances = scaled @ scaled.transpose(0, 2, 1)
        return SplatNode(name, self.means[mask], covariances, self.colors[mask], self.opacities[mask][:, None], motion)


def _draw_near(
    arrays: _Arrays, distant: NDArray[np.bool_], center: Float64, reach_m: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    # Scales too large distant Gaussians about the path, from where they look the same; those that would come before
    # the background are lost.
    sigma = arrays.largest_sigma()
    large = distant & (sigma > MAX_SIGMA_M)
    factor = np.where(large, MAX_SIGMA_M / np.maximum(sigma, 1e-9), 1.0)[:, None].astype(np.float32)
    about = center.astype(np.float32)
    means = about + factor * (arrays.means - about)
    lost = large & (np.linalg.norm(means - about, axis=1) < reach_m)
    moved = large & ~lost
    arrays.means[moved] = means[moved]
    arrays.scales[moved] *= factor[moved]
    return moved, lost


def _actor_motions(scene: SceneGraph, frames: Sequence[int]) -> list[NodeMotion]:
    rotation, translation, present = scene.actor_poses(frames)
    poses = compose_se3(rotation, translation)
    return [NodeMotion(poses[:, k], present[:, k]) for k in range(len(scene.actors))]


def _report(losses: list[str], mask: NDArray[np.bool_], what: str) -> None:
    if mask.any():
        losses.append(f"{mask.sum():,} Gaussians {what}.")
