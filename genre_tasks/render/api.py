"""The one function that renders, whatever the backend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import RollingShutter
from genre_tasks.render.input_checks import check_cameras_finite, check_gradients, check_ranges, check_shapes
from genre_tasks.render.motion_blur import BlurSamples, PosedView
from genre_tasks.render.types import Cameras, Render, RenderSettings, VisibleRanges
from genre_tasks.scene.gaussians import Splats
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.rotations import matrices_to_quats, multiply_quats

DEFAULT_SETTINGS = RenderSettings()


def render(
    splats: Splats,
    cameras: Cameras,
    settings: RenderSettings = DEFAULT_SETTINGS,
    visible: VisibleRanges | None = None,
) -> Render:
    """Renders N Gaussians at V cameras; N and V may be 0.

    Differentiable in means, scales, quaternions, opacities and colours, and in ``cameras.camera_SE3_chunk`` (as a
    rigid motion; the motion during a readout is constant in camera axes) where it requires grad.

    Some Gaussians are left out, get zero gradient, and are counted in ``Render.culled``: those with a non-finite value
    or a quaternion without direction; those that are not ahead of a camera both at its pose's time and when their row
    is read out (``behind``); those that lie where a lens's distortion folds back (``folded``).

    Args:
        splats: N Gaussians; their colours may differ from view to view, [V, N, 3].
        cameras: V of one image size.
        settings: backend and threads. The ``cpu`` backend gives the same bits at any number of threads and of views a
            call.
        visible: which Gaussians each view shows; ``None``: all.

    Returns:
        V images.

    Raises:
        ValueError: a tensor has another shape than expected, ``visible`` does not fit, or a gradient is asked for that
            the backend does not have.
        NonFiniteError: a camera is not finite.
        ResourceError: the backend is not installed, or memory does not suffice.
        ConfigError: the backend cannot render such a camera.

    >>> from genre_tasks.logs.types import Lens
    >>> from genre_tasks.scene.gaussians import Gaussians
    >>> lens = Lens(fx_px=16.0, fy_px=16.0, cx_px=8.0, cy_px=8.0, width_px=16, height_px=16)
    >>> cameras = Cameras.from_poses([np.eye(4)], [lens])
    >>> one = torch.tensor([[0.0, 0.0, 5.0, -1.0, -1.0, -1.0, 1.0, 0.0, 0.0, 0.0, 2.0, 1.0, 0.0, 0.0]])
    >>> image = render(Gaussians.unpack(one).activate(), cameras, RenderSettings("reference"))
    >>> image.color.shape, bool(image.alpha[0, 8, 8] > image.alpha[0, 0, 0])
    (torch.Size([1, 16, 16, 3]), True)
    """
    check_shapes(splats, cameras)
    backend = settings.backend
    if backend == "auto":
        backend = "cpu" if splats.means.device.type == "cpu" else "cuda"
    if visible is None:
        visible = VisibleRanges.everything(len(splats), len(cameras))
    else:
        check_ranges(visible, len(splats), len(cameras))
    if backend != "reference":
        check_gradients(backend, splats, cameras)
    if backend == "cpu":
        return _render_on_cpu(splats, cameras, settings.threads, visible)
    return _render_in_groups(backend, splats, cameras, visible)


def _render_in_groups(backend: str, splats: Splats, cameras: Cameras, visible: VisibleRanges) -> Render:
    # The other backends show all that they are given to all cameras, so views with the same Gaussians go together.
    colors_by_view = splats.colors.dim() == 3
    if not len(cameras):
        # There is no view whose colours could be taken.
        colors = splats.means.new_zeros(splats.means.shape) if colors_by_view else splats.colors
        return _render_elsewhere(backend, replace(splats, colors=colors), cameras)
    groups: dict[tuple[int, int, int], list[int]] = {}
    for v, (begin, end) in enumerate(visible.per_view):
        groups.setdefault((begin, end, v if colors_by_view else -1), []).append(v)
    if all(begin == end for begin, end, _ in groups) and visible.shared == len(splats) and not colors_by_view:
        return _render_elsewhere(backend, splats, cameras)
    parts = []
    for (begin, end, v), members in groups.items():
        rows = torch.cat([torch.arange(visible.shared), torch.arange(begin, end)]).to(splats.means.device)
        view_splats = replace(splats, colors=splats.colors[v]) if colors_by_view else splats
        parts.append(_render_elsewhere(backend, view_splats.select(rows), cameras.select(members)))
    return concatenate_renders(parts, [v for members in groups.values() for v in members])


def render_views(
    scene: SceneGraph,
    views: Sequence[PosedView],
    settings: RenderSettings = DEFAULT_SETTINGS,
    colors: Tensor | None = None,
) -> Render:
    """Renders a scene graph at views; actors are where they are at each view's log frame.

    While a view with a rolling shutter is read out, actors move on as from frame to frame. A view with motion blur has
    the mean colour of several moments, and alpha and depth of its pose's own time.

    Args:
        scene: N Gaussians.
        views: V of one image size.
        settings: backend and threads.
        colors: those of :func:`compute_view_colors`, where they are at hand.

    Returns:
        V images, in the order of the views.

    Raises:
        ValueError, NonFiniteError, ResourceError, ConfigError: as :func:`render`.
    """
    blur_samples = BlurSamples.from_views(views)
    if blur_samples is not None:
        return blur_samples.average(render_views(scene, blur_samples.views, settings))
    # Each distinct frame is posed once, however many views it has, and all views go into one call: the kernel shares
    # their set-up and keeps every thread busy.
    cameras = build_cameras(views, scene.antialiased)
    frames = [v.frame for v in views]
    posed, moving = scene.gaussians_at_frames(list(dict.fromkeys(frames)))
    visible = VisibleRanges.for_frames(len(scene) - len(moving), len(moving), frames)
    # Activated after posing: an absent actor is hidden by its logit, which has no gradient then.
    splats = replace(posed.activate(), velocities=compute_actor_velocities(scene, posed.means, views))
    if scene.spherical_harmonics is not None:
        splats = replace(splats, colors=compute_view_colors(scene, views) if colors is None else colors)
    return render(splats, cameras.to_device_of(scene.gaussians.means), settings, visible)


def compute_view_colors(scene: SceneGraph, views: Sequence[PosedView]) -> Tensor:
    """Computes what each view sees of a scene with spherical harmonics.

    Args:
        scene: with spherical harmonics.
        views: V of them.

    Returns:
        [V, N', 3], laid out as by ``SceneGraph.gaussians_at_frames``.

    Raises:
        ValueError: the scene has no spherical harmonics.
    """
    # Imported here: most scenes have no spherical harmonics, and do without this module.
    from genre_tasks.render.spherical_harmonics import compute_view_dependent_colors

    centres = np.stack([v.chunk_SE3_camera[:3, 3] for v in views])
    return compute_view_dependent_colors(scene, [v.frame for v in views], centres)


def compute_actor_velocities(scene: SceneGraph, means: Tensor, views: Sequence[PosedView]) -> Tensor | None:
    """Computes how actors move while views are read out, as ``Splats.velocities``.

    Args:
        scene: with its actors.
        means: [N', 3] metres, laid out as by ``SceneGraph.gaussians_at_frames`` at the views' frames.
        views: with their shutters.

    Returns:
        [N', 3] m/s in chunk axes; ``None`` where nothing moves, or no view's shutter asks for it.

    Raises:
        ValueError: shutters at one frame do not agree on the time to the next frame.
    """
    # Views of one frame share its posed Gaussians, and so one velocity each.
    frames_s: dict[float, float] = dict.fromkeys((v.frame for v in views), 0.0)
    for view in views:
        stated = _frame_s_of(view)
        if stated and frames_s[view.frame] not in (0.0, stated):
            raise ValueError(f"expected one frame_s at frame {view.frame}, got {frames_s[view.frame]} and {stated}")
        frames_s[view.frame] = stated or frames_s[view.frame]
    if not scene.actors or not any(frames_s.values()):
        return None
    return scene.velocities_at_frames(means, list(frames_s), list(frames_s.values()))


def with_shutter_velocities(splats: Splats, scene: SceneGraph, view: PosedView) -> Splats:
    """Gives splats the velocities that a view's shutter asks for.

    Args:
        splats: of ``scene.gaussians_at(view.frame)``.
        scene: with its actors.
        view: with or without a shutter.

    Returns:
        ``splats`` itself where nothing moves.
    """
    frame_s = _frame_s_of(view)
    if not scene.actors or not frame_s:
        return splats
    return replace(splats, velocities=scene.velocities_at(splats.means, view.frame, frame_s))


def _frame_s_of(view: PosedView) -> float:
    # Seconds to the next log frame where actors move while a view is read out, else 0.
    shutter = _shutter_of(view)
    return shutter.frame_s if shutter is not None and shutter.readout_s else 0.0


def _shutter_of(view: PosedView) -> RollingShutter | None:
    return getattr(view, "shutter", None)


def build_cameras(views: Sequence[PosedView], antialiased: bool = False) -> Cameras:
    """Collects the cameras of views.

    Args:
        views: V of one image size.
        antialiased: whether the scene to render is.

    Raises:
        NonFiniteError: a camera is not finite.
        ValueError: the views have several image sizes.
    """
    cameras = Cameras.from_poses(
        [v.chunk_SE3_camera for v in views],
        [v.lens for v in views],
        shutters=[_shutter_of(v) for v in views],
        antialiased=antialiased,
    )
    check_cameras_finite(cameras)
    return cameras


def concatenate_renders(parts: Sequence[Render], views: Sequence[int]) -> Render:
    """Puts renders of several views together as one.

    Args:
        parts: renders.
        views: for each image, one part after the other, which view it is of.

    Returns:
        The images in the order of the views; culled counts are summed.
    """
    # Sorting a permutation inverts it.
    order = torch.argsort(torch.tensor(views))
    color, alpha, depth = (torch.cat([getattr(p, n) for p in parts])[order] for n in ("color", "alpha", "depth"))
    counts = [p.culled for p in parts]
    reasons = dict.fromkeys(reason for c in counts for reason in c)
    return Render(color, alpha, depth, {reason: sum(c.get(reason, 0) for c in counts) for reason in reasons})


def _render_on_cpu(splats: Splats, cameras: Cameras, threads: int | None, visible: VisibleRanges) -> Render:
    from genre_tasks.render.cpu import render_cpu

    wants_pose_gradient = cameras.camera_SE3_chunk.requires_grad and torch.is_grad_enabled()
    # Without views there is no pose that could have a gradient, and nothing to put together.
    if not (wants_pose_gradient and len(cameras)):
        return _result(*render_cpu(splats, cameras, visible, threads))
    parts = []
    # The kernel has no gradient in poses. In the frame of one camera the Gaussians move instead, which autograd
    # follows; so these views are rendered one by one.
    for v in range(len(cameras)):
        view_splats, camera = _take_to_camera_frame(splats, cameras, v)
        parts.append(_result(*render_cpu(view_splats, camera, visible.for_view(v), threads)))
    return concatenate_renders(parts, range(len(parts)))


def _render_elsewhere(backend: str, splats: Splats, cameras: Cameras) -> Render:
    if backend == "reference":
        from genre_tasks.render.reference import render_reference

        return _result(*render_reference(splats, cameras))
    # gsplat does not promise to take empty tensors.
    if not (len(splats) and len(cameras)):
        return _render_nothing(splats, cameras)
    from genre_tasks.render.cuda import render_cuda

    return _result(*render_cuda(splats, cameras))


def _render_nothing(splats: Splats, cameras: Cameras) -> Render:
    """V images without any Gaussian; gradients of all inputs are zero, as where Gaussians are out of sight."""
    inputs = (splats.means, splats.scales, splats.quats, splats.opacities, splats.colors, cameras.camera_SE3_chunk)
    # Of empty slices alone: an input that is not finite would make zero times itself NaN.
    nothing = torch.stack([x[:0].sum().to(splats.means.device, torch.float32) for x in inputs]).sum()
    size = (len(cameras), cameras.height_px, cameras.width_px)
    color, alpha, depth = (nothing.expand(*shape).clone() for shape in ((*size, 3), size, size))
    return Render(color, alpha, depth, {})


def _result(images: tuple[Tensor, Tensor, Tensor], culled: dict[str, int]) -> Render:
    return Render(*images, culled)


def _take_to_camera_frame(splats: Splats, cameras: Cameras, v: int) -> tuple[Splats, Cameras]:
    # The splats in coordinates of camera v, and that camera at the origin, so that autograd reaches the pose.
    # The rotation's gradient goes through a small turn next to the constant rotation, whose quaternion is (1, ω/2) to
    # first order: exact for rigid motions, and without the square roots of a matrix-to-quaternion conversion.
    # Velocities are constants.
    splats = _replace_non_finite_poses(splats)
    pose = cameras.camera_SE3_chunk[v]
    rotation = pose[:3, :3]
    turn = rotation @ rotation.detach().T  # the identity, with a gradient
    omega = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    delta = torch.cat([omega.new_ones(1), omega / 2])
    turn_quat = multiply_quats(delta, matrices_to_quats(rotation.detach()))
    quats = multiply_quats(turn_quat.to(splats.quats.dtype).expand(len(splats), 4), splats.quats)
    # Poses may be more precise than the splats, whose dtype the kernel expects.
    dtype = splats.means.dtype
    means = splats.means @ rotation.T.to(dtype) + pose[:3, 3].to(dtype)
    velocities = None if splats.velocities is None else splats.velocities @ rotation.detach().T.to(dtype)
    colors = splats.colors[v : v + 1] if splats.colors.dim() == 3 else splats.colors
    moved = replace(splats, means=means, quats=quats, colors=colors, velocities=velocities)
    return moved, replace(cameras.select([v]), camera_SE3_chunk=torch.eye(4)[None])


def _replace_non_finite_poses(splats: Splats) -> Splats:
    """Moves Gaussians without a finite place or turn to the origin, where the NaN of their opacity still culls them.

    Their gradient of 0 times NaN would be NaN in the gradient of the camera's pose.
    """
    finite = torch.isfinite(splats.means).all(1) & torch.isfinite(splats.quats).all(1)
    if bool(finite.all()):
        return splats
    return replace(
        splats,
        means=torch.where(finite[:, None], splats.means, 0.0),
        quats=torch.where(finite[:, None], splats.quats, 0.0),
        opacities=torch.where(finite, splats.opacities, torch.nan),
    )
