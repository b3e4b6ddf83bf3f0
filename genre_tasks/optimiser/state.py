"""What is optimised, and what is carried from iteration to iteration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from genre_tasks.optimiser.ground_constraint import along_ground, ground_planes
from genre_tasks.optimiser.kernels import state_update
from genre_tasks.optimiser.kernels.constants import DEVIATION_FLOOR, SHARE_FLOOR_PX
from genre_tasks.optimiser.kernels.posing import Posing
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, SceneGraph

GROUPS = {"means": (0, 3), "log_scales": (3, 6), "quats": (6, 10), "logit_opacities": (10, 11), "colors": (11, 14)}
"""Columns of the 14 attributes, in the order of ``Gaussians.packed``."""

FIRST_DECAY, SECOND_DECAY = 0.9, 0.99

MIN_UNIT_M, MAX_UNIT_M = 0.005, 50.0
LOG_SCALE_BOUNDS, DISTANT_LOG_SCALE_BOUNDS = (-8.0, 1.0986), (-8.0, 4.6)
"""ln metres: 0.3 mm to 3 m near, to 100 m in the distant region. What starts outside stays where it started."""
GROWTH = 8.0
"""No side grows beyond so many times the longest one at the start. A spike along a car's outline, thin in every source
view and twenty times as long as it began, is a fog over the whole image of a camera that it passes beside the path."""
LOGIT_BOUND = 9.0
COLOR_BOUNDS = (-0.5, 1.5)


@dataclass(frozen=True)
class Frame:
    """The fixed frame of an unrolled optimisation: the scene at its start, and the unit of each Gaussian's mean.

    ``unit`` [N, 1] metres: the median of the three initial scales (for a disc its radius), bounded. In these units
    the distant shell and a lane marking share one rate. ``planes`` [N, 11]: see ``ground.ground_planes``.
    """

    scene: SceneGraph
    unit: Tensor
    low: Tensor  # [N, 14] bounds of the packed attributes
    high: Tensor  # [N, 14]
    planes: Tensor

    @staticmethod
    def of(scene: SceneGraph, constrain_ground: bool = True) -> Frame:
        """From the scene at the start; ``constrain_ground``: steps keep what lies on the ground in its plane."""
        start = scene.gaussians.packed()
        unit = scene.gaussians.log_scales.median(1).values.exp().clamp(MIN_UNIT_M, MAX_UNIT_M)[:, None]
        low, high = torch.full_like(start, -torch.inf), torch.full_like(start, torch.inf)
        distant = (scene.nodes == DISTANT)[:, None]
        for bound, near, far in zip((low, high), LOG_SCALE_BOUNDS, DISTANT_LOG_SCALE_BOUNDS, strict=True):
            bound[:, 3:6] = torch.where(distant, far, near)
        longest = scene.gaussians.log_scales.max(1, keepdim=True).values
        high[:, 3:6] = torch.minimum(high[:, 3:6], longest + math.log(GROWTH))
        low[:, 10], high[:, 10] = -LOGIT_BOUND, LOGIT_BOUND
        low[:, 11:14], high[:, 11:14] = COLOR_BOUNDS
        planes = ground_planes(scene) if constrain_ground else start.new_zeros((len(start), 11))
        return Frame(scene, unit, torch.minimum(low, start), torch.maximum(high, start), planes)

    @cached_property
    def start(self) -> Tensor:
        """[N, 14] the attributes at the start."""
        return self.scene.gaussians.packed()

    @cached_property
    def posing(self) -> Posing:
        """What the compiled way from offsets to splats keeps over the iterations; float32 on the CPU only."""
        return Posing(self.scene, self.start.detach(), self.unit.detach())

    def gaussians(self, offsets: Tensor) -> Gaussians:
        """The Gaussians at ``offsets`` [N, 14] from the start: means in units, all else in raw space."""
        start = self.scene.gaussians
        move = Gaussians.unpacked(offsets)
        return Gaussians(
            start.means + move.means * self.unit,
            start.log_scales + move.log_scales,
            start.quats + move.quats,
            start.logit_opacities + move.logit_opacities,
            start.colors + move.colors,
        )

    def bounded(self, offsets: Tensor) -> Tensor:
        """Offsets held inside the bounds; those inside stay the same bytes."""
        start = self.start
        clamped = torch.minimum(torch.maximum(start + offsets, self.low), self.high)
        outside = (start + offsets != clamped) & (self.low > -torch.inf)
        return torch.where(outside, clamped - start, offsets)


@dataclass(frozen=True)
class State:
    """``offsets`` [N, 14]; moments of the gradient over the iterations that saw a Gaussian; how many those are.

    ``seen_now`` [N, 1] is 1 where the latest gradient is not zero, ``seen`` [N, 1] counts those iterations.
    ``residuals`` [N, 5]: of the latest iteration, as a ``Pass`` has them, where the rule asks for them.
    """

    offsets: Tensor
    first: Tensor  # [N, 14]
    second: Tensor  # [N, 14]
    seen: Tensor  # [N, 1]
    seen_now: Tensor  # [N, 1]
    iteration: int = 0
    residuals: Tensor | None = None

    @staticmethod
    def start(count: int, like: Tensor) -> State:
        """Nothing moved, nothing seen."""
        zeros, column = like.new_zeros((count, 14)), like.new_zeros((count, 1))
        return State(zeros, zeros, zeros, column, column)

    def saw(self, gradient: Tensor, residuals: Tensor | None = None) -> State:
        """With this iteration's gradient [N, 14] with respect to ``offsets`` taken into the moments; its residuals."""
        if state_update.fits(gradient, self.first, self.second, self.seen):
            decays = (FIRST_DECAY, SECOND_DECAY)
            first, second, seen, now = state_update.saw(gradient, self.first, self.second, self.seen, decays)
            return replace(self, first=first, second=second, seen=seen, seen_now=now, residuals=residuals)
        now = (gradient != 0).any(1, keepdim=True).to(gradient.dtype)
        first = self.first + now * (1 - FIRST_DECAY) * (gradient - self.first)
        second = self.second + now * (1 - SECOND_DECAY) * (gradient * gradient - self.second)
        seen = self.seen + now
        return replace(self, first=first, second=second, seen=seen, seen_now=now, residuals=residuals)

    def moved(self, frame: Frame, delta: Tensor) -> State:
        """With ``delta`` [N, 14] applied to what this iteration's views saw, in the ground's plane where it lies there.

        The rest stays the same bytes.

        A direction kept from earlier views would lead on and on what nothing corrects.
        """
        fixed = frame.start, frame.low, frame.high, frame.planes
        if state_update.fits(self.offsets, delta, self.seen_now, *fixed):
            offsets = state_update.moved(self.offsets, delta, self.seen_now, *fixed)
            return replace(self, offsets=offsets, iteration=self.iteration + 1)
        delta = along_ground(delta, frame.planes)
        offsets = torch.where(self.seen_now > 0, frame.bounded(self.offsets + delta), self.offsets)
        return replace(self, offsets=offsets, iteration=self.iteration + 1)

    def recoloured(self, shift: Tensor) -> State:
        """With the colours' offsets moved by ``shift`` [N, 3]."""
        offsets = self.offsets.clone()
        offsets[:, 11:14] += shift
        return replace(self, offsets=offsets)

    def deviation(self) -> Tensor:
        """Root of the unbiased second moment, [N, 14], > 0."""
        return (self.second / (1 - SECOND_DECAY ** self.seen.clamp_min(1))).sqrt() + DEVIATION_FLOOR

    def direction(self) -> Tensor:
        """Adam's normalised step, [N, 14], of order 1; exactly 0 where nothing has been seen."""
        return (self.first / (1 - FIRST_DECAY ** self.seen.clamp_min(1)) / self.deviation()).clamp(-6.0, 6.0)

    def mean_residual(self) -> Tensor:
        """[N, 3] over the pixels that show a Gaussian, by its share of them; towards 0 below a pixel in all."""
        assert self.residuals is not None
        return self.residuals[:, :3] / (self.residuals[:, 4:] + SHARE_FLOOR_PX)
