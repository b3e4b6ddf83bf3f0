"""What actors' deformation does to the means of splats in a render by kernels, and the way back.

It uses numpy: torch's threads would wake for each of its small steps, and then spin beside the kernels' threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float32
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.scene.deformation import LATTICE, Deformation
from genre_tasks.scene.graph import FIRST_ACTOR


class DeformedMeans:
    """Moves the means of deforming actors' splats, and takes their gradient to the control points.

    ``SceneGraph.gaussians_at_frames`` is its oracle, within rounding: here an actor's Gaussians are rotated before
    they are moved.

    Args:
        parameterization: the scene at its start, and the units of the offsets.
        offsets: [N, 14] from the start.
        frames: [F] distinct log frames.
        means: [S + F · M, 3] of the splats, laid out as ``SceneGraph.gaussians_at_frames``; moved in place.
        deformation: of A actors.
    """

    def __init__(
        self,
        parameterization: Parameterization,
        offsets: Tensor,
        frames: Sequence[float],
        means: Tensor,
        deformation: Deformation,
    ) -> None:
        scene = parameterization.scene
        posing = parameterization.posing
        nodes = scene.nodes.numpy()
        moving_rows = np.flatnonzero(nodes >= FIRST_ACTOR)
        # From an actor's number in the scene to its number among those that deform; -1 for the rigid ones.
        deforming_index = np.full(len(scene.actors), -1)
        deforming_index[list(deformation.actors)] = np.arange(len(deformation.actors))
        actor_of_moving = deforming_index[nodes[moving_rows] - FIRST_ACTOR]
        deforming = np.flatnonzero(actor_of_moving >= 0)
        self._rows = moving_rows[deforming]
        self._actor_of = actor_of_moving[deforming]
        # Static splats come first, then for each frame all splats of actors, also of the rigid ones.
        self._splats = posing.still + np.arange(len(frames))[:, None] * posing.moving + deforming
        self._unit_m = parameterization.unit_m.numpy()[self._rows]
        start = parameterization.initial.numpy()[self._rows, :3]
        box_means = start + offsets.numpy()[self._rows, :3] * self._unit_m
        sizes_m = deformation.sizes_m.numpy()[self._actor_of]
        self._weights, self._weight_slopes = trilinear_weights_and_slopes(box_means, sizes_m)
        # An actor has offsets at some frames only; the ones around a frame share its gradient.
        self._brackets = deformation.bracket_frames(frames)
        self._all_offsets = deformation.offsets
        # Interpolated once per render: views at the same frame share the control points.
        self._control_points = deformation.offsets_at(frames).numpy()
        rotations = scene.actor_poses(frames)[0].astype(np.float32)
        self._rotations = rotations[:, list(deformation.actors)]
        for f, splats in enumerate(self._splats):
            displacements = np.einsum("mc,mcd->md", self._weights, self._control_points[f][self._actor_of])
            means.numpy()[splats] += np.einsum("mij,mj->mi", self._rotations[f][self._actor_of], displacements)

    def gradient(self, by_means: Tensor, by_offsets: Tensor) -> Tensor:
        """Takes the gradient of the splats' means to the control points, and what depends on where a mean lies.

        Args:
            by_means: [S + F · M, 3] gradient with respect to the moved means.
            by_offsets: [N, 14] gradient with respect to the Gaussians' offsets; the part through the weights is
                added in place.

        Returns:
            [A, K, NODES, 3] gradient with respect to the control points of all frames.
        """
        by_box_means = np.zeros((len(self._rows), 3), np.float32)
        by_all_offsets = torch.zeros_like(self._all_offsets)
        actor_rows = np.arange(len(by_all_offsets))
        for f, splats in enumerate(self._splats):
            # A displacement is a vector: the box's rotation takes it to chunk axes, the translation has no part in it.
            by_displacement = np.einsum("mij,mi->mj", self._rotations[f][self._actor_of], by_means.numpy()[splats])
            by_weights = np.einsum("mcd,md->mc", self._control_points[f][self._actor_of], by_displacement)
            # The weights depend on where in the box the Gaussian is, so its mean has a gradient through them as well.
            by_box_means += np.einsum("mck,mc->mk", self._weight_slopes, by_weights)
            by_control_points = np.zeros(self._control_points.shape[1:], np.float32)
            # One product per actor, since actors share no control points and differ in their number of Gaussians.
            for actor in np.unique(self._actor_of):
                rows = self._actor_of == actor
                by_control_points[actor] = np.einsum("mc,md->cd", self._weights[rows], by_displacement[rows])
            before, after, position = (bracket[f] for bracket in self._brackets)
            toward_after = position.astype(np.float32)[:, None, None]
            # Rows are one per actor, so that no index pair occurs twice: ``+=`` would add only one of them.
            # ``before`` and ``after`` may be the same frame, which is why these are two statements.
            by_all_offsets.numpy()[actor_rows, before] += (1 - toward_after) * by_control_points
            by_all_offsets.numpy()[actor_rows, after] += toward_after * by_control_points
        by_offsets.numpy()[self._rows, :3] += by_box_means * self._unit_m
        return by_all_offsets


def trilinear_weights_and_slopes(positions: Float32, sizes_m: Float32) -> tuple[Float32, Float32]:
    """Computes how much each control point moves a position in its box, and how that changes with the position.

    Args:
        positions: [M, 3] metres in box axes, from the box's centre.
        sizes_m: [M, 3] length, width and height of each position's box.

    Returns:
        tuple: the weights [M, NODES] of ``deformation.trilinear_weights``, and their derivatives [M, NODES, 3] per
        metre; these are 0 outside of the box and on its faces.

    >>> weights, slopes = trilinear_weights_and_slopes(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    >>> weights.shape, slopes.shape, float(weights.sum())
    ((1, 16), (1, 16, 3), 1.0)
    """
    fractions = positions / sizes_m + np.float32(0.5)
    hats: list[Float32] = []
    hat_slopes: list[Float32] = []
    for k, count in enumerate(LATTICE):
        fraction = fractions[:, k, None]
        distance = fraction.clip(0, 1) * (count - 1) - np.arange(count, dtype=np.float32)
        # Outside of the box the clip makes the weights constant; a slope there would pull Gaussians into the box.
        inside = (np.abs(distance) < 1) & (fraction > 0) & (fraction < 1)
        hats.append(np.maximum(1 - np.abs(distance), 0).astype(np.float32))
        slope = -np.sign(distance) * inside * (count - 1) / sizes_m[:, k, None]
        hat_slopes.append(slope.astype(np.float32))

    def product(x: Float32, y: Float32, z: Float32) -> Float32:
        lattice = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
        return lattice.reshape(len(positions), -1)

    x, y, z = hats
    dx, dy, dz = hat_slopes
    slopes = np.stack([product(dx, y, z), product(x, dy, z), product(x, y, dz)], -1)
    return product(x, y, z), slopes
