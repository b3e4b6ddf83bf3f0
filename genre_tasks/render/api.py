"""The one function that renders, whatever the backend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.errors import NonFiniteError
from genre_tasks.logs.types import RollingShutter
from genre_tasks.render.motion_blur import Moments, PosedView
from genre_tasks.render.types import Cameras, Render, RenderSettings, Shown
from genre_tasks.scene.gaussians import Splats
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.transforms import matrix_to_quat, quat_multiply

DEFAULT = RenderSettings()


def render(splats: Splats, cameras: Cameras, settings: RenderSettings = DEFAULT, shown: Shown | None = None) -> Render:
    """Renders N Gaussians at V cameras; N and V may be 0. ``shown`` says which of them each view has; default: all.

    Differentiable in means, scales, quaternions, opacities and colours, and in ``cameras.camera_SE3_chunk`` (as a
    rigid motion: three translations, three rotations; the motion during a readout is constant in camera axes) where it
    requires grad. Colour is premultiplied, depth is Σ w z. A Gaussian with a non-finite value or a quaternion without
    direction is left out, gets zero gradient, and is counted in ``Render.culled``; so is one that is not ahead of a
    camera both at its pose's time and when its row is read out (``behind``), or that lies where a lens's distortion
    folds back (``folded``). The ``cpu`` backend gives the same bits at any number of threads and of views a call.

    Colours may differ from view to view: [V, N, 3].

    Raises:
        ValueError: a tensor has another shape than expected, ``shown`` does not fit, or a gradient is asked for that
            the backend does not have.
        NonFiniteError: a camera is not finite.
        ResourceError: the backend is not installed, or memory does not suffice.
        ConfigError: the backend cannot render such a camera.
    """
    _check_shapes(splats, cameras)
    backend = settings.backend
    if backend == "auto":
        backend = "cpu" if splats.means.device.type == "cpu" else "cuda"
    if shown is None:
        shown = Shown.all_of(len(splats), len(cameras))
    else:
        _check_shown(shown, len(splats), len(cameras))
    if backend != "reference":
        _check_gradients(backend, splats, cameras)
    if backend == "cpu":
        return _on_cpu(splats, cameras, settings.threads, shown)
    by_view = splats.colors.dim() == 3
    groups: dict[tuple[int, int, int], list[int]] = {}
    for v, own in enumerate(shown.own):
        groups.setdefault((*own, v if by_view else -1), []).append(v)
    if all(begin == end for begin, end, _ in groups) and shown.shared == len(splats) and not by_view:
        return _elsewhere(backend, splats, cameras)
    parts = []
    for (begin, end, v), members in groups.items():
        rows = torch.cat([torch.arange(shown.shared), torch.arange(begin, end)]).to(splats.means.device)
        own_splats = replace(splats, colors=splats.colors[v]) if by_view else splats
        parts.append(_elsewhere(backend, own_splats.select(rows), cameras.select(members)))
    return in_order(parts, [v for members in groups.values() for v in members])


def render_views(
    scene: SceneGraph, views: Sequence[PosedView], settings: RenderSettings = DEFAULT, colors: Tensor | None = None
) -> Render:
    """Renders a scene graph at views of one image size, in their order; actors stand where their frame puts them.

    While a view with a rolling shutter is read out, actors move on as from frame to frame. A view with motion blur has
    the mean colour of several moments, and alpha and depth of its pose's own time. ``colors``: those of
    :func:`colors_of`, where they are at hand. Raises as :func:`render`.
    """
    moments = Moments.of(views)
    if moments is not None:
        return moments.recorded(render_views(scene, moments.views, settings))
    cameras = cameras_of(views, scene.antialiased)
    frames = [v.frame for v in views]
    posed, moving = scene.posed(list(dict.fromkeys(frames)))
    shown = Shown.of_frames(len(scene) - len(moving), len(moving), frames)
    splats = replace(posed.activated(), velocities=velocities_of(scene, posed.means, views))
    if scene.harmonics is not None:
        splats = replace(splats, colors=colors_of(scene, views) if colors is None else colors)
    return render(splats, on_device_of(cameras, scene.gaussians.means), settings, shown)


def colors_of(scene: SceneGraph, views: Sequence[PosedView]) -> Tensor:
    """What each view sees of a scene with harmonics, [V, N, 3], laid out as by ``SceneGraph.posed``."""
    from genre_tasks.render.spherical_harmonics import seen_colors

    return seen_colors(scene, [v.frame for v in views], np.stack([v.chunk_SE3_camera[:3, 3] for v in views]))


def velocities_of(scene: SceneGraph, means: Tensor, views: Sequence[PosedView]) -> Tensor | None:
    """How actors move while views are read out, as ``Splats.velocities``; ``None`` where no view's shutter asks.

    ``means`` are laid out as by ``SceneGraph.posed`` at the views' frames. Raises ``ValueError`` for shutters that do
    not agree on the time to the next frame.
    """
    frames_s: dict[float, float] = dict.fromkeys((v.frame for v in views), 0.0)
    for view in views:
        stated = _frame_s_of(view)
        if stated and frames_s[view.frame] not in (0.0, stated):
            raise ValueError(f"expected one frame_s at frame {view.frame}, got {frames_s[view.frame]} and {stated}")
        frames_s[view.frame] = stated or frames_s[view.frame]
    if not scene.actors or not any(frames_s.values()):
        return None
    return scene.velocities(means, list(frames_s), list(frames_s.values()))


def moving(splats: Splats, scene: SceneGraph, view: PosedView) -> Splats:
    """The splats of ``scene.at(view.frame)``, with velocities where the view's shutter asks for them."""
    frame_s = _frame_s_of(view)
    if not scene.actors or not frame_s:
        return splats
    return replace(splats, velocities=scene.velocities_at(splats.means, view.frame, frame_s))


