"""From offsets to splats, and from a render of them back to the gradient of the offsets: compiled, without autograd.

``Parameterization.gaussians_at``, ``SceneGraph.gaussians_at_frames``, ``Gaussians.activate`` and
``Render.expected_depth`` are its oracle.
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
from genre_tasks.render.types import VisibleRanges
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene.rotations import matrices_to_quats


class _Gaussians(ctypes.Structure):
    """As in posing.cpp, like the two below."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("count", "moving", "actors")),
        *((name, ctypes.c_void_p) for name in ("start", "unit_m", "slot", "actor", "poses")),
    ]


class _Frames(ctypes.Structure):
    _fields_ = [("count", ctypes.c_int64), ("at", ctypes.c_void_p)]


class _Splats(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("means", "scales", "quats", "opacities", "colors")]

    @staticmethod
    def from_arrays(arrays: cpu.SplatTensors) -> _Splats:
        return _Splats(*(array.data_ptr() for array in arrays))


@cache
def load_posing(folder: Path = KERNEL.folder) -> ctypes.CDLL:
    """Loads the kernel once, with its argument types declared.

    Args:
        folder: where its libraries are.

    Returns:
        The library of the best instruction set of this machine.

    Raises:
        ResourceError: as :func:`genre_tasks.compiled.loader.load`.
        ConfigError: as there.
    """
    library = load(KERNEL, folder)
    pointer = ctypes.c_void_p
    threads = ctypes.c_int
    number = ctypes.c_int64
    gaussians = ctypes.POINTER(_Gaussians)
    frames = ctypes.POINTER(_Frames)
    splats = ctypes.POINTER(_Splats)
    library.genre_pose.argtypes = [gaussians, frames, pointer, threads, splats, pointer]
    library.genre_pose_gradient.argtypes = [gaussians, frames, pointer, pointer, splats, threads, pointer]
    library.genre_pose_residuals.argtypes = [gaussians, number, pointer, threads, pointer]
    library.genre_expected_depth.argtypes = [number, pointer, pointer, pointer]
    library.genre_expected_depth_gradient.argtypes = [number, pointer, pointer, pointer]
    return library


@dataclass(frozen=True)
class PosedSplats:
    """The splats at F frames, laid out as ``SceneGraph.gaussians_at_frames``.

    Attributes:
        frame_rows: [F] rows of the table of poses.
        splats: means, scales, quaternions, opacities, colours.
        opacity_slopes: [N] derivative of each Gaussian's opacity by its logit.
    """

    frame_rows: Tensor
    splats: cpu.SplatTensors
    opacity_slopes: Tensor


class Posing:
    """Turns the Gaussians of an unrolled optimisation into splats, at any offsets and frames; float32 on the CPU.

    Args:
        scene: at its start.
        start: [N, 14] the scene's Gaussians, packed.
        unit_m: [N, 1] metres.

    Attributes:
        moving: number of Gaussians that belong to actors.
        still: number of all others.
    """

    def __init__(self, scene: SceneGraph, start: Tensor, unit_m: Tensor) -> None:
        # A scene that lists no actors is static, whatever its nodes say.
        nodes = scene.nodes if scene.actors else torch.zeros_like(scene.nodes)
        is_actor = nodes >= FIRST_ACTOR
        self.moving = int(is_actor.sum())
        self.still = len(nodes) - self.moving
        # Static splats come first, each at its rank among the static; an actor's follow at its rank among the moving.
        moving_slots = self.still + torch.cumsum(is_actor, 0)
        still_slots = torch.cumsum(~is_actor, 0)
        self._slot = torch.where(is_actor, moving_slots, still_slots).int() - 1
        self._actor = torch.where(is_actor, nodes - FIRST_ACTOR, -1).int()
        # Attributes and not locals: the kernel's structure below holds addresses of these tensors only.
        self._start = start.contiguous()
        self._unit_m = unit_m.contiguous()
        self._frames = sorted({int(frame) for actor in scene.actors for frame in actor.frames})
        self._scene = scene
        self._poses = _pose_table(scene, self._frames)
        self._row_of_frame: dict[float, int] = {frame: i for i, frame in enumerate(self._frames)}
        self._gaussians = _Gaussians(
            len(nodes),
            self.moving,
            len(scene.actors),
            *(t.data_ptr() for t in (self._start, self._unit_m, self._slot, self._actor, self._poses)),
        )

    def visible_ranges(self, frames: Sequence[float]) -> VisibleRanges:
        """Tells which splats of :meth:`pose` the views at these log frames show."""
        return VisibleRanges.for_frames(self.still, self.moving, frames)

    def pose(self, offsets: Tensor, frames: Sequence[float], threads: int) -> PosedSplats:
        """Applies offsets, moves actors to their poses, and activates scales and opacities.

        Args:
            offsets: [N, 14] from the start.
            frames: [F] distinct log frames, or moments between them.
            threads: how many to use; the bits do not depend on it.

        Returns:
            PosedSplats: S + F · M splats.

        Raises:
            ValueError: the offsets are of another scene.
            ResourceError: the kernel is not compiled, or fails.
        """
        offsets = offsets.contiguous()
        if offsets.shape != self._start.shape:
            raise ValueError(f"expected offsets of shape {list(self._start.shape)}, got {list(offsets.shape)}")
        # Moments between log frames come with motion blur; the log frames are in the table from the start.
        self._add_poses([frame for frame in frames if frame % 1 and frame not in self._row_of_frame])
        # The last row of the first table says that no actor exists; all frames without an actor share it.
        row_without_actors = len(self._frames)
        rows = [self._row_of_frame.get(frame, row_without_actors) for frame in frames]
        frame_rows = torch.tensor(rows, dtype=torch.int64)
        splats = allocate_splats(self.still + len(frames) * self.moving)
        posed = PosedSplats(frame_rows, splats, torch.empty(len(offsets)))
        status = load_posing().genre_pose(
            self._gaussians,
            _Frames(len(frame_rows), frame_rows.data_ptr()),
            offsets.data_ptr(),
            threads,
            _Splats.from_arrays(posed.splats),
            posed.opacity_slopes.data_ptr(),
        )
        _check_status(status)
        return posed

    def offsets_gradient(self, posed: PosedSplats, by_splats: cpu.SplatTensors, threads: int) -> Tensor:
        """Takes the gradient of the splats to the offsets.

        Args:
            posed: the splats.
            by_splats: gradients with respect to them, in the same layout.
            threads: how many to use; the bits do not depend on it.

        Returns:
            [N, 14]; an actor's Gaussian has the sum over its frames.

        Raises:
            ResourceError: the kernel fails.
        """
        out = torch.empty_like(self._start)
        status = load_posing().genre_pose_gradient(
            self._gaussians,
            _Frames(len(posed.frame_rows), posed.frame_rows.data_ptr()),
            posed.splats[1].data_ptr(),
            posed.opacity_slopes.data_ptr(),
            _Splats.from_arrays(by_splats),
            threads,
            out.data_ptr(),
        )
        _check_status(status)
        return out

    def gather_residuals(self, posed: PosedSplats, splat_residuals: Tensor, threads: int) -> Tensor:
        """Sums what the splats of each Gaussian show of a residual image.

        Args:
            posed: the splats.
            splat_residuals: [N', 5] of the splats, as ``cpu.backward`` returns them.
            threads: how many to use; the bits do not depend on it.

        Returns:
            [N, 5] image residuals.

        Raises:
            ResourceError: the kernel fails.
        """
        out = torch.empty(len(self._start), splat_residuals.shape[1])
        status = load_posing().genre_pose_residuals(
            self._gaussians, len(posed.frame_rows), splat_residuals.data_ptr(), threads, out.data_ptr()
        )
        _check_status(status)
        return out

    def _add_poses(self, frames: Sequence[float]) -> None:
        """Adds rows for moments between log frames to the table of poses; those that it has keep their places."""
        if not frames or not self._scene.actors:
            return
        # Rows are appended and never moved, since splats that were posed before refer to theirs by number.
        first_row = len(self._poses)
        self._row_of_frame |= {frame: first_row + i for i, frame in enumerate(frames)}
        self._poses = torch.cat([self._poses, _pose_table(self._scene, frames)])
        # The table has moved in memory.
        self._gaussians.poses = self._poses.data_ptr()


