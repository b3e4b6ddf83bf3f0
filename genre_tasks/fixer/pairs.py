"""Training pairs: degraded renders with what they are fixed from, and the truth (paper Sec. III-B, IV-A).

Kept as bytes: images are rounded to 8 bits, which is far below what the fixer corrects.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.fixer.conditioning import Degraded, degraded
from genre_tasks.fixer.warping import SourceImage
from genre_tasks.render import render_views
from genre_tasks.render.surface import render_surfaces
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import NovelView, NovelViews

NAMES = tuple(f.name for f in fields(Degraded))
"""The tensors of ``Degraded``, in order."""


@dataclass(frozen=True)
class Pairs:
    """N pairs of one image size, uint8.

    ``kinds`` say how each came to be degraded, ``shift_m`` [N] how far beside the path it is (0: on it).
    """

    views: Degraded  # [N, 3 or 1, H, W] uint8
    truth: Tensor  # [N, 3, H, W] uint8
    kinds: tuple[str, ...]
    shift_m: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.truth)

    def at(self, index: slice) -> tuple[Degraded, Tensor]:
        """Views and truth of a slice as floats in [0, 1]."""
        return Degraded(*(_floats(getattr(self.views, n)[index]) for n in NAMES)), _floats(self.truth[index])

    def digest(self) -> str:
        """Of what every eighth row of each image holds: tells pairs of other scenes or renders apart, in seconds."""
        found = hashlib.sha256("\n".join(self.kinds).encode())
        for image in (self.truth, *(getattr(self.views, n) for n in NAMES)):
            found.update(image[..., ::8, :].contiguous().numpy().tobytes())
        return found.hexdigest()


def render_pairs(
    kind: str,
    chunk: Chunk,
    scene: SceneGraph,
    lidar: SceneGraph,
    views: Sequence[NovelView],
    truth: Sequence[NDArray[np.uint8]],
    sources: Sequence[SourceImage],
) -> Pairs:
    """Pairs of a scene's renders at ``views`` and the true images [H, W, 3] there.

    ``lidar`` is the LiDAR map's scene, ``sources`` the recorded images that the fixer may look at.
    """
    with torch.no_grad():
        render, points = render_views(scene, views), render_surfaces(lidar, views)
    novel = NovelViews(
        tuple(views),
        render.color,
        render.alpha,
        render.expected_depth(),
        points.color,
        points.alpha,
        points.expected_depth(),
    )
    every = degraded(chunk, novel, range(len(views)), sources)
    images = torch.from_numpy(np.stack(truth)).permute(0, 3, 1, 2).contiguous()
    shifts = np.array([v.shift_m for v in views], np.float32)
    return Pairs(Degraded(*(_bytes(getattr(every, n)) for n in NAMES)), images, (kind,) * len(views), shifts)


def joined(parts: Sequence[Pairs]) -> Pairs:
    """All pairs in one, in order. Raises ``ValueError`` for none, ``RuntimeError`` for mixed sizes."""
    if not parts:
        raise ValueError("expected at least one set of pairs")
    views = Degraded(*(torch.cat([getattr(p.views, n) for p in parts]) for n in NAMES))
    kinds = tuple(kind for p in parts for kind in p.kinds)
    return Pairs(views, torch.cat([p.truth for p in parts]), kinds, np.concatenate([p.shift_m for p in parts]))


def perturbed(scene: SceneGraph, generator: torch.Generator, strength: float = 1.0) -> SceneGraph:
    """The scene with errors an optimiser makes: misplaced and misshapen Gaussians, thinned regions, tinted colours."""
    g = scene.gaussians
    count = len(g)

    def noise(*shape: int) -> Tensor:
        return strength * torch.randn(count, *shape, generator=generator)

    size = g.log_scales.exp().mean(1, keepdim=True).clamp_max(0.3)
    region = torch.sin(g.means @ torch.randn(3, 1, generator=generator) * 0.7)[:, 0]  # waves about ten metres long
    return scene.with_gaussians(
        Gaussians(
            g.means + size * 0.5 * noise(3),
            g.log_scales + 0.25 * noise(3),
            g.quats + 0.05 * noise(4),
            g.logit_opacities + 0.5 * noise() - strength * region.clamp_min(0),
            g.colors + 0.03 * noise(3),
        )
    )


def sample(
    pairs: Pairs, generator: torch.Generator, count: int, size: tuple[int, int], clean_share: float
) -> tuple[Degraded, Tensor]:
    """``count`` random crops, mirrored at random, as floats: views and truth [count, 3, *size].

    A share of them is clean — the render is the truth, opaque — so that the fixer learns to leave good images alone.
    """
    height, width = pairs.truth.shape[-2:]
    views, truths = [], []
    for _ in range(count):
        pick, top, left = (_below(n, generator) for n in (len(pairs), height - size[0] + 1, width - size[1] + 1))
        mirrored, clean = torch.rand(2, generator=generator).tolist()
        view, truth = pairs.at(slice(pick, pick + 1))
        view = view.cropped(top, left, *size)
        truth = truth[..., top : top + size[0], left : left + size[1]]
        if clean < clean_share:
            view = replace(view, color=truth, alpha=torch.ones_like(view.alpha))
        if mirrored < 0.5:
            view, truth = Degraded(*(getattr(view, n).flip(-1) for n in NAMES)), truth.flip(-1)
        views.append(view)
        truths.append(truth)
    return Degraded(*(torch.cat([getattr(v, n) for v in views]) for n in NAMES)), torch.cat(truths)


def _below(bound: int, generator: torch.Generator) -> int:
    return int(torch.randint(bound, (), generator=generator))


def _bytes(image: Tensor) -> Tensor:
    return (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8)


def _floats(image: Tensor) -> Tensor:
    return image.float() / 255
