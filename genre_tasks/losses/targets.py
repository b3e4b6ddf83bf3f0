"""What renders are compared with: one target for each supervised view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from genre_tasks.errors import InputError
from genre_tasks.image_memory import allocate_images
from genre_tasks.logs.types import Float64, Lens, MotionBlur, RollingShutter
from genre_tasks.losses.ssim import SsimTarget
from genre_tasks.scene.chunk import Chunk, Gain, View
from genre_tasks.scene.image_decoding import decode_image
from genre_tasks.scene.lidar_depth import compute_lidar_depth
from genre_tasks.scene.novel_views import FixedViews
from genre_tasks.threads import map_single_threaded


@dataclass(frozen=True)
class Target:
    """One supervised view: where its camera is, and what a render from there should show.

    Attributes:
        camera: name of the camera.
        frame: the log's frame.
        chunk_SE3_camera: [4, 4] pose of the camera in chunk coordinates.
        lens: the camera's lens at the working resolution.
        image: the image [H, W, 3], sRGB in [0, 1], with the statistics that SSIM needs of it.
        depth: [H, W] metres along the optical axis, 0 where the LiDAR returned nothing. ``None``: depth does not
            supervise this view (as in novel views, paper Eq. 11).
        novel: the view was rendered and fixed, not recorded.
        log_gain: the image's log gain per channel in linear light, which a render gets before it is compared.
        ego_mask: [H, W] true where the ego vehicle itself is in the image; these pixels have no loss.
        shutter: motion of the camera while the image is read out; ``None``: a global shutter.
        blur: motion of the camera while the image is exposed; ``None``: a sharp image.
    """

    camera: str
    frame: int
    chunk_SE3_camera: Float64
    lens: Lens
    image: SsimTarget
    # Everything below has a default: a fixed novel view knows nothing of it.
    depth: Tensor | None = None
    novel: bool = False
    log_gain: Gain | None = None
    ego_mask: Tensor | None = None
    shutter: RollingShutter | None = None
    blur: MotionBlur | None = None


def view_targets(chunk: Chunk, views: Sequence[View], depth: bool = False) -> tuple[Target, ...]:
    """Decodes recorded views of a chunk into targets at the working resolution.

    Args:
        chunk: the chunk that the views belong to.
        views: V views of it.
        depth: whether LiDAR depth supervises too.

    Returns:
        V targets in the order of ``views``.

    Raises:
        InputError: an image cannot be decoded; the error names its camera and frame.
    """

    images = allocate_images(len(views), chunk.height_px, chunk.width_px, 3)
    depths = allocate_images(len(views), chunk.height_px, chunk.width_px) if depth else None

    def decode(index: int) -> Target:
        view = views[index]
        try:
            images[index] = decode_image(view.image, view.lens.width_px, view.lens.height_px)
        except InputError as error:
            # The decoder knows bytes only; the user needs to know which image it is.
            where = {"log": chunk.log, "chunk": chunk.index, "camera": view.camera, "frame": view.frame}
            raise InputError(error.problem, remedy=error.remedy, **where) from error  # type: ignore[arg-type]
        if depths is not None:
            depths[index] = compute_lidar_depth(chunk, view)
            if view.ego_mask is not None:
                # Returns behind the vehicle would count in the mean without a gradient.
                depths[index][torch.from_numpy(view.ego_mask)] = 0.0
        return Target(
            camera=view.camera,
            frame=view.frame,
            chunk_SE3_camera=view.chunk_SE3_camera,
            lens=view.lens,
            image=SsimTarget.of_many(images[index]),
            depth=None if depths is None else depths[index],
            # How the image was taken goes along, so that the render can be made in the same way.
            log_gain=view.log_gain,
            ego_mask=None if view.ego_mask is None else torch.from_numpy(view.ego_mask),
            shutter=view.shutter,
            blur=view.blur,
        )

    return tuple(map_single_threaded(decode, range(len(views))))


def source_targets(chunk: Chunk, depth: bool) -> tuple[Target, ...]:
    """Decodes the views that a scene is reconstructed from into targets.

    Args:
        chunk: the chunk whose source views are taken.
        depth: whether LiDAR depth supervises too.

    Returns:
        One target for each source view, in the chunk's order.

    Raises:
        InputError: the chunk has no source view, or an image cannot be decoded.
    """
    # Without a source view a loss would be a mean over nothing, that is NaN.
    views = chunk.views_with_role("source")
    if not views:
        raise InputError(
            "The chunk has no source view to optimise against",
            remedy="Give a log whose source frames have images (genre check says which are missing).",
            log=chunk.log,
            chunk=chunk.index,
        )
    return view_targets(chunk, views, depth)


def novel_targets(fixed: FixedViews) -> tuple[Target, ...]:
    """Turns novel views that the fixer has repaired into targets.

    Args:
        fixed: V views with their fixed colours.

    Returns:
        V targets without depth, in the order of ``fixed.views``.
    """
    return tuple(
        Target(
            camera=view.camera,
            frame=view.frame,
            chunk_SE3_camera=view.chunk_SE3_camera,
            lens=view.lens,
            # The store has half floats, the losses compute in float32. No depth: LiDAR never measured a fixed view.
            image=SsimTarget.of_many(color.float().contiguous()),
            novel=True,
        )
        for view, color in zip(fixed.views, fixed.color, strict=True)
    )
