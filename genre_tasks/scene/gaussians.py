"""The paper's 14-attribute Gaussians (Sec. III-A), in raw space, and the one conversion to what is rendered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from genre_tasks.scene.constants import LOWEST_LOGIT

OPACITY_CLAMP = 1e-6
"""Opacities are kept in [1e-6, 1 − 1e-6] when they are taken to logits, so that the logit is finite."""


def sigmoid(logits: Tensor) -> Tensor:
    """1 / (1 + e^−x), elementwise, the same bits at any thread count.

    ``torch.sigmoid`` rounds differently at the ends of the pieces that its threads take. Below ``LOWEST_LOGIT`` it is
    constant.
    """
    return 1.0 / (1.0 + torch.exp(-logits.clamp_min(LOWEST_LOGIT)))


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians as a structure of arrays, float32, in the space in which they are optimised."""

    means: Tensor  # [N, 3] metres
    log_scales: Tensor  # [N, 3] natural logarithm of metres
    quats: Tensor  # [N, 4] w, x, y, z; need not be unit
    logit_opacities: Tensor  # [N]
    colors: Tensor  # [N, 3] sRGB, nominally in [0, 1]

    def __len__(self) -> int:
        return self.means.shape[0]

    def activated(self) -> Splats:
        """What a renderer takes: scales = exp, opacities = sigmoid; the only place where this is done."""
        return Splats(self.means, self.log_scales.exp(), self.quats, sigmoid(self.logit_opacities), self.colors)

    def packed(self) -> Tensor:
        """[N, 14] in the order means 0:3, log_scales 3:6, quats 6:10, logit_opacities 10, colors 11:14."""
        return torch.cat([self.means, self.log_scales, self.quats, self.logit_opacities[:, None], self.colors], 1)

    @staticmethod
    def unpacked(packed: Tensor) -> Gaussians:
        """The inverse of :meth:`packed`; views into ``packed`` [N, 14]."""
        return Gaussians(packed[:, 0:3], packed[:, 3:6], packed[:, 6:10], packed[:, 10], packed[:, 11:14])


@dataclass(frozen=True)
class Splats:
    """N Gaussians as a renderer takes them.

    ``velocities``: how they move in chunk axes while an image is read out; only a camera with a shutter asks for them.
    """

    means: Tensor  # [N, 3] metres
    scales: Tensor  # [N, 3] metres, > 0
    quats: Tensor  # [N, 4] w, x, y, z; normalised by the renderer
    opacities: Tensor  # [N] in [0, 1]
    colors: Tensor  # [N, 3], or [V, N, 3] where V views see different ones
    velocities: Tensor | None = None  # [N, 3] m/s; None: nothing moves

    def __len__(self) -> int:
        return self.means.shape[0]

    def select(self, rows: Tensor) -> Splats:
        """The Gaussians ``rows`` [M], in that order."""
        return self._map(lambda x: x.index_select(-2 if x.dim() == 3 else 0, rows))

    def to(self, *args: object, **kwargs: object) -> Splats:
        """Each tensor moved as ``Tensor.to`` moves it."""
        return self._map(lambda x: x.to(*args, **kwargs))  # type: ignore[call-overload]

    def _map(self, f: Callable[[Tensor], Tensor]) -> Splats:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return Splats(**{name: f(x) for name, x in values.items() if x is not None})


def map_attributes(function: Callable[..., Tensor], *gaussians: Gaussians) -> Gaussians:
    """``function`` of the means, of the log-scales and so on; its results as Gaussians."""
    return Gaussians(*(function(*(getattr(g, f.name) for g in gaussians)) for f in fields(Gaussians)))