def _frame_s_of(view: PosedView) -> float:
    """Seconds to the next log frame where actors move while a view is read out, else 0."""
    shutter = _shutter_of(view)
    return shutter.frame_s if shutter is not None and shutter.readout_s else 0.0


def _shutter_of(view: PosedView) -> RollingShutter | None:
    return getattr(view, "shutter", None)


def cameras_of(views: Sequence[PosedView], antialiased: bool = False) -> Cameras:
    """The cameras of views, of a scene that is ``antialiased`` or not.

    Raises ``NonFiniteError`` for one that is not finite, ``ValueError`` for mixed sizes.
    """
    poses, lenses = [v.chunk_SE3_camera for v in views], [v.lens for v in views]
    cameras = Cameras.of(poses, lenses, shutters=[_shutter_of(v) for v in views], antialiased=antialiased)
    _check_finite(cameras)
    return cameras


def _on_cpu(splats: Splats, cameras: Cameras, threads: int | None, shown: Shown) -> Render:
    from genre_tasks.render.cpu import render_cpu

    if not (cameras.camera_SE3_chunk.requires_grad and torch.is_grad_enabled()):
        return _result(*render_cpu(splats, cameras, shown, threads))
    parts = [
        _result(*render_cpu(*_in_camera_frame(splats, cameras, v), shown.of(v), threads)) for v in range(len(cameras))
    ]
    return in_order(parts, range(len(parts)))


def _elsewhere(backend: str, splats: Splats, cameras: Cameras) -> Render:
    if backend == "reference":
        from genre_tasks.render.reference import render_reference

        return _result(*render_reference(splats, cameras))
    from genre_tasks.render.cuda import render_cuda

    return _result(*render_cuda(splats, cameras))


def in_order(parts: Sequence[Render], views: Sequence[int]) -> Render:
    """One result of several, whose images, one part after the other, are those of ``views``."""
    order = torch.argsort(torch.tensor(views))
    color, alpha, depth = (torch.cat([getattr(p, n) for p in parts])[order] for n in ("color", "alpha", "depth"))
    return Render(color, alpha, depth, _summed([p.culled for p in parts]))


