"""Training pairs: degraded renders with what they are fixed from, and the truth (paper Sec. III-B, IV-A).

Pairs are stored as bytes: images are rounded to 8 bits, which is far below what the fixer corrects.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.fixer.inputs import FixerInputs, build_inputs
from genre_tasks.fixer.warping import SourceImage
from genre_tasks.render import render_views
from genre_tasks.render.surface import render_surfaces
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import NovelView, NovelViews

INPUT_NAMES = tuple(f.name for f in fields(FixerInputs))
"""The tensors of ``FixerInputs``, in order."""


@dataclass(frozen=True)
class Pairs:
    """N training pairs of one image size.

    Attributes:
        views: [N, 3 or 1, H, W] uint8, what the views are fixed from.
        truth: [N, 3, H, W] uint8, the true images.
        kinds: how the render of each pair came to be degraded.
        shift_m: [N] metres from the path; 0 on it.
    """

    views: FixerInputs
    truth: Tensor
    kinds: tuple[str, ...]
    shift_m: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.truth)

    def as_floats(self, index: slice) -> tuple[FixerInputs, Tensor]:
        """Converts some of the pairs to floats.

        Args:
            index: slice of the pairs.

        Returns:
            Views and truth in [0, 1].
        """
        return self.views.select(index).map(_to_floats), _to_floats(self.truth[index])

    def digest(self) -> str:
        """Digests every eighth row of each image, which tells pairs of other scenes or renders apart in seconds.

        Returns:
            A SHA-256.
        """
        # All rows would take eight times as long, and tell nothing more apart.
        digest = hashlib.sha256("\n".join(self.kinds).encode())
        for image in (self.truth, *(getattr(self.views, name) for name in INPUT_NAMES)):
            digest.update(image[..., ::8, :].contiguous().numpy().tobytes())
        return digest.hexdigest()


def render_pairs(
    kind: str,
    chunk: Chunk,
    scene: SceneGraph,
    lidar: SceneGraph,
    views: Sequence[NovelView],
    truth: Sequence[NDArray[np.uint8]],
    sources: Sequence[SourceImage],
) -> Pairs:
    """Renders a scene at views whose true images are known.

    Args:
        kind: how the scene came to be degraded.
        chunk: that the scene is of.
        scene: the degraded scene.
        lidar: the scene of the LiDAR map.
        views: viewpoints.
        truth: the true image [H, W, 3] at each of them.
        sources: recorded images that the fixer may sample.

    Returns:
        One pair for each view.

    Raises:
        InputError: the reference of a view is no source view of the chunk.
    """
    with torch.no_grad():
        render = render_views(scene, views)
        lidar_map = render_surfaces(lidar, views)
    novel = NovelViews(
        views=tuple(views),
        color=render.color,
        alpha=render.alpha,
        depth=render.expected_depth(),
        lidar_color=lidar_map.color,
        lidar_alpha=lidar_map.alpha,
        lidar_depth=lidar_map.expected_depth(),
    )
    # The same function as in use, so that training and use cannot drift apart.
    inputs = build_inputs(chunk, novel, range(len(views)), sources)
    # Contiguous, because crops are cut out of it many thousand times.
    images = torch.from_numpy(np.stack(truth)).permute(0, 3, 1, 2).contiguous()
    shifts = np.array([v.shift_m for v in views], np.float32)
    return Pairs(inputs.map(_to_bytes), images, (kind,) * len(views), shifts)


def concatenate_pairs(parts: Sequence[Pairs]) -> Pairs:
    """Joins sets of pairs, in order.

    Args:
        parts: at least one set, all of one image size.

    Returns:
        All pairs.

    Raises:
        ValueError: there is no set.
        RuntimeError: image sizes differ.
    """
    if not parts:
        raise ValueError("expected at least one set of pairs")
    views = FixerInputs(*(torch.cat([getattr(part.views, name) for part in parts]) for name in INPUT_NAMES))
    return Pairs(
        views=views,
        truth=torch.cat([part.truth for part in parts]),
        kinds=tuple(kind for part in parts for kind in part.kinds),
        shift_m=np.concatenate([part.shift_m for part in parts]),
    )


def perturb_scene(scene: SceneGraph, generator: torch.Generator, strength: float = 1.0) -> SceneGraph:
    """Adds errors that an optimiser makes: misplaced and misshapen Gaussians, thinned regions, tinted colours.

    Args:
        scene: to degrade.
        generator: of the errors.
        strength: factor on all errors; 0 changes nothing.

    Returns:
        The degraded scene.
    """
    gaussians = scene.gaussians
    count = len(gaussians)

    def noise(*shape: int) -> Tensor:
        return strength * torch.randn(count, *shape, generator=generator)

    # Errors of position are in proportion to size. The cap is for the distant shell, whose Gaussians are metres large.
    size = gaussians.log_scales.exp().mean(1, keepdim=True).clamp_max(0.3)
    # Regions are thinned by waves that are about ten metres long.
    wave = torch.sin(gaussians.means @ torch.randn(3, 1, generator=generator) * 0.7)[:, 0]
    return scene.with_gaussians(
        Gaussians(
            means=gaussians.means + size * 0.5 * noise(3),
            log_scales=gaussians.log_scales + 0.25 * noise(3),
            quats=gaussians.quats + 0.05 * noise(4),
            logit_opacities=gaussians.logit_opacities + 0.5 * noise() - strength * wave.clamp_min(0),
            colors=gaussians.colors + 0.03 * noise(3),
        )
    )


def sample_crops(
    pairs: Pairs, generator: torch.Generator, count: int, size: tuple[int, int], clean_share: float
) -> tuple[FixerInputs, Tensor]:
    """Draws random crops of pairs, mirrored at random.

    Args:
        pairs: to draw from.
        generator: of the draws.
        count: number of crops.
        size: height and width of a crop.
        clean_share: fraction of crops whose render is replaced by the truth, opaque, so that the fixer learns to leave
            good images alone.

    Returns:
        Views and truth [count, 3, *size] in [0, 1].
    """
    height, width = pairs.truth.shape[-2:]
    crop_height, crop_width = size
    all_views = []
    all_truths = []
    for _ in range(count):
        index = _draw_below(len(pairs), generator)
        top = _draw_below(height - crop_height + 1, generator)
        left = _draw_below(width - crop_width + 1, generator)
        mirror_draw, clean_draw = torch.rand(2, generator=generator).tolist()
        views, truth = pairs.as_floats(slice(index, index + 1))
        views = views.crop(top, left, crop_height, crop_width)
        truth = truth[..., top : top + crop_height, left : left + crop_width]
        # Both draws are taken for every crop: settings then change what a crop is, but not which crops are drawn.
        if clean_draw < clean_share:
            views = replace(views, color=truth, alpha=torch.ones_like(views.alpha))
        if mirror_draw < 0.5:
            views = views.map(lambda image: image.flip(-1))
            truth = truth.flip(-1)
        all_views.append(views)
        all_truths.append(truth)
    batch = FixerInputs(*(torch.cat([getattr(views, name) for views in all_views]) for name in INPUT_NAMES))
    return batch, torch.cat(all_truths)


def _draw_below(bound: int, generator: torch.Generator) -> int:
    return int(torch.randint(bound, (), generator=generator))


def _to_bytes(image: Tensor) -> Tensor:
    # Adding a half makes the conversion, which truncates, round.
    return (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8)


def _to_floats(image: Tensor) -> Tensor:
    return image.float() / 255
