"""The learned optimiser's step as one compiled call, for inference on the CPU.

``LearnedNetwork.delta`` with :func:`genre_tasks.learned.features.compute_features` defines the step; the tests hold
the kernel against it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.learned.features import SCHEDULE_FEATURE_COUNT, StaticFeatures, schedule_features
from genre_tasks.learned.kernel_layers import (
    LANES,
    IndexGroups,
    KernelMemory,
    LayerProgram,
    PairsByOutput,
    pad_with_zeros,
    round_up,
)
from genre_tasks.learned.network import LearnedNetwork
from genre_tasks.learned.sparse_unet import VoxelPyramid
from genre_tasks.optimiser.kernel_steps import learned_step
from genre_tasks.optimiser.kernels.constants import BLOCK_GAUSSIANS
from genre_tasks.optimiser.kernels.library import Network, Scene
from genre_tasks.optimiser.state import Parameterization, State
from genre_tasks.optimiser.step_rules import cosine_decay, expand_learning_rates


class KernelStep:
    """The step of one scene, computed by the compiled kernel in float32 on the CPU.

    It runs on ``torch.get_num_threads()`` threads; the bits do not depend on their number.

    Args:
        network: its weights are taken as they are now; later changes have no effect.
        parameterization: the scene at its start.
        static_features: the features that do not change over the iterations.
        pyramid: the scene's voxels.
    """

    def __init__(
        self,
        network: LearnedNetwork,
        parameterization: Parameterization,
        static_features: StaticFeatures,
        pyramid: VoxelPyramid,
    ) -> None:
        self._memory = KernelMemory()
        # Negative once and for all: steps go against the gradient.
        self._rates = -expand_learning_rates(network.config.rates)
        self._count = len(pyramid.voxel_of)
        self._residuals = network.uses_image_residuals
        # Two vectors at a time: the head's gains and its offsets.
        hidden = round_up(network.config.hidden, 2 * LANES)
        self._network = _dense_layers(network, hidden, self._memory)
        self._scene = _scene_memory(network, hidden, parameterization, static_features, pyramid, self._memory)

    def __call__(self, state: State, gradient: Tensor, total: int) -> Tensor:
        """Computes the change of the offsets; see :class:`genre_tasks.optimiser.step_rules.StepFunction`.

        Args:
            state: what was optimised so far, with this iteration's gradient taken in.
            gradient: [N, 14] this iteration's gradient.
            total: number of iterations of the run.

        Returns:
            [N, 14]; 0 for a Gaussian that no view of this iteration shows.

        Raises:
            ValueError: the tensors belong to another scene, are not float32 on the CPU, or lack residuals.
            ResourceError: the kernel is not compiled, or memory is short.
        """
        if len(gradient) != self._count:
            raise ValueError(f"expected the gradient of {self._count} Gaussians, got {len(gradient)}")
        if (state.image_residuals is None) == self._residuals:
            raise ValueError(f"expected a state {'with' if self._residuals else 'without'} residuals")
        lr_scale = cosine_decay(state.iteration, total)
        time_features = torch.tensor(schedule_features(state.iteration, total))
        return learned_step(
            self._network, self._scene, state, gradient, self._rates * lr_scale, time_features, lr_scale
        )


def _dense_layers(network: LearnedNetwork, hidden: int, memory: KernelMemory) -> Network:
    """The layers that each Gaussian has on its own, padded to ``hidden`` channels."""
    entry = network.entry
    head = network.head
    # The mixing layer takes the Gaussian's own embedding first, then its voxel's context.
    own_part_of_mix = network.mix.weight[:, : network.config.hidden].T
    # Gains and offsets have a row of lanes each, so that the kernel reads both with one load.
    column = torch.cat([torch.arange(14), LANES + torch.arange(14)])
    if network.uses_image_residuals:
        column = torch.cat([column, torch.tensor([14])])  # in a free lane after the gains
    weight = torch.zeros(hidden, 2 * LANES)
    weight[: head.in_features, column] = head.weight.detach().T
    bias = torch.zeros(2 * LANES)
    bias[column] = head.bias.detach()
    # c₀ of the configuration is a bias to c, which saves the kernel an argument.
    bias[14] += network.config.relaxation
    return Network(
        hidden,
        entry.in_features - SCHEDULE_FEATURE_COUNT,
        memory.address(pad_with_zeros(entry.weight.T, entry.in_features, hidden)),
        memory.address(pad_with_zeros(entry.bias, hidden)),
        memory.address(pad_with_zeros(own_part_of_mix, hidden, hidden)),
        memory.address(weight),
        memory.address(bias),
    )


def _scene_memory(
    network: LearnedNetwork,
    hidden: int,
    parameterization: Parameterization,
    static_features: StaticFeatures,
    pyramid: VoxelPyramid,
    memory: KernelMemory,
) -> Scene:
    """What stays over the iterations, and the memory to work in."""
    voxels = pyramid.count
    count = len(pyramid.voxel_of)
    pooled = torch.zeros(voxels, hidden)
    layers = LayerProgram(memory)
    # What the mixing layer adds for the context is the same for all Gaussians of a voxel: a layer of voxels does it.
    context_part_of_mix = network.mix.weight[:, network.config.hidden :].T[None]
    context = layers.add(
        layers.add_unet(network.unet, pooled, pyramid),
        context_part_of_mix,
        network.mix.bias,
        PairsByOutput.identity(voxels),
        multiple=2 * LANES,
        activated=False,
    )
    points = IndexGroups.from_labels(pyramid.voxel_of, voxels)
    program = layers.as_array()
    address = memory.address
    return Scene(
        voxels,
        address(_feature_base(parameterization)),
        address(static_features.columns),
        address(pyramid.voxel_of.int()),
        address(points.starts),
        address(points.order),
        address(torch.zeros(count, dtype=torch.int32)),  # room for the visible Gaussians
        address(torch.zeros(count, dtype=torch.int32)),  # room for each one's place among them
        address(torch.zeros(round_up(count, BLOCK_GAUSSIANS), hidden)),  # room for each Gaussian's embedding
        address(pooled),
        address(context),
        program,
        len(program),
    )


def _feature_base(parameterization: Parameterization) -> Tensor:
    """[N, 14] what the offsets are added to in the features."""
    initial = parameterization.scene.gaussians
    columns = [
        torch.zeros_like(initial.means),
        initial.log_scales - parameterization.unit_m.log(),
        initial.quats,
        initial.logit_opacities[:, None],
        initial.colors - 0.5,
    ]
    return torch.cat(columns, 1)
