"""The network of GNet and ENet (paper Sec. III-C, III-D): a head per Gaussian over a sparse UNet, and its step.

The step is ``Δ = −rate · schedule(t/T) · [exp(3 tanh(a/3)) · u + tanh(b)]`` with ``u`` Adam's normalised direction and
``a, b`` [N, 14] from the network, whose last layer starts at zero: untrained, it is tuned Adam to the bit.

A network with ``residuals`` also moves colours by ``schedule(t/T) · (1 + tanh(c₀ + c)) · r̄``, with r̄ the mean residual
of the pixels that show a Gaussian, c₀ of the configuration and ``c`` [N] from the network: a step of the simultaneous
algebraic reconstruction technique (Andersen and Kak 1984) with a relaxation of 0 to 2, where it converges.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from genre_tasks.learned.features import FEATURES
from genre_tasks.learned.sparse_unet import SparseUNet, VoxelPyramid
from genre_tasks.learned.voxel_pooling import voxel_pyramid
from genre_tasks.optimiser.kernels.constants import RESIDUALS
from genre_tasks.optimiser.state import GROUPS, Frame, State
from genre_tasks.optimiser.step_rules import rate_vector, schedule
from genre_tasks.optimiser.tuned_adam import GNET_RATES


class NetworkConfig(BaseModel):
    """The network's shape and the rates that it scales; stored as JSON beside the weights."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    hidden: int = Field(default=64, ge=4, le=512, description="Width of the head per Gaussian.")
    channels: tuple[int, ...] = Field(default=(16, 32, 48), min_length=1, description="Channels of the UNet's levels.")
    voxel_m: float = Field(default=1.0, gt=0, description="Width of a static voxel near the cameras.")
    residuals: bool = Field(default=False, description="It is told what images have beyond the render.")
    relaxation: float = Field(default=0.0, allow_inf_nan=False, description="Of residuals, c₀: 0 is a relaxation of 1.")
    rates: tuple[float, ...] = Field(
        default=GNET_RATES, min_length=len(GROUPS), max_length=len(GROUPS), description="As TunedAdam's."
    )


class LearnedNetwork(nn.Module):
    """Weights shared over iterations and Gaussians, and the step that they make, differentiable in them."""

    def __init__(self, config: NetworkConfig | None = None) -> None:
        super().__init__()
        self.config = config or NetworkConfig()
        hidden, channels = self.config.hidden, self.config.channels
        self.residuals = self.config.residuals
        self.entry = nn.Linear(FEATURES + (RESIDUALS if self.residuals else 0), hidden)
        self.unet = SparseUNet(hidden, channels)
        self.mix = nn.Linear(hidden + channels[0], hidden)
        self.head = nn.Linear(hidden, 29 if self.residuals else 28)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(
        self,
        inputs: Tensor,  # [M, FEATURES], or with residuals
        pyramid: VoxelPyramid,
        points: Tensor,  # [M]
    ) -> Tensor:
        """Of the ``points`` [M, 28 or 29]: log-gains a, offsets b, c; the others are as if they were not there."""
        own = F.silu(self.entry(inputs))
        pooled, _ = pyramid.pool(own, points)
        return self._heads(own, self.unet(pooled, pyramid), pyramid.voxel_of[points])

    def _heads(self, own: Tensor, around: Tensor, voxel: Tensor) -> Tensor:
        both = torch.cat([own, around.index_select(0, voxel)], 1)
        heads: Tensor = self.head(F.silu(self.mix(both)))
        return heads

    def pyramid(self, frame: Frame, centre: Tensor) -> VoxelPyramid:
        """The voxels of a scene at its start; they serve all iterations."""
        return voxel_pyramid(frame.scene, centre, self.config.voxel_m, len(self.config.channels))

    def delta(self, state: State, inputs: Tensor, pyramid: VoxelPyramid, total: int) -> Tensor:
        """The step [N, 14], differentiable in the network's weights; 0 where ``state.seen_now`` is."""
        seen = state.seen_now[:, 0].nonzero()[:, 0]
        step = self._step(self(inputs[seen], pyramid, seen), state, seen, schedule(state.iteration, total))
        return step.new_zeros(state.offsets.shape).index_copy(0, seen, step)

    def _step(self, heads: Tensor, state: State, rows: Tensor, part: float) -> Tensor:
        """Of the Gaussians ``rows`` [M], from their heads."""
        direction = state.direction()[rows]
        gain, offset = heads[:, :14], heads[:, 14:28]
        rates = rate_vector(self.config.rates).to(direction.device)
        step = -rates * part * (torch.exp(3 * torch.tanh(gain / 3)) * direction + torch.tanh(offset))
        if self.residuals:
            relaxation = 1 + torch.tanh(self.config.relaxation + heads[:, 28:])
            relaxed = part * relaxation * state.mean_residual()[rows]
            step = step + F.pad(relaxed, (11, 0))
        return step

    def sampled_delta(self, state: State, inputs: Tensor, pyramid: VoxelPyramid, total: int, rows: Tensor) -> Tensor:
        """The rows ``rows`` [M] of :meth:`delta`, differentiable through these Gaussians alone.

        What the others pool into the voxels has the right value but no gradient; that of the rows counts N / M times,
        so that over random rows the gradient in the weights of a sum is right on average.
        """
        now = state.seen_now[:, 0]
        with torch.no_grad():
            seen = now.nonzero()[:, 0]
            everyone, counts = pyramid.pool(F.silu(self.entry(inputs[seen])), seen)
        place = now[rows].nonzero()[:, 0]
        part = rows[place]
        own = F.silu(self.entry(inputs[part]))
        voxel = pyramid.voxel_of[part]
        change = torch.zeros_like(everyone).index_add(0, voxel, own - own.detach()) / counts
        around = self.unet(everyone + change * (len(inputs) / len(rows)), pyramid)
        step = self._step(self._heads(own, around, voxel), state, part, schedule(state.iteration, total))
        return step.new_zeros((len(rows), 14)).index_copy(0, place, step)
