"""FID and LPIPS on networks as TorchScript, whose files the user gives.

Both networks are TorchScript files as NVIDIA publishes them for StyleGAN. ``inception-2015-12-05.pt`` is the network of
Heusel et al. 2017 with pooled features of 2048; ``vgg16.pt`` is LPIPS of Zhang et al. 2018 on VGG. They take images
[V, 3, H, W] in [0, 255] and resize them on their own. LPIPS without such a file: :mod:`genre_tasks.metrics.lpips`.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.errors import InputError
from genre_tasks.metrics.network_files import describe_network_remedy
from genre_tasks.threads import map_single_threaded

FID_DIMENSIONS = 2048


class Inception:
    """The network whose features FID compares.

    Args:
        file: its TorchScript file.

    Raises:
        InputError: the file is missing or holds no such network.
    """

    def __init__(self, file: str | Path) -> None:
        self.file = Path(file)
        self._network = _load_network(self.file, "return_features", "evaluate.inception")

    def features(self, images: Tensor) -> Tensor:
        """Computes the features of images, each on its own and of its 8-bit values, as published.

        Args:
            images: [V, H, W, 3] sRGB in [0, 1].

        Returns:
            [V, 2048] float64.

        Raises:
            InputError: the network's features have another length.
        """

        def pooled_features(image: Tensor) -> Tensor:
            with torch.no_grad():
                # Published numbers are of images that were saved with 8 bits.
                pixels = (image.clamp(0, 1) * 255).round().to(torch.uint8)
                out: Tensor = self._network(pixels.permute(2, 0, 1)[None], return_features=True)
            return out

        found = map_single_threaded(pooled_features, list(images))
        if any(x.shape != (1, FID_DIMENSIONS) for x in found):
            raise InputError(
                f"the network gives features {list(found[0].shape)}, expected [1, {FID_DIMENSIONS}]",
                remedy="Give by evaluate.inception the TorchScript file inception-2015-12-05.pt.",
                file=self.file,
            )
        # The empty first part gives a set without images its width.
        return torch.cat([torch.zeros((0, FID_DIMENSIONS)), *(x.float() for x in found)]).double()


class ScriptedLpips:
    """The perceptual distance LPIPS by a network of the user's.

    Args:
        file: its TorchScript file.

    Raises:
        InputError: the file is missing or holds no such network.
    """

    # Without a network's name, since nothing tells which one the file holds.
    metric = "lpips"

    def __init__(self, file: str | Path) -> None:
        self._network = _load_network(Path(file), "return_lpips", "evaluate.lpips")

    def distances(self, images: Tensor, truths: Tensor) -> list[float]:
        """Computes LPIPS of each pair at full size: the squared distance of weighted unit features.

        Args:
            images: [V, H, W, 3] sRGB in [0, 1].
            truths: [V, H, W, 3].

        Returns:
            V distances, at least 0.
        """

        def weighted_features(image: Tensor) -> Tensor:
            pixels = image.permute(2, 0, 1)[None].float() * 255
            out: Tensor = self._network(pixels, resize_images=False, return_lpips=True)
            return out

        def distance(pair: tuple[Tensor, Tensor]) -> float:
            image, truth = pair
            with torch.no_grad():
                # In float64, since features of near images are nearly equal.
                difference = weighted_features(image).double() - weighted_features(truth).double()
            return float(difference.square().sum())

        return map_single_threaded(distance, list(zip(images, truths, strict=True)))


def fid(
    features: Tensor,  # [N, D]
    reference: Tensor,  # [M, D]
) -> float | None:
    """Computes the Fréchet inception distance over all dimensions (Heusel et al. 2017).

    It is ``‖μ₁ − μ₂‖² + tr C₁ + tr C₂ − 2 tr (C₁C₂)^½``. With ``A`` and ``B`` the centred features over ``√(N − 1)``,
    ``C₁C₂ = AᵀA BᵀB`` has the eigenvalues of ``(A Bᵀ)(A Bᵀ)ᵀ``. The last trace is therefore the sum of the singular
    values of ``A Bᵀ`` [N, M], which is exact also where N is smaller than D.

    The distance is biased for small sets: compare it at equal N only.

    Args:
        features: of the images to judge.
        reference: of real images.

    Returns:
        A number of at least 0; ``None`` with fewer than two images in a set.

    Raises:
        NonFiniteError: a feature is NaN or infinite.
    """
    if min(len(features), len(reference)) < 2:
        return None

    def distance(pair: tuple[Tensor, Tensor]) -> float:
        means = [x.mean(0) for x in pair]
        # Over √(N − 1), so that AᵀA is the covariance.
        centred = [(x - mean) / (len(x) - 1) ** 0.5 for x, mean in zip(pair, means, strict=True)]
        traces = sum(float(x.square().sum()) for x in centred)
        cross = float(torch.linalg.svdvals(centred[0] @ centred[1].T).sum())
        return float((means[0] - means[1]).square().sum()) + traces - 2 * cross

    check_finite(features, "features", "evaluate")
    check_finite(reference, "reference features", "evaluate")
    # Rounding can take the distance of a set from itself below 0.
    return max(0.0, map_single_threaded(distance, [(features.double(), reference.double())])[0])


@lru_cache(maxsize=4)
def load_inception(file: str) -> Inception:
    """Loads FID's network, once per process.

    Args:
        file: its TorchScript file.

    Raises:
        InputError: the file is missing or holds no such network.
    """
    return Inception(file)


def _load_network(file: Path, argument: str, key: str) -> Any:
    """The TorchScript network of a file; ``argument`` is one of its forward, ``key`` the setting that named it."""
    remedy = describe_network_remedy(argument, key)
    if not file.is_file():
        raise InputError("no such file", remedy=remedy, file=file)
    try:
        # Whatever is no TorchScript fails in one of several ways, none with a class of its own.
        network = torch.jit.load(str(file), map_location="cpu").eval()
        names = [a.name for a in network.forward.schema.arguments]
    except (RuntimeError, AttributeError, ValueError) as error:
        raise InputError(
            f"the file is no TorchScript: {str(error).splitlines()[0]}", remedy=remedy, file=file
        ) from error
    # A network for something else would fail in the middle of an evaluation: it is refused here.
    if argument not in names:
        raise InputError(f"the network's forward takes {', '.join(names)}", remedy=remedy, file=file)
    return network
