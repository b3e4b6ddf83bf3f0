"""From offsets to splats, a render of them and the way back to the offsets' gradient, compiled: no autograd in between.

``Frame.gaussians``, ``SceneGraph.posed``, ``Gaussians.activated`` and ``Render.expected_depth`` are its oracle.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from genre_tasks.compiled.loader import load
from genre_tasks.errors import ResourceError
from genre_tasks.optimiser.kernels.build_posing import KERNEL
from genre_tasks.render import cpu
from genre_tasks.render.types import Shown
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene.transforms import matrix_to_quat


class _Gaussians(ctypes.Structure):
    """As in posing.cpp, like the two below."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("count", "moving", "actors")),
        *((name, ctypes.c_void_p) for name in ("start", "unit", "slot", "actor", "poses")),
    ]


class _Frames(ctypes.Structure):
    _fields_ = [("count", ctypes.c_int64), ("at", ctypes.c_void_p)]


class _Splats(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("means", "scales", "quats", "opacities", "colors")]

    @staticmethod
    def of(arrays: cpu.Arrays) -> _Splats:
        return _Splats(*(a.data_ptr() for a in arrays))


@cache
def load_posing(folder: Path = KERNEL.folder) -> ctypes.CDLL:
    """The kernel with its argument types declared, loaded once.

    Raises ``ResourceError`` and ``ConfigError`` as :func:`genre_tasks.compiled.loader.load`.
    """
    library = load(KERNEL, folder)
    p, i, n = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64
    gaussians, frames, splats = (ctypes.POINTER(s) for s in (_Gaussians, _Frames, _Splats))
    library.genre_pose.argtypes = [gaussians, frames, p, i, splats, p]
    library.genre_pose_gradient.argtypes = [gaussians, frames, p, p, splats, i, p]
    library.genre_pose_residuals.argtypes = [gaussians, n, p, i, p]
    library.genre_expected_depth.argtypes = [n, p, p, p]
    library.genre_expected_depth_gradient.argtypes = [n, p, p, p]
    return library


@dataclass(frozen=True)
class Posed:
    """The splats at some frames, laid out as by ``SceneGraph.posed``; ``slopes`` [N]: of opacity by its logit."""

    frames: Tensor  # [F] rows of the poses
    splats: cpu.Arrays
    slopes: Tensor


