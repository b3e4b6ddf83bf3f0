"""The network of GNet and ENet (paper Sec. III-C, III-D): a head for each Gaussian over a sparse UNet, and its step.

The step is ``Δ = −rate · schedule(t/T) · [exp(3 tanh(a/3)) · u + tanh(b)]``. Here ``u`` is Adam's normalised direction,
and ``a, b`` [N, 14] come from the network. Its last layer starts at zero: untrained, and without the ``residuals``
below, it is tuned Adam to the bit.

A network with ``residuals`` also moves colours by ``schedule(t/T) · (1 + tanh(c₀ + c)) · r̄``, untrained too. Here r̄
is the mean residual of the pixels that show a Gaussian, c₀ comes from the configuration, and ``c`` [N] from the
network. This is a step of the simultaneous algebraic reconstruction technique (Andersen and Kak 1984), which converges
for a relaxation between 0 and 2.
"""

from __future__ import annotations

from typing import Annotated

import torch
import torch.nn.functional as F
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from genre_tasks.learned.features import FEATURE_COUNT
from genre_tasks.learned.sparse_unet import SparseUNet, VoxelPyramid
from genre_tasks.learned.voxel_pooling import build_voxel_pyramid
from genre_tasks.optimiser.kernels.constants import IMAGE_RESIDUALS
from genre_tasks.optimiser.state import ATTRIBUTE_COLUMNS, Parameterization, State
from genre_tasks.optimiser.step_rules import cosine_decay, expand_learning_rates
from genre_tasks.optimiser.tuned_adam import GNET_LEARNING_RATES


