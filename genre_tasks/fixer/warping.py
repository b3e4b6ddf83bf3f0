"""Warps recorded images to another viewpoint: each pixel's point is looked up in the images that see it.

A view three metres to the side of the path sees what its nearest image does not: what a van hid, what lay outside.
Another frame or camera often saw it, so each pixel takes the first of a few images that does. Points on actors move
with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from genre_tasks.fixer.view_surface import Surface, move_points, subsample, subsample_surface, surface_at_frame
from genre_tasks.logs.types import Float64, Lens, RollingShutter
from genre_tasks.render.reference_camera import ReferenceCamera
from genre_tasks.render.types import Cameras
from genre_tasks.scene.chunk import Actor

# From six on, less than a tenth of a decibel is gained.
MAX_SOURCES = 5
"""Images that a view samples, the reference among them."""

# At edges and between the discs of the LiDAR map depths are as far off as that.
HIDDEN_FRACTION = 0.03
HIDDEN_M = 0.05
"""A point is hidden from an image that sees something nearer by more than this fraction and distance."""

FREE_FRACTION = 0.15
"""A point that is nearer than what an image sees there by more than this fraction is in free space: it is a floater,
and the image shows something else. At a third of this fraction the images of a real log at 320×180 become worse: wires
and posts stand before what LiDAR met."""

_NEAREST_M = 0.1
# A further image has to see this fraction of a view's pixels that none before it saw, or it is not worth its time.
_MIN_NEW_FRACTION = 0.02


@dataclass(frozen=True)
class SourceImage:
    """A recorded image with what hides points from it.

    Attributes:
        camera: name of the camera.
        frame: of the log.
        chunk_SE3_camera: [4, 4] pose.
        lens: at the working resolution.
        image: [3, H, W] in [0, 1].
        depth: [H, W] metres to the nearest thing, 0 where unknown.
        shutter: how the camera moves while the image is read out, if it does.
    """

    camera: str
    frame: int
    chunk_SE3_camera: Float64
    lens: Lens
    image: Tensor
    depth: Tensor
    shutter: RollingShutter | None = None


@dataclass(frozen=True)
class Warp:
    """What recorded images show at a view's points.

    Attributes:
        color: [3, H, W], black where no image sees the point.
        mask: [1, H, W], 1 where an image sees the point.
        spread: [1, H, W], mean absolute difference between the image taken and all others that see the point. It is
            near 0 where they agree, and so where the depth is right; 0 also where there is no second one.
    """

    color: Tensor
    mask: Tensor
    spread: Tensor


def sample_source(surface: Surface, source: SourceImage, actors: Sequence[Actor], frame: int) -> tuple[Tensor, Tensor]:
    """Reads the colours that a source image shows at a surface.

    Args:
        surface: of a view at log frame ``frame``.
        source: to read from, at its own frame.
        actors: of the chunk; points on them move with them.
        frame: of the view.

    Returns:
        Colours [3, ...], and [...] true where the source sees the point: it is neither hidden nor in free space.
    """
    points, exists = surface_at_frame(surface, actors, frame, source.frame)
    x, y, z, in_domain = _project_when_exposed(move_points(points, np.linalg.inv(source.chunk_SE3_camera)), source)
    ahead = exists & in_domain & (z > _NEAREST_M)
    z = torch.where(ahead, z, torch.ones_like(z))
    # grid_sample's coordinates: the image from −1 to 1.
    u = (x / z * source.lens.fx_px + source.lens.cx_px) / source.lens.width_px * 2 - 1
    v = (y / z * source.lens.fy_px + source.lens.cy_px) / source.lens.height_px * 2 - 1
    grid = torch.stack([u, v], -1).clamp(-2, 2)[None]
    # Nearest and not bilinear: a mean of two depths is where nothing is.
    nearest = F.grid_sample(source.depth[None, None].to(z), grid, "nearest", "zeros", align_corners=False)[0, 0]
    hidden = (nearest > 0) & (z > nearest * (1 + HIDDEN_FRACTION) + HIDDEN_M)
    in_free_space = (nearest > 0) & (z < nearest * (1 - FREE_FRACTION) - HIDDEN_M)
    visible = ahead & (u.abs() < 1) & (v.abs() < 1) & ~hidden & ~in_free_space
    # Colours are read from outside of the mask too; callers take those that are visible.
    color = F.grid_sample(source.image[None].to(z), grid, "bilinear", "border", align_corners=False)[0]
    return color, visible


def _project_when_exposed(points: Tensor, source: SourceImage) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Projects camera coordinates [..., 3] with the source's distortion, when each point's row is exposed.

    Returns x, y, z [...] such that x/z and y/z are where a plain lens would show the points, and [...] true where the
    lens is one-to-one. Actors rest while the image is read out.
    """
    x, y, z = points.unbind(-1)
    if source.shutter is None and not any(source.lens.distortion):
        return x, y, z, torch.ones_like(z, dtype=torch.bool)
    cameras = Cameras.from_poses([np.eye(4)], [source.lens], shutters=[source.shutter])
    camera = ReferenceCamera(cameras, 0, points)
    # Points behind the camera would divide by zero; any point ahead stands in for them, and z tells them apart.
    safe = torch.where((z > _NEAREST_M)[..., None], points, torch.ones_like(points)).flatten(0, -2)
    exposed = camera.move_to_exposure(safe, None)
    distorted_x, distorted_y = camera.distort(exposed[:, 0] / exposed[:, 2], exposed[:, 1] / exposed[:, 2])
    exposed_z = torch.where(z > _NEAREST_M, exposed[:, 2].view(z.shape), z)
    in_domain = (camera.is_unfolded(safe) & camera.is_unfolded(exposed)).view(z.shape)
    return distorted_x.view(z.shape) * exposed_z, distorted_y.view(z.shape) * exposed_z, exposed_z, in_domain


