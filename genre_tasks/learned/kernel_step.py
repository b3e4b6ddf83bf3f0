"""The learned optimiser's step as one compiled call, for inference on the CPU.

``LearnedNetwork.delta`` with :func:`genre_tasks.learned.features.features` defines the step and is its oracle.
"""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.learned.features import TIMES, Fixed, times
from genre_tasks.learned.kernel_layers import LANES, ByOwner, Layers, Memory, Pairs, padded, round_up
from genre_tasks.learned.network import LearnedNetwork
from genre_tasks.learned.sparse_unet import VoxelPyramid
from genre_tasks.optimiser.kernel_steps import learned_step
from genre_tasks.optimiser.kernels.constants import BLOCK
from genre_tasks.optimiser.kernels.library import Network, Scene
from genre_tasks.optimiser.state import Frame, State
from genre_tasks.optimiser.step_rules import rate_vector, schedule


class FusedStep:
    """``step(state, gradient, total)`` of one scene, float32 on the CPU, by ``network`` as it is when this is made.

    Runs on ``torch.get_num_threads()`` threads; the bits do not depend on their number.
    """

    def __init__(self, network: LearnedNetwork, frame: Frame, fixed: Fixed, pyramid: VoxelPyramid) -> None:
        self._memory = Memory()
        self._rates = -rate_vector(network.config.rates)
        self._count, self._residuals = len(pyramid.voxel_of), network.residuals
        hidden = round_up(network.config.hidden, 2 * LANES)
        self._network = _dense_layers(network, hidden, self._memory)
        self._scene = _scene(network, hidden, frame, fixed, pyramid, self._memory)

    def __call__(self, state: State, gradient: Tensor, total: int) -> Tensor:
        """Delta [N, 14]; see :class:`genre_tasks.optimiser.step_rules.Step`.

        Raises ``ValueError`` for tensors of another scene or not float32 on the CPU, ``ResourceError`` where the kernel
        is not compiled or memory is short.
        """
        if len(gradient) != self._count:
            raise ValueError(f"expected the gradient of {self._count} Gaussians, got {len(gradient)}")
        part, time = schedule(state.iteration, total), torch.tensor(times(state.iteration, total))
        if (state.residuals is None) == self._residuals:
            raise ValueError(f"expected a state {'with' if self._residuals else 'without'} residuals")
        return learned_step(self._network, self._scene, state, gradient, self._rates * part, time, part)


def _dense_layers(network: LearnedNetwork, hidden: int, memory: Memory) -> Network:
    at, entry, head = memory.address, network.entry, network.head
    own = network.mix.weight[:, : network.config.hidden].T
    column = torch.cat([torch.arange(14), LANES + torch.arange(14)])  # gains and offsets have a row of lanes each
    weight, bias = torch.zeros(hidden, 2 * LANES), torch.zeros(2 * LANES)
    if network.residuals:
        column = torch.cat([column, torch.tensor([14])])  # beside the gains
    weight[: head.in_features, column], bias[column] = head.weight.detach().T, head.bias.detach()
    bias[14] += network.config.relaxation
    return Network(
        hidden,
        entry.in_features - TIMES,
        at(padded(entry.weight.T, entry.in_features, hidden)),
        at(padded(entry.bias, hidden)),
        at(padded(own, hidden, hidden)),
        at(weight),
        at(bias),
    )


def _scene(
    network: LearnedNetwork, hidden: int, frame: Frame, fixed: Fixed, pyramid: VoxelPyramid, memory: Memory
) -> Scene:
    """What the mixing layer takes from around is the same for all Gaussians of a voxel: it is a layer of voxels."""
    voxels, layers, at = pyramid.count, Layers(memory), memory.address
    count = len(pyramid.voxel_of)
    pooled, own = torch.zeros(voxels, hidden), torch.zeros(round_up(count, BLOCK), hidden)
    active, slot = torch.zeros(2, count, dtype=torch.int32)
    around = network.mix.weight[:, network.config.hidden :].T[None]
    out = layers.add(
        layers.unet(network.unet, pooled, pyramid),
        around,
        network.mix.bias,
        Pairs.identity(voxels),
        multiple=2 * LANES,
        activated=False,
    )
    points, program = ByOwner.of(pyramid.voxel_of, voxels), layers.program()
    return Scene(
        voxels,
        at(_base(frame)),
        at(fixed.columns),
        at(pyramid.voxel_of.int()),
        at(points.starts),
        at(points.order),
        at(active),
        at(slot),
        at(own),
        at(pooled),
        at(out),
        program,
        len(program),
    )


def _base(frame: Frame) -> Tensor:
    """What offsets are added to in the features, [N, 14]."""
    g = frame.scene.gaussians
    start = [torch.zeros_like(g.means), g.log_scales - frame.unit.log(), g.quats, g.logit_opacities[:, None]]
    return torch.cat([*start, g.colors - 0.5], 1)
