"""The camera rig of a log: where each camera sits on the ego vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import Float64, Lens, MotionBlur, RollingShutter
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.transforms import compose_se3, invert_se3


@dataclass(frozen=True)
class RigCamera:
    """A camera of the rig.

    Attributes:
        name: of the camera.
        lens: at the working resolution.
        ego_SE3_camera: [4, 4], the mean over the recorded images. Cameras fire at moments of their own, so it holds
            what the vehicle drives from the sweep to the image.
        readout_s: rolling shutter, seconds from the first row to the last; 0: a global shutter.
        exposure_s: seconds for which the shutter is open; 0: no motion blur.
    """

    name: str
    lens: Lens
    ego_SE3_camera: Float64
    readout_s: float = 0.0
    exposure_s: float = 0.0


@dataclass(frozen=True)
class RolloutView:
    """A camera at one pose of a rollout; a ``PosedView`` of the renderer.

    Attributes:
        camera: of the rig.
        frame: log frame, or a moment between two.
        chunk_SE3_camera: [4, 4].
        lens: at the working resolution.
        shutter: how the camera moves while the image is read out.
        blur: how the camera moves while the image is exposed.
    """

    camera: str
    frame: float
    chunk_SE3_camera: Float64
    lens: Lens
    shutter: RollingShutter | None = None
    blur: MotionBlur | None = None


def estimate_rig(chunks: Sequence[Chunk]) -> tuple[RigCamera, ...]:
    """Estimates where the cameras sit on the vehicle, from the recorded poses.

    Args:
        chunks: of one log, with their plans' effects applied.

    Returns:
        The cameras in the order of the rig; one without any image is left out.
    """
    rig = []
    for name in chunks[0].camera_names:
        poses = []
        views = [(chunk, view) for chunk in chunks for view in chunk.views if view.camera == name]
        for chunk, view in views:
            ego = chunk.chunk_SE3_ego[chunk.frames.index(view.frame)]
            poses.append(invert_se3(ego) @ view.chunk_SE3_camera)
        if not views:
            continue
        stacked = np.stack(poses)
        rotation = Rotation.from_matrix(stacked[:, :3, :3]).mean().as_matrix()
        rig.append(
            RigCamera(
                name=name,
                lens=max((view.lens for _, view in views), key=lambda lens: any(lens.distortion)),
                ego_SE3_camera=compose_se3(rotation, stacked[:, :3, 3].mean(0)),
                # Plans are made for each chunk: where the vehicle is slow, a shutter is left out as it does nothing.
                # So is the distortion of a camera without source images.
                readout_s=max(0.0 if view.shutter is None else view.shutter.readout_s for _, view in views),
                exposure_s=max(0.0 if view.blur is None else view.blur.exposure_s for _, view in views),
            )
        )
    return tuple(rig)
