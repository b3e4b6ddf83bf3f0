"""What the learned optimiser knows about each Gaussian in each iteration: the inputs of its network."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from genre_tasks.optimiser.kernels.constants import VARYING_FEATURES, WEIGHT_FLOOR_PX
from genre_tasks.optimiser.state import ATTRIBUTE_COLUMNS, Parameterization, State
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR

SCHEDULE_FEATURE_COUNT = 4
"""Features of the iteration, which are the same for all Gaussians."""

FEATURE_COUNT = VARYING_FEATURES + SCHEDULE_FEATURE_COUNT
"""Features of a network that does not use image residuals; with them there are ``IMAGE_RESIDUALS`` more."""

RESIDUAL_SCALE = 5.0
"""Brings residuals of sRGB colours, usually below 0.2, to order 1."""

REFERENCE_ITERATIONS = 24
"""The number of iterations T enters as octaves above or below this one."""

ACTOR_DISTANCE_M = 10.0
"""Distance from the cameras that every Gaussian of an actor counts with, as actors move."""


@dataclass(frozen=True)
class StaticFeatures:
    """The features that do not change over the iterations.

    Attributes:
        columns: [N, 4] logarithm of the unit of length, logarithm of the distance from the cameras, whether a Gaussian
            belongs to the distant region, and whether it belongs to an actor.
    """

    columns: Tensor

    @staticmethod
    def compute(parameterization: Parameterization, centre: Tensor) -> StaticFeatures:
        """Computes the features from a scene at its start.

        Args:
            parameterization: the scene with N Gaussians and their units of length.
            centre: [3] the mean camera position in chunk coordinates, metres.
        """
        scene = parameterization.scene
        actor = scene.nodes >= FIRST_ACTOR
        distant = scene.nodes == DISTANT
        distance = (scene.gaussians.means - centre).norm(dim=1)
        # An actor moves: its distance at one moment would tell the network nothing.
        distance = torch.where(actor, torch.full_like(distance, ACTOR_DISTANCE_M), distance)
        columns = [
            # Logarithms, since lengths in a scene span several orders of magnitude.
            parameterization.unit_m.log() / 2,
            (distance[:, None] + 1).log() / 2 - 1.5,
            distant[:, None].float(),
            actor[:, None].float(),
        ]
        return StaticFeatures(torch.cat(columns, 1))


def compute_features(
    parameterization: Parameterization,
    static_features: StaticFeatures,
    state: State,
    gradient: Tensor,  # [N, 14]
    total: int,
) -> Tensor:  # [N, FEATURE_COUNT], with residuals [N, FEATURE_COUNT + 5]
    """Computes the inputs of the network, all of order 1.

    They are Adam's direction, the latest gradient and its usual size, the Gaussian itself, how often views reached it,
    and the place in the schedule. With image residuals there are also their mean over the pixels that show the
    Gaussian, their root mean square, and the number of these pixels. Gradients say where to go; residuals say how far
    it is.

    Gradients are normalised, so that a loss scaled by any factor gives the same features. They are also detached: the
    renderer's second derivative is never needed (paper Sec. III-C).

    Args:
        parameterization: the scene at its start.
        static_features: the features that do not change.
        state: what was optimised so far, with this iteration's gradient taken in.
        gradient: this iteration's gradient with respect to the offsets.
        total: number of iterations T of the run.

    Returns:
        One row for each Gaussian, without a gradient.
    """
    deviation = state.rms_gradient()
    visited = (state.visit_count > 0).to(deviation.dtype)
    visited_count = visited.sum().clamp_min(1)
    # The size of a Gaussian's gradient only means something next to the usual one of the same attribute.
    usual_sizes = []
    for start, end in ATTRIBUTE_COLUMNS.values():
        mean_square = (deviation[:, start:end].square() * visited).sum() / (visited_count * (end - start))
        usual_sizes.append(mean_square.sqrt().expand(end - start))
    relative_size = torch.log10((deviation / (torch.cat(usual_sizes) + 1e-30)).clamp(1e-4, 1e4)) / 2
    initial = parameterization.scene.gaussians
    offsets = state.offsets
    schedule = offsets.new_tensor(schedule_features(state.iteration, total))
    # Shipped weights depend on this order, and so does the compiled kernel, see kernels/features.h.
    columns = [
        state.adam_direction().clamp(-4, 4),
        (gradient / deviation).clamp(-4, 4) / 2,
        relative_size * visited,
        (offsets[:, 0:3] / 3).clamp(-3, 3),
        ((initial.log_scales + offsets[:, 3:6] - parameterization.unit_m.log()) / 2).clamp(-3, 3),
        torch.nn.functional.normalize(initial.quats + offsets[:, 6:10], dim=1),
        (initial.logit_opacities[:, None] + offsets[:, 10:11]) / 4,
        initial.colors + offsets[:, 11:14] - 0.5,
        static_features.columns,
        state.visible,
        torch.log1p(state.visit_count) / 3,
        *_residual_features(state),
        schedule.expand(len(offsets), SCHEDULE_FEATURE_COUNT),
    ]
    return torch.cat(columns, 1).detach()


def schedule_features(iteration: int, total: int) -> list[float]:
    """Computes the features of the place in the schedule, which are the same for all Gaussians.

    Args:
        iteration: number of the iteration t, from 0; it may pass ``total``.
        total: number of iterations T of the run.

    Returns:
        t / T, its square from the end, the first iterations, and T itself in octaves.

    >>> schedule_features(0, 24)
    [0.0, 1.0, 0.0, 0.0]
    """
    # More iterations than planned stay at the end of the schedule.
    fraction = min(iteration / total, 1.0)
    octaves = math.log2(total / REFERENCE_ITERATIONS)
    return [fraction, (1 - fraction) ** 2, min(iteration, 4) / 4, octaves / 4]


def _residual_features(state: State) -> list[Tensor]:
    if state.image_residuals is None:
        return []
    weighted_square = state.image_residuals[:, 3:4]
    total_weight = state.image_residuals[:, 4:5]
    # The floor, in pixels, keeps a Gaussian that hardly shows from having large residuals.
    root_mean_square = (weighted_square / (total_weight + WEIGHT_FLOOR_PX)).sqrt()
    return [
        (RESIDUAL_SCALE * state.mean_residual_rgb()).clamp(-2, 2),
        (RESIDUAL_SCALE * root_mean_square).clamp(0, 4),
        torch.log1p(total_weight) / 4,
    ]
