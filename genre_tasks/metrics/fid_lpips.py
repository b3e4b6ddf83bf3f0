"""FID and LPIPS proper, on the networks that published numbers are on; their weights are the user's to give.

Both are TorchScript files as NVIDIA publishes them for StyleGAN: ``inception-2015-12-05.pt`` (the network of Heusel et
al. 2017, pooled features of 2048) and ``vgg16.pt`` (LPIPS of Zhang et al. 2018 on VGG). They take [V, 3, H, W] in
[0, 255] and resize by themselves.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from genre_tasks.errors import InputError, NonFiniteError
from genre_tasks.threads import map_single_threaded

FID_DIMENSIONS = 2048


class Inception:
    """Features that FID is taken on. Raises ``InputError`` for a file that is no such network."""

    def __init__(self, file: str | Path) -> None:
        self.file = Path(file)
        self._network = _network(self.file, "return_features", "evaluate.inception")

    def features(self, images: Tensor) -> Tensor:
        """[V, H, W, 3] in [0, 1] → [V, 2048], float64, each image on its own, of its 8-bit values (as published)."""

        def one(image: Tensor) -> Tensor:
            with torch.no_grad():
                pixels = (image.clamp(0, 1) * 255).round().to(torch.uint8)
                out: Tensor = self._network(pixels.permute(2, 0, 1)[None], return_features=True)
            return out

        found = map_single_threaded(one, list(images))
        if any(x.shape != (1, FID_DIMENSIONS) for x in found):
            raise InputError(
                f"the network gives features {list(found[0].shape)}, expected [1, {FID_DIMENSIONS}]",
                remedy="Give by evaluate.inception the TorchScript file inception-2015-12-05.pt.",
                file=self.file,
            )
        return torch.cat([torch.zeros((0, FID_DIMENSIONS)), *(x.float() for x in found)]).double()


class Lpips:
    """LPIPS on VGG. Raises ``InputError`` for a file that is no such network."""

    def __init__(self, file: str | Path) -> None:
        self._network = _network(Path(file), "return_lpips", "evaluate.lpips")

    def distances(self, images: Tensor, truths: Tensor) -> list[float]:
        """Of each pair of [V, H, W, 3] in [0, 1]: the squared distance of weighted unit features, at full size."""

        def one(pair: tuple[Tensor, Tensor]) -> float:
            with torch.no_grad():
                a, b = (
                    self._network(x.permute(2, 0, 1)[None].float() * 255, resize_images=False, return_lpips=True)
                    for x in pair
                )
            return float((a.double() - b.double()).square().sum())

        return map_single_threaded(one, list(zip(images, truths, strict=True)))


def fid(
    features: Tensor,  # [N, D]
    reference: Tensor,  # [M, D]
) -> float | None:
    """Fréchet inception distance, all dimensions: ``‖μ₁ − μ₂‖² + tr C₁ + tr C₂ − 2 tr (C₁C₂)^½``; ≥ 0.

    With ``A`` and ``B`` the centred features over ``√(N − 1)``, ``C₁C₂ = AᵀA BᵀB`` has the eigenvalues of
    ``(A Bᵀ)(A Bᵀ)ᵀ``: the last trace is the sum of the singular values of ``A Bᵀ`` [N, M], exact also where N is
    smaller than D. It is biased, and to be compared at equal N only. ``None`` with fewer than two images in a set.

    Raises ``NonFiniteError``.
    """
    if min(len(features), len(reference)) < 2:
        return None

    def distance(pair: tuple[Tensor, Tensor]) -> float:
        means = [x.mean(0) for x in pair]
        centred = [(x - m) / (len(x) - 1) ** 0.5 for x, m in zip(pair, means, strict=True)]
        traces = sum(float(x.square().sum()) for x in centred)
        cross = float(torch.linalg.svdvals(centred[0] @ centred[1].T).sum())
        return float((means[0] - means[1]).square().sum()) + traces - 2 * cross

    for name, x in (("features", features), ("reference features", reference)):
        bad = torch.nonzero(~torch.isfinite(x))
        if len(bad):
            raise NonFiniteError("fid", name, len(bad), tuple(int(i) for i in bad[0]))
    return max(0.0, map_single_threaded(distance, [(features.double(), reference.double())])[0])


@lru_cache(maxsize=4)
def inception(file: str) -> Inception:
    """Loaded once a process."""
    return Inception(file)


@lru_cache(maxsize=4)
def lpips(file: str) -> Lpips:
    """Loaded once a process."""
    return Lpips(file)


def _network(file: Path, argument: str, key: str) -> Any:
    remedy = f"Give by {key} a TorchScript network whose forward takes {argument}."
    if not file.is_file():
        raise InputError("no such file", remedy=remedy, file=file)
    try:
        network = torch.jit.load(str(file), map_location="cpu").eval()
        names = [a.name for a in network.forward.schema.arguments]
    except (RuntimeError, AttributeError, ValueError) as error:
        raise InputError(
            f"the file is no TorchScript: {str(error).splitlines()[0]}", remedy=remedy, file=file
        ) from error
    if argument not in names:
        raise InputError(f"the network's forward takes {', '.join(names)}", remedy=remedy, file=file)
    return network
