"""What the learned optimiser is told about each Gaussian in each iteration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from genre_tasks.optimiser.kernels.constants import SHARE_FLOOR_PX, VARYING
from genre_tasks.optimiser.state import GROUPS, Frame, State
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR

TIMES = 4
FEATURES = VARYING + TIMES
RESIDUAL_SCALE = 5.0
USUAL_ITERATIONS = 24
"""T as a feature is the octaves from here."""


@dataclass(frozen=True)
class Fixed:
    """Features that do not change over the iterations: [N, 4] unit, distance, and whether distant or an actor."""

    columns: Tensor

    @staticmethod
    def of(frame: Frame, centre: Tensor) -> Fixed:
        """``centre`` [3]: the mean camera position; actors' distances are taken as 10 m, since they move."""
        scene = frame.scene
        actor, distant = scene.nodes >= FIRST_ACTOR, scene.nodes == DISTANT
        distance = (scene.gaussians.means - centre).norm(dim=1)
        distance = torch.where(actor, torch.full_like(distance, 10.0), distance)
        columns = [
            frame.unit.log() / 2,
            (distance[:, None] + 1).log() / 2 - 1.5,
            distant[:, None].float(),
            actor[:, None].float(),
        ]
        return Fixed(torch.cat(columns, 1))


def features(
    frame: Frame,
    fixed: Fixed,
    state: State,
    gradient: Tensor,  # [N, 14]
    total: int,
) -> Tensor:  # [N, FEATURES], with residuals [N, FEATURES + 5]
    """Direction, latest gradient and its usual size, the Gaussian itself, what saw it, t / T and T; all of order 1.

    Where the state has residuals, before t / T: their mean over the pixels that show the Gaussian, their root mean
    square and how many pixels that are. Gradients say where to go; these say how far it is.

    Gradients enter detached and normalised (no second derivative of the renderer, paper Sec. III-C): a loss scaled by
    any factor gives the same features.
    """
    deviation = state.deviation()
    seen = (state.seen > 0).to(deviation.dtype)
    share = seen.sum().clamp_min(1)
    usual = [((deviation[:, a:b].square() * seen).sum() / (share * (b - a))).sqrt() for a, b in GROUPS.values()]
    usual_row = torch.cat([u.expand(b - a) for u, (a, b) in zip(usual, GROUPS.values(), strict=True)])
    size = torch.log10((deviation / (usual_row + 1e-30)).clamp(1e-4, 1e4)) / 2
    start, offsets = frame.scene.gaussians, state.offsets
    time = offsets.new_tensor(times(state.iteration, total))
    columns = [
        state.direction().clamp(-4, 4),
        (gradient / deviation).clamp(-4, 4) / 2,
        size * seen,
        (offsets[:, 0:3] / 3).clamp(-3, 3),
        ((start.log_scales + offsets[:, 3:6] - frame.unit.log()) / 2).clamp(-3, 3),
        torch.nn.functional.normalize(start.quats + offsets[:, 6:10], dim=1),
        (start.logit_opacities[:, None] + offsets[:, 10:11]) / 4,
        start.colors + offsets[:, 11:14] - 0.5,
        fixed.columns,
        state.seen_now,
        torch.log1p(state.seen) / 3,
        *_of_residuals(state),
        time.expand(len(offsets), TIMES),
    ]
    return torch.cat(columns, 1).detach()


def _of_residuals(state: State) -> list[Tensor]:
    if state.residuals is None:
        return []
    square, share = state.residuals[:, 3:4], state.residuals[:, 4:5]
    spread = (square / (share + SHARE_FLOOR_PX)).sqrt()
    return [
        (RESIDUAL_SCALE * state.mean_residual()).clamp(-2, 2),
        (RESIDUAL_SCALE * spread).clamp(0, 4),
        torch.log1p(share) / 4,
    ]


def times(iteration: int, total: int) -> list[float]:
    """The last features, the same for all Gaussians: of t / T, of t and of T."""
    part = min(iteration / total, 1.0)
    octaves = math.log2(total / USUAL_ITERATIONS)
    return [part, (1 - part) ** 2, min(iteration, 4) / 4, octaves / 4]
