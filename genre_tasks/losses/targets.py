"""What the renders are compared with: one target per supervised view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64, Lens, MotionBlur, RollingShutter
from genre_tasks.losses.ssim import SsimTarget
from genre_tasks.scene.chunk import Chunk, Gain, View
from genre_tasks.scene.image_decoding import decode_image
from genre_tasks.scene.novel_views import FixedViews


@dataclass(frozen=True)
class Target:
    """A view that supervises.

    ``image`` [H, W, 3] sRGB float32 with its SSIM terms; ``depth`` [H, W] metres along the optical axis, 0 where the
    LiDAR returned nothing, or ``None`` where depth does not supervise (novel views, paper Eq. 11). ``log_gain``,
    ``own`` [H, W], ``shutter`` and ``blur``: as a ``View`` has them.
    """

    camera: str
    frame: int
    chunk_SE3_camera: Float64  # [4, 4]
    lens: Lens
    image: SsimTarget
    depth: Tensor | None = None
    novel: bool = False
    log_gain: Gain | None = None
    own: Tensor | None = None
    shutter: RollingShutter | None = None
    blur: MotionBlur | None = None


def of_views(chunk: Chunk, views: Sequence[View], depth: bool = False) -> tuple[Target, ...]:
    """Targets of a chunk's own views, in order; images are decoded at the working resolution.

    ``depth``: LiDAR depth supervises too. Raises ``InputError`` for an unreadable image.
    """
    from genre_tasks.scene.lidar_depth import lidar_depth

    out = []
    for view in views:
        try:
            image = decode_image(view.image, view.lens.width_px, view.lens.height_px)
        except InputError as error:
            where = {"log": chunk.log, "chunk": chunk.index, "camera": view.camera, "frame": view.frame}
            raise InputError(error.problem, remedy=error.remedy, **where) from error  # type: ignore[arg-type]
        sparse = torch.as_tensor(lidar_depth(chunk, view)).float() if depth else None
        own = None if view.own is None else torch.from_numpy(view.own)
        pose, seen = view.chunk_SE3_camera, SsimTarget.of(image)
        said = view.log_gain, own, view.shutter, view.blur
        out.append(Target(view.camera, view.frame, pose, view.lens, seen, sparse, False, *said))
    return tuple(out)


def of_source(chunk: Chunk, depth: bool) -> tuple[Target, ...]:
    """Targets of the chunk's source views. Raises ``InputError`` where there are none."""
    views = chunk.of_role("source")
    if not views:
        raise InputError(
            "The chunk has no source view to optimise against",
            remedy="Give a log whose source frames have images (genre check says which are missing).",
            log=chunk.log,
            chunk=chunk.index,
        )
    return of_views(chunk, views, depth)


def of_fixed(fixed: FixedViews) -> tuple[Target, ...]:
    """Targets of fixed novel views (no depth)."""
    return tuple(
        Target(v.camera, v.frame, v.chunk_SE3_camera, v.lens, SsimTarget.of(color.float().contiguous()), None, True)
        for v, color in zip(fixed.views, fixed.color, strict=True)
    )