def _check_shown(shown: Shown, gaussians: int, views: int) -> None:
    sound = all(shown.shared <= begin <= end <= gaussians for begin, end in shown.own)
    if len(shown.own) != views or not sound or not 0 <= shown.shared <= gaussians:
        raise ValueError(f"expected ranges of {gaussians} Gaussians for {views} views, got {shown}")


def _summed(counts: Sequence[dict[str, int]]) -> dict[str, int]:
    return {k: sum(c.get(k, 0) for c in counts) for k in dict.fromkeys(k for c in counts for k in c)}


def _result(images: tuple[Tensor, Tensor, Tensor], culled: dict[str, int]) -> Render:
    return Render(*images, culled)


def on_device_of(cameras: Cameras, like: Tensor) -> Cameras:
    """The cameras on another tensor's device."""
    return cameras.map(lambda x: x.to(like.device))


def _check_shapes(splats: Splats, cameras: Cameras) -> None:
    n, v = len(splats), len(cameras)
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
    if (shutter := cameras.shutter) is not None:
        expected["readout_s"] = shutter.readout_s, (v,)
        expected |= {"velocity_m_s": (shutter.velocity_m_s, (v, 3)), "turn_rad_s": (shutter.turn_rad_s, (v, 3))}
    for name, (tensor, shape) in expected.items():
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"expected {name} of shape {shape}, got {tuple(tensor.shape)}")
    if cameras.width_px < 1 or cameras.height_px < 1:
        raise ValueError(f"expected an image of at least 1 × 1, got {cameras.width_px} × {cameras.height_px}")
    _check_finite(cameras)
    if shutter is not None and bool((shutter.readout_s < 0).any()):
        raise ValueError(f"expected readout_s of at least 0, got {float(shutter.readout_s.min())}")


def _check_finite(cameras: Cameras) -> None:
    for name, tensor in cameras.tensors().items():
        bad = ~torch.isfinite(tensor)
        if bool(bad.any()):
            first = tuple(torch.nonzero(bad)[0].tolist())
            raise NonFiniteError("render", name, int(bad.sum()), first)


def _check_gradients(backend: str, splats: Splats, cameras: Cameras) -> None:
    asked = cameras.tensors() | ({} if splats.velocities is None else {"velocities": splats.velocities})
    for name, tensor in asked.items():
        if tensor.requires_grad and name != "camera_SE3_chunk":
            raise ValueError(f"backend {backend} has no gradient in {name}; use reference")


def _in_camera_frame(splats: Splats, cameras: Cameras, v: int) -> tuple[Splats, Cameras]:
    """The splats in coordinates of camera v, and that camera at the origin, so that autograd reaches the pose.

    The rotation's gradient goes through a small turn beside the constant rotation, whose quaternion is (1, ω/2) to
    first order: exact for rigid motions, and without the square roots of a matrix-to-quaternion conversion. Velocities
    are constants.
    """
    pose = cameras.camera_SE3_chunk[v]
    rotation = pose[:3, :3]
    turn = rotation @ rotation.detach().T  # the identity, with a gradient
    omega = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    delta = torch.cat([omega.new_ones(1), omega / 2])
    fixed = matrix_to_quat(rotation.detach())
    quats = quat_multiply(quat_multiply(delta, fixed).to(splats.quats.dtype).expand(len(splats), 4), splats.quats)
    like = splats.means.dtype
    means = splats.means @ rotation.T.to(like) + pose[:3, 3].to(like)
    velocities = None if splats.velocities is None else splats.velocities @ rotation.detach().T.to(like)
    colors = splats.colors[v : v + 1] if splats.colors.dim() == 3 else splats.colors
    moved = replace(splats, means=means, quats=quats, colors=colors, velocities=velocities)
    return moved, replace(cameras.select([v]), camera_SE3_chunk=torch.eye(4)[None])
