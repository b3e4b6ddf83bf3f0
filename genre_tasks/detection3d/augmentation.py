"""Random changes of training images that keep depths right: mirrored, zoomed, moved and of other colours.

A zoom changes the focal length, not the scene: the depth over the focal length changes with the size in the image. A
mirrored image is that of a mirrored street, in which observation angles have the other sign.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from genre_tasks.detection3d.examples import Objects, TrainingExamples
from genre_tasks.detection3d.settings import Detector3dConfig


@dataclass(frozen=True)
class Batch:
    """B images as the network sees them.

    Attributes:
        images: [B, 3, H, W] in [0, 1].
        lenses: [B, 4] fx, fy, cx, cy, pixels.
        objects: whose centres are inside of the images.
    """

    images: Tensor
    lenses: Tensor
    objects: Objects


@dataclass(frozen=True)
class Changes:
    """How B images are changed.

    Attributes:
        flipped: [B] bool: mirrored, before anything else.
        zooms: [B] factors of the focal lengths, about the image's middle.
        shifts_px: [B, 2] to the right and down, after the zoom.
    """

    flipped: Tensor
    zooms: Tensor
    shifts_px: Tensor


def draw_changes(count: int, config: Detector3dConfig, generator: torch.Generator) -> Changes:
    """Draws changes for a batch.

    Args:
        count: B.
        config: how large they are.
        generator: of the random numbers.

    Returns:
        The changes.
    """
    # As logarithms, so that zooming in and out are as likely.
    spread = torch.log1p(torch.tensor(config.zoom))
    uniform = torch.rand(count, 4, generator=generator)
    size = torch.tensor([config.width_px, config.height_px])
    return Changes(
        flipped=uniform[:, 0] < config.flip,
        zooms=torch.exp((2 * uniform[:, 1] - 1) * spread),
        shifts_px=(2 * uniform[:, 2:] - 1) * config.shift * size,
    )


def take_batch(examples: TrainingExamples, rows: Tensor) -> Batch:
    """Takes some of the examples as they are.

    Args:
        examples: to take from.
        rows: [B] indices, repeated or not.

    Returns:
        The batch.
    """
    parts = []
    places = []
    for place, row in enumerate(rows.tolist()):
        # Objects are in the order of their images.
        first, last = torch.searchsorted(examples.objects.images, torch.tensor([row, row + 1])).tolist()
        parts.append(torch.arange(first, last))
        places.append(torch.full((last - first,), place))
    objects = replace(examples.objects.select(torch.cat(parts)), images=torch.cat(places))
    return Batch(examples.images[rows].float() / 255, examples.lenses[rows], objects)


def apply_changes(batch: Batch, changes: Changes) -> Batch:
    """Changes the geometry of a batch.

    Args:
        batch: to change.
        changes: one for each image.

    Returns:
        The changed batch, without objects whose centres have left the image.
    """
    height, width = batch.images.shape[-2:]
    sign = torch.where(changes.flipped, -1.0, 1.0)
    middle = torch.tensor([width / 2, height / 2])
    # From the new image's coordinates, −1 to 1, to those of the old one.
    theta = torch.zeros(len(sign), 2, 3)
    theta[:, 0, 0] = sign / changes.zooms
    theta[:, 1, 1] = 1 / changes.zooms
    theta[:, 0, 2] = -theta[:, 0, 0] * changes.shifts_px[:, 0] / middle[0]
    theta[:, 1, 2] = -theta[:, 1, 1] * changes.shifts_px[:, 1] / middle[1]
    grid = functional.affine_grid(theta, list(batch.images.shape), align_corners=False)
    images = functional.grid_sample(batch.images, grid, align_corners=False)

    def move(points: Tensor, n: Tensor) -> Tensor:
        centred = points - middle
        centred = torch.stack([centred[:, 0] * sign[n], centred[:, 1]], 1)
        return centred * changes.zooms[n, None] + middle + changes.shifts_px[n]

    everyone = torch.arange(len(sign))
    lenses = torch.cat([batch.lenses[:, :2] * changes.zooms[:, None], move(batch.lenses[:, 2:], everyone)], 1)
    centres = move(batch.objects.centres_px, batch.objects.images)
    moved = replace(batch.objects, centres_px=centres, angles=batch.objects.angles * sign[batch.objects.images])
    is_inside = ((centres >= 0) & (centres < 2 * middle)).all(1)
    return Batch(images, lenses, moved.select(is_inside))


def jitter_colours(batch: Batch, strength: float, generator: torch.Generator) -> Batch:
    """Changes brightness, contrast and the gains of red, green and blue.

    Args:
        batch: to change.
        strength: largest change, as a share.
        generator: of the random numbers.

    Returns:
        The changed batch.
    """
    count = len(batch.images)
    uniform = 2 * torch.rand(count, 5, generator=generator) - 1
    contrast = 1 + strength * uniform[:, 0, None, None, None]
    # Gains differ less between colours than between exposures.
    gains = 1 + strength * (uniform[:, 1, None] + 0.4 * uniform[:, 2:])[:, :, None, None]
    mean = batch.images.mean((1, 2, 3), keepdim=True)
    images = ((batch.images - mean) * contrast + mean) * gains
    return replace(batch, images=images.clamp(0, 1))