def expected_depth(alpha: Tensor, depth: Tensor) -> Tensor:
    """Divides depth by alpha, as ``Render.expected_depth``.

    Args:
        alpha: [V, H, W], contiguous.
        depth: [V, H, W] weighted sum of depths in metres, contiguous.

    Returns:
        [V, H, W] metres, 0 where nothing was rendered.

    >>> expected_depth(torch.tensor([[[0.5, 0.0]]]), torch.tensor([[[4.0, 0.0]]])).tolist()
    [[[8.0, 0.0]]]
    """
    out = torch.empty_like(depth)
    status = load_posing().genre_expected_depth(out.numel(), alpha.data_ptr(), depth.data_ptr(), out.data_ptr())
    _check_status(status)
    return out


def expected_depth_gradient(alpha: Tensor, expected: Tensor, by_expected: Tensor) -> tuple[Tensor, Tensor]:
    """Takes the gradient of :func:`expected_depth` to its arguments.

    Args:
        alpha: [V, H, W].
        expected: [V, H, W] what :func:`expected_depth` returned; it is overwritten.
        by_expected: [V, H, W] gradient with respect to it; it is overwritten.

    Returns:
        tuple: the gradients with respect to alpha and to depth, in the memory of the last two arguments.
    """
    pointers = (alpha.data_ptr(), expected.data_ptr(), by_expected.data_ptr())
    _check_status(load_posing().genre_expected_depth_gradient(alpha.numel(), *pointers))
    return expected, by_expected


def allocate_splats(count: int) -> cpu.SplatTensors:
    """Makes room for splats or their gradients.

    Args:
        count: number of splats.

    Returns:
        Means, scales, quaternions, opacities and colours, not initialised.

    >>> [tuple(array.shape) for array in allocate_splats(2)]
    [(2, 3), (2, 3), (2, 4), (2,), (2, 3)]
    """
    # Not zeroed: the kernels write every row.
    means = torch.empty(count, 3)
    scales = torch.empty(count, 3)
    quats = torch.empty(count, 4)
    opacities = torch.empty(count)
    colors = torch.empty(count, 3)
    return means, scales, quats, opacities, colors


def _pose_table(scene: SceneGraph, frames: Sequence[float]) -> Tensor:
    """[F + 1, A, 17]: rotation, translation, quaternion and presence; the last row for frames without any actor."""
    # A frame before all others, at which no actor exists.
    frame_without_actors = -1 - max((abs(round(frame)) for frame in frames), default=0)
    rotation, translation, present = scene.actor_poses([*frames, frame_without_actors])
    rotations = torch.as_tensor(rotation).float()
    translations = torch.as_tensor(translation).float()
    presence = torch.as_tensor(present.astype(np.float32))[..., None]
    parts = (rotations.flatten(2), translations, matrices_to_quats(rotations), presence)
    return torch.cat(parts, -1).contiguous()


def _check_status(status: int) -> None:
    if status:
        raise ResourceError(f"{KERNEL.title} failed", remedy="Report the number of Gaussians and of views")
