"""Checks of what a renderer is given, before any backend sees it."""

from __future__ import annotations

from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.render.types import Cameras, VisibleRanges
from genre_tasks.scene.gaussians import Splats


def check_ranges(visible: VisibleRanges, gaussians: int, views: int) -> None:
    """Checks that each view's range lies behind the shared Gaussians and within all of them.

    Args:
        visible: which Gaussians each view shows.
        gaussians: their number.
        views: number of cameras.

    Raises:
        ValueError: it does not fit.
    """
    # The kernel reads these ranges unchecked.
    in_order = all(visible.shared <= begin <= end <= gaussians for begin, end in visible.per_view)
    if len(visible.per_view) != views or not in_order or not 0 <= visible.shared <= gaussians:
        raise ValueError(f"expected ranges of {gaussians} Gaussians for {views} views, got {visible}")


def check_shapes(splats: Splats, cameras: Cameras) -> None:
    """Checks splats and cameras against each other.

    Args:
        splats: N of them.
        cameras: V of them.

    Raises:
        ValueError: a tensor has another shape than expected, the image is empty, or a readout is negative.
        NonFiniteError: a camera is not finite.
    """
    # The kernel reads raw pointers: a tensor of another shape would not raise there but be read beyond its end.
    n = len(splats)
    v = len(cameras)
    colors = (v, n, 3) if splats.colors.dim() == 3 else (n, 3)
    expected: dict[str, tuple[Tensor | None, tuple[int, ...]]] = {
        "means": (splats.means, (n, 3)),
        "scales": (splats.scales, (n, 3)),
        "quats": (splats.quats, (n, 4)),
        "opacities": (splats.opacities, (n,)),
        "colors": (splats.colors, colors),
        "camera_SE3_chunk": (cameras.camera_SE3_chunk, (v, 4, 4)),
        "focal_px": (cameras.focal_px, (v, 2)),
        "center_px": (cameras.center_px, (v, 2)),
        "velocities": (splats.velocities, (n, 3)),
        "distortion": (cameras.distortion, (v, 5)),
    }
    shutter = cameras.shutter
    if shutter is not None:
        expected["readout_s"] = shutter.readout_s, (v,)
        expected["velocity_m_s"] = shutter.velocity_m_s, (v, 3)
        expected["turn_rad_s"] = shutter.turn_rad_s, (v, 3)
    for name, (tensor, shape) in expected.items():
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"expected {name} of shape {shape}, got {tuple(tensor.shape)}")
    if cameras.width_px < 1 or cameras.height_px < 1:
        raise ValueError(f"expected an image of at least 1 × 1, got {cameras.width_px} × {cameras.height_px}")
    # A camera that is not finite would cull every Gaussian, and the image would just be empty.
    check_cameras_finite(cameras)
    if shutter is not None and bool((shutter.readout_s < 0).any()):
        raise ValueError(f"expected readout_s of at least 0, got {float(shutter.readout_s.min())}")


def check_cameras_finite(cameras: Cameras) -> None:
    """Stops at a camera that is not finite; Gaussians that are not are culled instead.

    Args:
        cameras: V of them.

    Raises:
        NonFiniteError: with the tensor's name and the first index.
    """
    for name, tensor in cameras.tensors().items():
        check_finite(tensor, name, "render")


def check_gradients(backend: str, splats: Splats, cameras: Cameras) -> None:
    """Refuses a gradient that only the reference backend has.

    Args:
        backend: its name.
        splats: N of them.
        cameras: V of them; a gradient in their poses is fine.

    Raises:
        ValueError: another tensor of the cameras, or the velocities, requires grad.
    """
    # A gradient that is silently missing would look like an optimisation that has converged.
    inputs = cameras.tensors() | ({} if splats.velocities is None else {"velocities": splats.velocities})
    for name, tensor in inputs.items():
        if tensor.requires_grad and name != "camera_SE3_chunk":
            raise ValueError(f"backend {backend} has no gradient in {name}; use reference")