class NetworkConfig(BaseModel):
    """The network's shape and the learning rates that it scales; stored as JSON beside the weights."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    hidden: int = Field(default=64, ge=4, le=512, description="Width of the head for each Gaussian.")
    channels: tuple[Annotated[int, Field(ge=1, le=512)], ...] = Field(
        default=(16, 32, 48), min_length=1, max_length=8, description="Channels of the UNet's levels, finest first."
    )
    voxel_m: float = Field(default=1.0, gt=0, description="Width of a static voxel near the cameras, metres.")
    residuals: bool = Field(
        default=False, description="Whether the network uses image residuals and moves colours by them."
    )
    relaxation: float = Field(default=0.0, description="c₀: residuals move colours by 1 + tanh(c₀) of themselves.")
    rates: tuple[float, ...] = Field(
        default=GNET_LEARNING_RATES.as_tuple(),
        min_length=len(ATTRIBUTE_COLUMNS),
        max_length=len(ATTRIBUTE_COLUMNS),
        description="Learning rates of means, log-scales, quaternions, logit opacities and colours.",
    )


class LearnedNetwork(nn.Module):
    """The network's weights, shared over iterations and Gaussians, and the step that they make.

    The step is differentiable in the weights.

    Args:
        config: shape and learning rates; ``None``: the defaults.
    """

    def __init__(self, config: NetworkConfig | None = None) -> None:
        super().__init__()
        self.config = config or NetworkConfig()
        self.uses_image_residuals = self.config.residuals
        hidden = self.config.hidden
        channels = self.config.channels
        self.entry = nn.Linear(FEATURE_COUNT + (IMAGE_RESIDUALS if self.uses_image_residuals else 0), hidden)
        self.unet = SparseUNet(hidden, channels)
        self.mix = nn.Linear(hidden + channels[0], hidden)
        self.head = nn.Linear(hidden, 29 if self.uses_image_residuals else 28)
        # Zero outputs make the untrained step that of tuned Adam, besides what residuals add: training starts there.
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(
        self,
        inputs: Tensor,  # [M, FEATURE_COUNT], with residuals [M, FEATURE_COUNT + 5]
        pyramid: VoxelPyramid,
        points: Tensor,  # [M]
    ) -> Tensor:
        """Computes the outputs for some Gaussians, as if the others did not exist.

        Args:
            inputs: their features.
            pyramid: the voxels of all Gaussians of the scene.
            points: which Gaussians these are.

        Returns:
            [M, 28] log gains a and offsets b; with residuals [M, 29], c last.
        """
        embedded = F.silu(self.entry(inputs))
        # Only these Gaussians are pooled: those that no view shows must not change the step.
        pooled, _ = pyramid.pool(embedded, points)
        return self._run_head(embedded, self.unet(pooled, pyramid), pyramid.voxel_of[points])

    def pyramid(self, parameterization: Parameterization, centre: Tensor) -> VoxelPyramid:
        """Sorts a scene's Gaussians into voxels, which serve all iterations.

        Args:
            parameterization: the scene at its start.
            centre: [3] the mean camera position in chunk coordinates, metres.
        """
        return build_voxel_pyramid(parameterization.scene, centre, self.config.voxel_m, len(self.config.channels))

    def delta(self, state: State, inputs: Tensor, pyramid: VoxelPyramid, total: int) -> Tensor:
        """Computes the step of all Gaussians, differentiable in the network's weights.

        Args:
            state: what was optimised so far, with this iteration's gradient taken in.
            inputs: [N, FEATURE_COUNT], with residuals [N, FEATURE_COUNT + 5]: the features.
            pyramid: the scene's voxels.
            total: number of iterations of the run.

        Returns:
            [N, 14] change of the offsets; 0 for a Gaussian that no view of this iteration shows.
        """
        # Others have no fresh gradient: momentum alone would keep moving them.
        visible = state.visible[:, 0].nonzero()[:, 0]
        outputs = self(inputs[visible], pyramid, visible)
        step = self._step(outputs, state, visible, cosine_decay(state.iteration, total))
        return step.new_zeros(state.offsets.shape).index_copy(0, visible, step)

    def sampled_delta(self, state: State, inputs: Tensor, pyramid: VoxelPyramid, total: int, rows: Tensor) -> Tensor:
        """Computes the step of some Gaussians, differentiable through these alone: training needs less memory.

        What the other Gaussians pool into the voxels has the right value but no gradient. The gradient of the sampled
        ones counts N / M times instead, so that over random samples the gradient of a sum is right on average.

        Args:
            state: as in :meth:`delta`.
            inputs: [N, …] features of all Gaussians.
            pyramid: the scene's voxels.
            total: number of iterations of the run.
            rows: [M] which Gaussians.

        Returns:
            [M, 14] change of their offsets.
        """
        visible_mask = state.visible[:, 0]
        with torch.no_grad():
            visible = visible_mask.nonzero()[:, 0]
            pooled, counts = pyramid.pool(F.silu(self.entry(inputs[visible])), visible)
        positions = visible_mask[rows].nonzero()[:, 0]
        sampled = rows[positions]
        embedded = F.silu(self.entry(inputs[sampled]))
        voxel = pyramid.voxel_of[sampled]
        # A difference of equal values: it is zero, and carries the gradient of the sampled Gaussians into the pooling.
        change = torch.zeros_like(pooled).index_add(0, voxel, embedded - embedded.detach()) / counts
        context = self.unet(pooled + change * (len(inputs) / len(rows)), pyramid)
        outputs = self._run_head(embedded, context, voxel)
        step = self._step(outputs, state, sampled, cosine_decay(state.iteration, total))
        return step.new_zeros((len(rows), 14)).index_copy(0, positions, step)

    def _run_head(self, embedded: Tensor, context: Tensor, voxel: Tensor) -> Tensor:
        """Outputs of M Gaussians from their own embedding and from their voxels' context."""
        both = torch.cat([embedded, context.index_select(0, voxel)], 1)
        outputs: Tensor = self.head(F.silu(self.mix(both)))
        return outputs

    def _step(self, outputs: Tensor, state: State, rows: Tensor, lr_scale: float) -> Tensor:
        """[M, 14] steps of the Gaussians ``rows`` from their outputs."""
        direction = state.adam_direction()[rows]
        log_gain = outputs[:, :14]
        offset = outputs[:, 14:28]
        rates = expand_learning_rates(self.config.rates).to(direction.device)
        # Bounded on purpose: a factor of 1/20 to 20 on Adam's direction, and an offset of one learning rate.
        step = -rates * lr_scale * (torch.exp(3 * torch.tanh(log_gain / 3)) * direction + torch.tanh(offset))
        if self.uses_image_residuals:
            # Between 0 and 2, where the algebraic reconstruction converges.
            relaxation = 1 + torch.tanh(self.config.relaxation + outputs[:, 28:])
            color_step = lr_scale * relaxation * state.mean_residual_rgb()[rows]
            # Colours are the last three of the 14 attributes.
            step = step + F.pad(color_step, (11, 0))
        return step