class Posing:
    """The Gaussians of an unrolled optimisation at any offsets and frames, as splats; float32 on the CPU.

    Args:
        scene: at its start.
        start: [N, 14] the scene's Gaussians, packed.
        unit: [N, 1] metres.
    """

    def __init__(self, scene: SceneGraph, start: Tensor, unit: Tensor) -> None:
        nodes = scene.nodes if scene.actors else torch.zeros_like(scene.nodes)
        moves = nodes >= FIRST_ACTOR
        self.moving = int(moves.sum())
        self.still = len(nodes) - self.moving
        self._slot = torch.where(moves, self.still + torch.cumsum(moves, 0), torch.cumsum(~moves, 0)).int() - 1
        self._actor = torch.where(moves, nodes - FIRST_ACTOR, -1).int()
        self._start, self._unit = start.contiguous(), unit.contiguous()
        self._frames = sorted({int(f) for actor in scene.actors for f in actor.frames})
        self._scene, self._poses = scene, _pose_table(scene, self._frames)
        self._row: dict[float, int] = {frame: i for i, frame in enumerate(self._frames)}
        self._in = _Gaussians(
            len(nodes),
            self.moving,
            len(scene.actors),
            *(t.data_ptr() for t in (self._start, self._unit, self._slot, self._actor, self._poses)),
        )

    def shown(self, frames: Sequence[float]) -> Shown:
        """Which splats of :meth:`splats` views at these log frames have."""
        return Shown.of_frames(self.still, self.moving, frames)

    def splats(self, offsets: Tensor, frames: Sequence[float], threads: int) -> Posed:
        """At ``offsets`` [N, 14] and at distinct log frames, or moments between them."""
        offsets = offsets.contiguous()
        if offsets.shape != self._start.shape:
            raise ValueError(f"expected offsets of shape {list(self._start.shape)}, got {list(offsets.shape)}")
        self._know([f for f in frames if f % 1 and f not in self._row])
        nowhere = len(self._frames)
        rows = torch.tensor([self._row.get(f, nowhere) for f in frames], dtype=torch.int64)
        posed = Posed(rows, arrays(self.still + len(frames) * self.moving), torch.empty(len(offsets)))
        pointers = offsets.data_ptr(), threads, _Splats.of(posed.splats), posed.slopes.data_ptr()
        _check(load_posing().genre_pose(self._in, _Frames(len(rows), rows.data_ptr()), *pointers))
        return posed

    def _know(self, between: Sequence[float]) -> None:
        """Adds rows of poses between log frames to the table; those that it has stay where they are."""
        if not between or not self._scene.actors:
            return
        begin = len(self._poses)
        self._row |= {frame: begin + i for i, frame in enumerate(between)}
        self._poses = torch.cat([self._poses, _pose_table(self._scene, between)])
        self._in.poses = self._poses.data_ptr()

    def gradient(self, posed: Posed, by_splats: cpu.Arrays, threads: int) -> Tensor:
        """The gradient [N, 14] with respect to the offsets from that of the splats."""
        out = torch.empty_like(self._start)
        frames = _Frames(len(posed.frames), posed.frames.data_ptr())
        scales, slopes = posed.splats[1].data_ptr(), posed.slopes.data_ptr()
        pointers = scales, slopes, _Splats.of(by_splats), threads, out.data_ptr()
        _check(load_posing().genre_pose_gradient(self._in, frames, *pointers))
        return out

    def residuals(self, posed: Posed, by_splats: Tensor, threads: int) -> Tensor:
        """What the Gaussians show of a residual image, [N, 5], from what their splats show (``cpu.backward``)."""
        out = torch.empty(len(self._start), by_splats.shape[1])
        pointers = by_splats.data_ptr(), threads, out.data_ptr()
        _check(load_posing().genre_pose_residuals(self._in, len(posed.frames), *pointers))
        return out


def expected_depth(alpha: Tensor, depth: Tensor) -> Tensor:
    """As ``Render.expected_depth``; contiguous [V, H, W]."""
    out = torch.empty_like(depth)
    _check(load_posing().genre_expected_depth(out.numel(), alpha.data_ptr(), depth.data_ptr(), out.data_ptr()))
    return out


def expected_depth_gradient(alpha: Tensor, expected: Tensor, by_expected: Tensor) -> tuple[Tensor, Tensor]:
    """The gradients by alpha and by depth, written over ``expected`` and ``by_expected``."""
    pointers = alpha.data_ptr(), expected.data_ptr(), by_expected.data_ptr()
    _check(load_posing().genre_expected_depth_gradient(alpha.numel(), *pointers))
    return expected, by_expected


def arrays(count: int) -> cpu.Arrays:
    """Room for splats or their gradients."""
    shapes = (count, 3), (count, 3), (count, 4), (count,), (count, 3)
    means, scales, quats, opacities, colors = (torch.empty(shape) for shape in shapes)
    return means, scales, quats, opacities, colors


def _pose_table(scene: SceneGraph, frames: Sequence[float]) -> Tensor:
    """[F + 1, A, 17]: rotation, translation, quaternion and presence; the last row for frames without any actor."""
    nobody = -1 - max((abs(round(f)) for f in frames), default=0)
    rotation, translation, present = scene.actor_poses([*frames, nobody])
    turns = torch.as_tensor(rotation).float()
    there = torch.as_tensor(present.astype(np.float32))[..., None]
    parts = turns.flatten(2), torch.as_tensor(translation).float(), matrix_to_quat(turns), there
    return torch.cat(parts, -1).contiguous()


def _check(status: int) -> None:
    if status:
        raise ResourceError(f"{KERNEL.title} failed", remedy="Report the number of Gaussians and of views")
