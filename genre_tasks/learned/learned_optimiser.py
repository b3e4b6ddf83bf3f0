"""The learned optimiser that GNet and ENet are (paper Sec. III-C, III-D), as a step rule."""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.config import LearningRates
from genre_tasks.learned.features import StaticFeatures, compute_features
from genre_tasks.learned.kernel_step import KernelStep
from genre_tasks.learned.network import LearnedNetwork
from genre_tasks.learned.sparse_unet import VoxelPyramid
from genre_tasks.optimiser.kernels.library import is_supported
from genre_tasks.optimiser.state import Parameterization, State
from genre_tasks.optimiser.step_rules import StepFunction
from genre_tasks.threads import torch_threads


class LearnedOptimiser(LearnedNetwork):
    """The network with its steps without gradients; GNet and ENet are two sets of its weights.

    Steps are the same bytes at any number of threads: by the compiled kernel for float32 on the CPU, else by torch.
    """

    def with_learning_rates(self, learning_rates: LearningRates) -> LearnedOptimiser:
        """Copies the network with other learning rates.

        Args:
            learning_rates: that its steps are scaled by.

        Returns:
            LearnedOptimiser: with the same weights, in evaluation mode and without gradients.
        """
        # Its random weights are replaced at once, and must not change what others draw from the global generator.
        with torch.random.fork_rng(devices=[]):
            copy = LearnedOptimiser(self.config.model_copy(update={"rates": learning_rates.as_tuple()}))
        copy.load_state_dict(self.state_dict())
        return copy.eval().requires_grad_(False)

    def prepare(self, parameterization: Parameterization, camera_center: Tensor) -> StepFunction:
        """Sets the network up for one scene, with the weights as they are now.

        Args:
            parameterization: the scene at its start, and the units of the offsets.
            camera_center: [3] mean position of the source cameras, chunk coordinates.

        Returns:
            StepFunction: good for all iterations of this scene.
        """
        static_features = StaticFeatures.compute(parameterization, camera_center)
        pyramid = self.pyramid(parameterization, camera_center)
        return self.create_step_function(parameterization, static_features, pyramid)

    def create_step_function(
        self, parameterization: Parameterization, static_features: StaticFeatures, pyramid: VoxelPyramid
    ) -> StepFunction:
        """Does what :meth:`prepare` does, with what depends on the scene alone already computed.

        Args:
            parameterization: the scene at its start, and the units of the offsets.
            static_features: of its Gaussians.
            pyramid: its voxels.

        Returns:
            StepFunction: with the weights as they are now.
        """
        if is_supported(parameterization.unit_m, static_features.columns, *self.parameters()):
            return KernelStep(self, parameterization, static_features, pyramid)

        def step(state: State, gradient: Tensor, total: int) -> Tensor:
            # On one thread, because torch's matrix products round differently on several.
            with torch_threads(1), torch.no_grad():
                inputs = compute_features(parameterization, static_features, state, gradient, total)
                return self.delta(state, inputs, pyramid, total)

        return step
