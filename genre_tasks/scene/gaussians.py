"""The paper's 14-attribute Gaussians (Sec. III-A), in raw space, and the one conversion to what is rendered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from genre_tasks.scene.constants import LARGEST_LOG_SCALE, LOWEST_LOGIT

OPACITY_CLAMP = 1e-6
"""Opacities are clamped to [1e-6, 1 − 1e-6] when they are taken to logits, so that the logit is finite."""


def sigmoid(logits: Tensor) -> Tensor:
    """Computes 1 / (1 + e^−x) elementwise, with the same bits at any thread count.

    Args:
        logits: of any shape; below ``LOWEST_LOGIT`` the result is constant.

    Returns:
        Values in (0, 1).

    >>> sigmoid(torch.tensor([0.0])).tolist()
    [0.5]
    """
    # torch.sigmoid rounds differently at the ends of the pieces that its threads take.
    return 1.0 / (1.0 + torch.exp(-logits.clamp_min(LOWEST_LOGIT)))


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians as a structure of arrays, float32, in the space in which they are optimised.

    Attributes:
        means: [N, 3] metres.
        log_scales: [N, 3] natural logarithm of standard deviations in metres.
        quats: [N, 4] rotations, w first; need not be unit.
        logit_opacities: [N].
        colors: [N, 3] sRGB, nominally in [0, 1].
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    logit_opacities: Tensor
    colors: Tensor

    def __len__(self) -> int:
        return self.means.shape[0]

    def activate(self) -> Splats:
        """Converts to what a renderer takes: scales = exp, opacities = sigmoid. The only place where this is done.

        >>> gaussian = Gaussians.unpack(torch.zeros(1, 14))
        >>> gaussian.activate().scales.tolist(), gaussian.activate().opacities.tolist()
        ([[1.0, 1.0, 1.0]], [0.5])
        """
        # An infinite scale is culled, and its gradient of 0 times infinity would be NaN. What is drawn does not change.
        scales = self.log_scales.clamp_max(LARGEST_LOG_SCALE).exp()
        # Quaternions are not normalised here: the renderer does it, with the gradient through the norm.
        return Splats(self.means, scales, self.quats, sigmoid(self.logit_opacities), self.colors)

    def pack(self) -> Tensor:
        """Copies all attributes into one tensor, as networks and optimisers take them.

        Returns:
            [N, 14] in the order means 0:3, log_scales 3:6, quats 6:10, logit_opacities 10, colors 11:14.
        """
        return torch.cat([self.means, self.log_scales, self.quats, self.logit_opacities[:, None], self.colors], 1)

    @staticmethod
    def unpack(packed: Tensor) -> Gaussians:
        """Inverts :meth:`pack` without a copy.

        Args:
            packed: [N, 14].

        Returns:
            Gaussians whose tensors are views into ``packed``.

        >>> packed = torch.rand(5, 14)
        >>> torch.equal(Gaussians.unpack(packed).pack(), packed)
        True
        """
        # Views and not copies, because a copy of all attributes would double their memory.
        return Gaussians(packed[:, 0:3], packed[:, 3:6], packed[:, 6:10], packed[:, 10], packed[:, 11:14])


@dataclass(frozen=True)
class Splats:
    """N Gaussians as a renderer takes them.

    Attributes:
        means: [N, 3] metres.
        scales: [N, 3] standard deviations in metres, above 0.
        quats: [N, 4] rotations, w first; normalised by the renderer.
        opacities: [N] in [0, 1].
        colors: [N, 3] sRGB, or [V, N, 3] where V views see different ones.
        velocities: [N, 3] m/s in chunk axes while an image is read out, for cameras with a rolling shutter; ``None``:
            nothing moves.
    """

    means: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    colors: Tensor
    velocities: Tensor | None = None

    def __len__(self) -> int:
        return self.means.shape[0]

    def select(self, rows: Tensor) -> Splats:
        """Copies some of the Gaussians.

        Args:
            rows: [M] int64 indices.

        Returns:
            M splats in that order; colours of V views stay those of V views.
        """
        # Colours of several views have the Gaussians in their second dimension.
        return self._map(lambda x: x.index_select(-2 if x.dim() == 3 else 0, rows))

    def to(self, *args: object, **kwargs: object) -> Splats:
        """Moves or converts each tensor as ``Tensor.to`` does."""
        return self._map(lambda x: x.to(*args, **kwargs))  # type: ignore[call-overload]

    def _map(self, f: Callable[[Tensor], Tensor]) -> Splats:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return Splats(**{name: f(x) for name, x in values.items() if x is not None})


def map_attributes(function: Callable[..., Tensor], *gaussians: Gaussians) -> Gaussians:
    """Applies a function to the means, to the log-scales, and so on.

    Args:
        function: takes one tensor of each of ``gaussians``.
        gaussians: one or several.

    Returns:
        The function's results as Gaussians.

    >>> ones = Gaussians.unpack(torch.ones(2, 14))
    >>> map_attributes(torch.add, ones, ones).pack().unique().tolist()
    [2.0]
    """
    return Gaussians(*(function(*(getattr(g, f.name) for g in gaussians)) for f in fields(Gaussians)))