def warp(surface: Surface, sources: Sequence[SourceImage], actors: Sequence[Actor], frame: int) -> Warp:
    """Takes each pixel from the first source image that sees its point.

    Args:
        surface: of a view at log frame ``frame``.
        sources: in order of preference.
        actors: of the chunk.
        frame: of the view.

    Returns:
        Colours, where they are known, and how far the sources disagree.

    Raises:
        ValueError: there is no source.
    """
    if not sources:
        raise ValueError("expected at least one source image")
    # The first image and not a mean: a mean of slightly shifted images would be blurred.
    first = torch.zeros(3, *surface.known.shape).to(surface.points)
    mask = torch.zeros_like(surface.known)
    difference = torch.zeros_like(first[0])
    others = torch.zeros_like(first[0])
    for source in sources:
        color, visible = sample_source(surface, source, actors, frame)
        also_visible = (visible & mask).to(first)
        difference += also_visible * (color - first).abs().mean(0)
        others += also_visible
        first = torch.where(visible & ~mask, color, first)
        mask = mask | visible
    return Warp(first, mask[None].to(first), (difference / others.clamp_min(1))[None])


def select_sources(
    surface: Surface,
    sources: Sequence[SourceImage],
    reference: tuple[str, int],
    actors: Sequence[Actor],
    frame: int,
    count: int = MAX_SOURCES,
) -> list[SourceImage]:
    """Selects the sources to warp: the reference, then each time the one that sees most of what is still unseen.

    The decision is taken on a coarse grid of pixels; of equals the earlier one in ``sources`` wins.

    Args:
        surface: of a view at log frame ``frame``.
        sources: all source images of the chunk.
        reference: camera and frame of the view's reference.
        actors: of the chunk.
        frame: of the view.
        count: select at most so many.

    Returns:
        The selected sources, the reference first.

    Raises:
        ValueError: the reference is none of the sources.
    """
    found = [s for s in sources if (s.camera, s.frame) == reference]
    if not found:
        raise ValueError(f"the reference {reference} is none of the sources")
    coarse = subsample_surface(surface)
    selected = found[:1]
    # Identity and not equality: comparing images pixel by pixel would be slow.
    candidates = [s for s in sources if s is not found[0]]
    unseen = coarse.known & ~sample_source(coarse, selected[0], actors, frame)[1]
    # Each candidate is looked up once; the greedy choice below only counts pixels.
    visible = [sample_source(coarse, s, actors, frame)[1] for s in candidates]
    while len(selected) < count and candidates:
        newly_visible = [int((mask & unseen).sum()) for mask in visible]
        best = int(np.argmax(newly_visible))
        if newly_visible[best] < max(1, _MIN_NEW_FRACTION * coarse.known.numel()):
            break
        unseen &= ~visible.pop(best)
        selected.append(candidates.pop(best))
    return selected


def unseen_fraction(
    surface: Surface, alpha: Tensor, sources: Sequence[SourceImage], actors: Sequence[Actor], frame: int
) -> float:
    """Measures how much of a view's light is missing or comes from points that no image shows.

    It is measured on a coarse grid of pixels.

    Args:
        surface: of a view at log frame ``frame``.
        alpha: [H, W] of the view; 1 − alpha is missing light.
        sources: the source images that count.
        actors: of the chunk.
        frame: of the view.

    Returns:
        Fraction in [0, 1].
    """
    coarse = subsample_surface(surface)
    light = subsample(alpha)
    visible = torch.zeros_like(coarse.known)
    for source in sources:
        visible |= sample_source(coarse, source, actors, frame)[1]
    return float(1 - (light.clamp(0, 1) * visible).mean())
