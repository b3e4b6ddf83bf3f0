"""Recorded images as a viewpoint beside the path would see them: looked up by depth, in the images that see a point.

A view three metres beside the path sees what its nearest image does not: what a van hid, what lay outside. Another
frame or camera often saw it, so each pixel takes the first of a few images that does. Points on actors move with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.logs.types import Float64, Lens, RollingShutter
from genre_tasks.render.reference_camera import OneCamera
from genre_tasks.render.types import Cameras
from genre_tasks.scene.chunk import Actor
from genre_tasks.scene.lens_distortion import rays_at

SOURCES = 5
"""Images looked at for a view, the reference among them: from six on, what is gained is under a tenth of a decibel."""

MIN_ALPHA = 0.5
"""A depth is trusted where at least half of the ray's light is accounted for."""

HIDDEN_SHARE, HIDDEN_M = 0.03, 0.05
"""A point is hidden from an image that sees something nearer by more than this share and distance: at edges
and between the discs of the LiDAR map depths are as far off as that."""

_NEAREST_M = 0.1
_COARSE = 8
_FRESH = 0.02
"""A further image has to see this share of a view's pixels that none before it saw."""

_BOX_MARGIN = 1.1
"""Boxes are drawn tight; mirrors and wheels stick out."""


@dataclass(frozen=True)
class SourceImage:
    """A recorded image with what hides points from it.

    ``pose`` is chunk_SE3_camera [4, 4]; ``image`` [3, H, W] in [0, 1]; ``depth`` [H, W] in metres, 0 where unknown.
    ``shutter``: as a ``View`` has it.
    """

    camera: str
    frame: int
    pose: Float64
    lens: Lens
    image: Tensor
    depth: Tensor
    shutter: RollingShutter | None = None


@dataclass(frozen=True)
class Warp:
    """What recorded images show at a view's points; black and 0 where none of them sees the point.

    ``spread`` is the mean absolute difference to the image taken of all others that see the point: near 0 where they
    agree, and so where the depth is right; 0 also where there is no second one.
    """

    color: Tensor  # [3, H, W]
    mask: Tensor  # [1, H, W]
    spread: Tensor  # [1, H, W]


@dataclass(frozen=True)
class Surface:
    """The points that a view's pixels show: [..., 3] in chunk coordinates at the view's frame, and where known [...].

    ``on`` [...]: the actor that a point is on, −1 for none.
    """

    points: Tensor
    known: Tensor
    on: Tensor


def surface_of(depth: Tensor, alpha: Tensor, pose: Float64, lens: Lens, actors: Sequence[Actor], frame: int) -> Surface:
    """The points at a view's ``depth`` [H, W] (metres along z, premultiplied by nothing), known where alpha is high."""
    height, width = depth.shape
    known = torch.isfinite(depth) & (depth > 0) & (alpha >= MIN_ALPHA)
    z = torch.where(known, depth, torch.ones_like(depth))
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    x, y = (u.to(z) - lens.cx_px) / lens.fx_px * z, (v.to(z) - lens.cy_px) / lens.fy_px * z
    if any(lens.distortion):
        x, y = (torch.from_numpy(ray).to(z) * z for ray in rays_at(u.double().numpy(), v.double().numpy(), lens))
    points = _moved(torch.stack([x, y, z], -1), pose)
    return Surface(points, known, _actor_of(points, known, actors, frame))


def look_up(surface: Surface, source: SourceImage, actors: Sequence[Actor], frame: int) -> tuple[Tensor, Tensor]:
    """What ``source`` shows at a surface of log frame ``frame``: colours [3, ...], and where it sees it [...]."""
    points, there = _at_frame(surface, actors, frame, source.frame)
    x, y, z, unfolded = _as_exposed(_moved(points, np.linalg.inv(source.pose)), source)
    ahead = there & unfolded & (z > _NEAREST_M)
    z = torch.where(ahead, z, torch.ones_like(z))
    u = (x / z * source.lens.fx_px + source.lens.cx_px) / source.lens.width_px * 2 - 1
    v = (y / z * source.lens.fy_px + source.lens.cy_px) / source.lens.height_px * 2 - 1
    grid = torch.stack([u, v], -1).clamp(-2, 2)[None]
    nearest = F.grid_sample(source.depth[None, None].to(z), grid, "nearest", "zeros", align_corners=False)[0, 0]
    hidden = (nearest > 0) & (z > nearest * (1 + HIDDEN_SHARE) + HIDDEN_M)
    seen = ahead & (u.abs() < 1) & (v.abs() < 1) & ~hidden
    color = F.grid_sample(source.image[None].to(z), grid, "bilinear", "border", align_corners=False)[0]
    return color, seen


def _as_exposed(points: Tensor, source: SourceImage) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """x, y, z [...] such that x/z and y/z are where a plain lens would show camera coordinates [..., 3]; which may be.

    With the source's distortion, and from where its camera is when a point's row is exposed; actors rest meanwhile.
    """
    x, y, z = points.unbind(-1)
    if source.shutter is None and not any(source.lens.distortion):
        return x, y, z, torch.ones_like(z, dtype=torch.bool)
    cameras = Cameras.of([np.eye(4)], [source.lens], shutters=[source.shutter])
    camera = OneCamera(cameras, 0, points)
    safe = torch.where((z > _NEAREST_M)[..., None], points, torch.ones_like(points)).flatten(0, -2)
    exposed = camera.exposed(safe, None)
    bent = camera.bent(exposed[:, 0] / exposed[:, 2], exposed[:, 1] / exposed[:, 2])
    then = torch.where(z > _NEAREST_M, exposed[:, 2].view(z.shape), z)
    may = (camera.unfolded(safe) & camera.unfolded(exposed)).view(z.shape)
    return bent[0].view(z.shape) * then, bent[1].view(z.shape) * then, then, may


