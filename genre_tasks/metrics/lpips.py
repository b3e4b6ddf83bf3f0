"""LPIPS, the learned perceptual distance of Zhang et al. 2018, on AlexNet or VGG16 with the published heads.

Unlike :mod:`genre_tasks.metrics.perceptual`, which losses use, its values compare with published ones. It has no
gradient: it measures, and trains nothing.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from genre_tasks.metrics.fid_lpips import ScriptedLpips
from genre_tasks.metrics.lpips_weights import LPIPS_FILES, read_lpips_weights, require_size
from genre_tasks.threads import map_single_threaded

# Of pixels in [−1, 1], as published: ImageNet's mean and deviation in other words.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
# Published: it keeps features of length 0 from a division by 0.
_NORM_FLOOR = 1e-10


class Lpips(Protocol):
    """A perceptual distance of image pairs.

    Attributes:
        metric: its name among metrics; two networks have two names, since their values do not compare.
    """

    metric: str

    def distances(self, images: Tensor, truths: Tensor) -> list[float]:
        """Computes the distance of each pair.

        Args:
            images: [V, H, W, 3] sRGB in [0, 1].
            truths: [V, H, W, 3].

        Returns:
            V distances, at least 0.
        """
        ...


class PackagedLpips:
    """LPIPS with the weights that the extra ``lpips`` brings.

    ``d(a, b) = Σ_l 1/(H_l W_l) Σ_hw Σ_c w_lc (f̂_l(a)_hwc − f̂_l(b)_hwc)²`` over five depths of the network, with ``f̂``
    the features divided by their length over channels, and ``w`` the published head.

    Args:
        network: ``alex`` or ``vgg``.

    Raises:
        InputError: the weights are not installed, or are others.
    """

    def __init__(self, network: str) -> None:
        self.metric = f"lpips_{network}"
        self._network = network
        self._taps = LPIPS_FILES[network].taps
        weights = read_lpips_weights(network)
        # From [height, width, input, output], JAX's order, to torch's.
        self._kernels = [torch.from_numpy(kernel.transpose(3, 2, 0, 1).copy()) for kernel in weights.kernels]
        self._biases = [torch.from_numpy(bias.copy()) for bias in weights.biases]
        self._heads = [torch.from_numpy(head.copy()) for head in weights.heads]

    def distances(self, images: Tensor, truths: Tensor) -> list[float]:
        """Computes LPIPS of each pair at full size.

        Args:
            images: [V, H, W, 3] sRGB in [0, 1].
            truths: [V, H, W, 3].

        Returns:
            V distances, at least 0; 0 for equal images.

        Raises:
            InputError: the images are too small for the network.
        """
        require_size(self._network, images.shape[2], images.shape[1])
        return map_single_threaded(self._distance, list(zip(images, truths, strict=True)))

    @torch.no_grad()
    def _distance(self, pair: tuple[Tensor, Tensor]) -> float:
        pixels = torch.stack(pair).permute(0, 3, 1, 2).float() * 2 - 1
        x = (pixels - torch.tensor(_SHIFT)[:, None, None]) / torch.tensor(_SCALE)[:, None, None]
        total = 0.0
        heads = iter(self._heads)
        # Each tap is compared at once, so that no features of another one stay in memory.
        for number, (kernel, bias) in enumerate(zip(self._kernels, self._biases, strict=True)):
            x = F.relu(self._convolve(x, number, kernel, bias))
            if number in self._taps:
                lengths = x.square().sum(1, keepdim=True).sqrt()
                unit = x / (lengths + _NORM_FLOOR)
                difference = (unit[0] - unit[1]).square()
                # In float64, since a mean over a million positions loses digits in float32.
                total += float((difference.double().mean((1, 2)) * next(heads).double()).sum())
        return total

    def _convolve(self, x: Tensor, number: int, kernel: Tensor, bias: Tensor) -> Tensor:
        """The convolution of that number, after the pooling before it."""
        if self._network == "vgg":
            # Every depth but the first starts with a pooling, which follows the tap of the depth before.
            x = F.max_pool2d(x, 2) if number - 1 in self._taps else x
            return F.conv2d(x, kernel, bias, padding=1)
        x = F.max_pool2d(x, 3, stride=2) if number in (1, 2) else x
        return F.conv2d(x, kernel, bias, stride=4 if number == 0 else 1, padding=kernel.shape[-1] // 2 if number else 2)


@lru_cache(maxsize=4)
def load_lpips(setting: str) -> Lpips:
    """Loads LPIPS, once per process.

    Args:
        setting: ``evaluate.lpips``: a name in :data:`~genre_tasks.metrics.lpips_weights.LPIPS_FILES`, or a TorchScript
            file.

    Raises:
        InputError: the weights are not installed, or the file is missing or holds no such network.
    """
    return PackagedLpips(setting) if setting in LPIPS_FILES else ScriptedLpips(setting)
