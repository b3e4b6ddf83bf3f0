"""A viewed chunk in a scene of viser: nodes are sent once, and only their poses follow the time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from flows.simulation.stored_ranges import SideRange
from flows.viewer.path_drawing import CameraImage
from flows.viewer.scene_nodes import SplatNode
from flows.viewer.viewed_chunks import ViewedChunk
from genre_tasks.logs.types import Float64

PATH_RGB = (230, 120, 20)
RANGE_RGB = (30, 170, 90)
FRUSTUM_RGB = (40, 90, 200)

Frusta = Literal["this frame", "all frames", "none"]

_FRUSTUM_SCALE = 0.5
_LINE_M = 0.06


@dataclass
class ChunkDrawing:
    """What of a chunk is in a scene of viser, and what of it is shown.

    Attributes:
        viewed: the chunk.
        splats: handles by name of the node.
        frusta: handle and its image's log frame.
        path: handle of the recorded path.
        range_lines: handle of the reliable range, once it is known.
        hidden: names of nodes that are switched off.
        row: of the frame that is shown.
        frusta_shown: which of the frusta are shown.
    """

    viewed: ViewedChunk
    splats: Mapping[str, viser.GaussianSplatHandle]
    frusta: tuple[tuple[viser.CameraFrustumHandle, int], ...]
    path: viser.LineSegmentsHandle
    range_lines: viser.LineSegmentsHandle | None = None
    hidden: set[str] = field(default_factory=set)
    row: int = 0
    frusta_shown: Frusta = "this frame"

    @staticmethod
    def draw(scene: viser.SceneApi, viewed: ViewedChunk) -> ChunkDrawing:
        """Adds a chunk to a scene, as it is at its first frame.

        Args:
            scene: of a server, or of one client.
            viewed: the chunk.

        Returns:
            What was drawn.
        """
        splats = {node.name: _add_splats(scene, node) for node in viewed.scene.nodes}
        frusta = tuple((_add_frustum(scene, image), image.frame) for image in viewed.images)
        path = scene.add_line_segments("/path", viewed.path.segments(), PATH_RGB, thickness=_LINE_M)
        drawing = ChunkDrawing(viewed, splats, frusta, path)
        drawing.show_row(0)
        return drawing

    def draw_range(self, scene: viser.SceneApi, sides: SideRange) -> None:
        """Adds the reliable range.

        Args:
            scene: that the chunk was drawn into.
            sides: the range.
        """
        segments = self.viewed.path.range_segments(sides)
        self.range_lines = scene.add_line_segments("/reliable range", segments, RANGE_RGB, thickness=_LINE_M)

    def show_row(self, row: int) -> None:
        """Moves actors to where they are at a frame, and shows the frusta of its images.

        Args:
            row: of the frame in the chunk, from 0.
        """
        self.row = row
        for node in self.viewed.scene.nodes:
            if node.motion is not None and node.motion.present[row]:
                wxyz, position = to_wxyz_position(node.motion.scene_SE3_node[row])
                self.splats[node.name].wxyz = wxyz
                self.splats[node.name].position = position
        self._update_visibility()

    def hide(self, name: str, is_hidden: bool) -> None:
        """Switches a node off or on.

        Args:
            name: of the node.
            is_hidden: whether it is off.
        """
        (self.hidden.add if is_hidden else self.hidden.discard)(name)
        self._update_visibility()

    def show_frusta(self, which: Frusta) -> None:
        """Chooses the frusta to show.

        Args:
            which: those of the frame that is shown, all, or none.
        """
        self.frusta_shown = which
        self._update_visibility()

    def remove(self) -> None:
        """Takes everything out of the scene."""
        handles = [*self.splats.values(), *(handle for handle, _ in self.frusta), self.path]
        for handle in handles if self.range_lines is None else [*handles, self.range_lines]:
            handle.remove()

    def _update_visibility(self) -> None:
        for node in self.viewed.scene.nodes:
            exists = node.motion is None or bool(node.motion.present[self.row])
            self.splats[node.name].visible = exists and node.name not in self.hidden
        # A long chunk has images at some frames alone: the last ones before stay.
        frame = self.viewed.frames[self.row]
        shown = max((f for _, f in self.frusta if f <= frame), default=-1)
        for handle, image_frame in self.frusta:
            handle.visible = self.frusta_shown == "all frames" or (
                self.frusta_shown == "this frame" and image_frame == shown
            )


def to_wxyz_position(pose: Float64) -> tuple[Float64, Float64]:
    """Writes a pose as viser takes it.

    Args:
        pose: [4, 4].

    Returns:
        Unit quaternion [4], w first, and position [3].

    >>> to_wxyz_position(np.eye(4))[0].tolist()
    [1.0, 0.0, 0.0, 0.0]
    """
    return np.asarray(Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]), pose[:3, 3]


def _add_splats(scene: viser.SceneApi, node: SplatNode) -> viser.GaussianSplatHandle:
    folder = "/actors" if node.motion is not None else ""
    return scene.add_gaussian_splats(
        f"{folder}/{node.name}",
        centers=node.centers,
        covariances=node.covariances,
        rgbs=node.rgbs,
        opacities=node.opacities,
    )


def _add_frustum(scene: viser.SceneApi, image: CameraImage) -> viser.CameraFrustumHandle:
    wxyz, position = to_wxyz_position(image.chunk_SE3_camera)
    return scene.add_camera_frustum(
        f"/cameras/{image.camera}/{image.frame}",
        fov=image.fov_rad,
        aspect=image.aspect,
        scale=_FRUSTUM_SCALE,
        color=FRUSTUM_RGB,
        image=image.pixels,
        jpeg_quality=80,
        wxyz=wxyz,
        position=position,
        cast_shadow=False,
    )