def warp(surface: Surface, sources: Sequence[SourceImage], actors: Sequence[Actor], frame: int) -> Warp:
    """Each pixel from the first of ``sources`` that sees its point. Raises ``ValueError`` for no source."""
    if not sources:
        raise ValueError("expected at least one source image")
    first = torch.zeros(3, *surface.known.shape).to(surface.points)
    mask = torch.zeros_like(surface.known)
    differing, others = torch.zeros_like(first[0]), torch.zeros_like(first[0])
    for source in sources:
        color, seen = look_up(surface, source, actors, frame)
        again = (seen & mask).to(first)
        differing += again * (color - first).abs().mean(0)
        others += again
        first = torch.where(seen & ~mask, color, first)
        mask = mask | seen
    return Warp(first, mask[None].to(first), (differing / others.clamp_min(1))[None])


def choose(
    surface: Surface,
    sources: Sequence[SourceImage],
    reference: tuple[str, int],
    actors: Sequence[Actor],
    frame: int,
    count: int = SOURCES,
) -> list[SourceImage]:
    """At most ``count`` of the sources: the reference, then each time the one that sees most of what is still unseen.

    Judged on a coarse grid of pixels; of equals the earlier one in ``sources``. Raises ``ValueError`` for a stranger.
    """
    found = [s for s in sources if (s.camera, s.frame) == reference]
    if not found:
        raise ValueError(f"the reference {reference} is none of the sources")
    coarse = _coarse(surface)
    chosen, rest = found[:1], [s for s in sources if s is not found[0]]
    unseen = coarse.known & ~look_up(coarse, chosen[0], actors, frame)[1]
    each = [look_up(coarse, s, actors, frame)[1] for s in rest]
    while len(chosen) < count and rest:
        fresh = [int((seen & unseen).sum()) for seen in each]
        best = int(np.argmax(fresh))
        if fresh[best] < max(1, _FRESH * coarse.known.numel()):
            break
        unseen &= ~each.pop(best)
        chosen.append(rest.pop(best))
    return chosen


def unseen_share(
    surface: Surface, alpha: Tensor, sources: Sequence[SourceImage], actors: Sequence[Actor], frame: int
) -> float:
    """The share of a view's light that is missing (1 − ``alpha`` [H, W]) or comes from points that no image shows.

    Judged on a coarse grid of pixels.
    """
    coarse, light = _coarse(surface), _thinned(alpha)
    seen = torch.zeros_like(coarse.known)
    for source in sources:
        seen |= look_up(coarse, source, actors, frame)[1]
    return float(1 - (light.clamp(0, 1) * seen).mean())


def _coarse(surface: Surface) -> Surface:
    return Surface(_thinned(surface.points), _thinned(surface.known), _thinned(surface.on))


def _thinned(image: Tensor) -> Tensor:
    """Every eighth pixel of [H, W, …], from the middle of its cell; the middle row and column of a small image."""
    rows, columns = (slice(min(_COARSE, n) // 2, None, _COARSE) for n in image.shape[:2])
    return image[rows, columns]


def _moved(points: Tensor, transform: NDArray[np.floating[Any]]) -> Tensor:
    matrix = torch.as_tensor(transform).to(points)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _pose_at(actor: Actor, frame: int) -> Float64 | None:
    at = np.flatnonzero(actor.frames == frame)
    return actor.chunk_SE3_box[at[0]] if len(at) else None


def _actor_of(points: Tensor, known: Tensor, actors: Sequence[Actor], frame: int) -> Tensor:
    """The actor whose box at ``frame`` holds the point, −1 for none."""
    on = torch.full(known.shape, -1)
    for k, actor in enumerate(actors):
        pose = _pose_at(actor, frame)
        if pose is None:
            continue
        half = torch.tensor(actor.size_m).to(points) / 2 * _BOX_MARGIN
        centre = torch.as_tensor(pose[:3, 3]).to(points)
        near = known & ((points - centre).abs().amax(-1) < half.norm())
        if bool(near.any()):
            local = _moved(points[near], np.linalg.inv(pose))
            on[near] = torch.where((local.abs() < half).all(-1), torch.tensor(k), on[near])
    return on


def _at_frame(surface: Surface, actors: Sequence[Actor], frame: int, other: int) -> tuple[Tensor, Tensor]:
    """The points where they are at log frame ``other``, and which of them exist then."""
    points, there = surface.points, surface.known
    if other == frame:
        return points, there
    for k in torch.unique(surface.on).tolist():
        if k < 0:
            continue
        mine = surface.on == k
        pose, then = _pose_at(actors[k], frame), _pose_at(actors[k], other)
        if pose is None or then is None:
            there = there & ~mine
            continue
        points = points.clone()
        points[mine] = _moved(points[mine], then @ np.linalg.inv(pose))
    return points, there
