"""The sensors of a rollout by name, and what each of them writes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from flows.simulation.outputs import (
    DEPTH_FOLDER,
    Films,
    ImageFiles,
    RolloutOutput,
    write_depth,
    write_display_image,
    write_linear_image,
)
from flows.simulation.prepared_rollout import PreparedRollout
from flows.simulation.request import SimulationRequest

MODULES: dict[str, tuple[str, ...]] = {
    "rgb": (),
    "depth": (),
    "masks": ("genre_tasks.rollout.instance_masks",),
    "flow": ("genre_tasks.rollout.optical_flow",),
    "lidar": ("genre_tasks.lidar_simulation.rollout_lidar",),
}
"""By sensor, the modules whose code decides on its files."""


def open_sensors(request: SimulationRequest, rollout: PreparedRollout, folder: Path) -> Sequence[RolloutOutput]:
    """Opens the files of all sensors that are asked for.

    Args:
        request: names the sensors and the kinds of images.
        rollout: that is going to be rendered.
        folder: where to write.

    Returns:
        The outputs; the caller closes or aborts them.

    Raises:
        InputError: LiDAR is asked for, and the log is not there any more.
    """
    outputs: list[RolloutOutput] = []
    # Films start encoders, so they are last: nothing after them can fail.
    if request.exr:
        outputs.append(ImageFiles(folder, rollout.rig, ".exr", write_linear_image))
    if request.png:
        outputs.append(ImageFiles(folder, rollout.rig, ".png", write_display_image))
    if "depth" in request.sensors:
        outputs.append(ImageFiles(folder / DEPTH_FOLDER, rollout.rig, ".exr", write_depth))
    if {"masks", "flow"} & set(request.sensors):
        # Imported here, as most simulations have neither.
        from flows.simulation.sensor_images import FlowImages, MaskImages

        if "masks" in request.sensors:
            outputs.append(MaskImages(folder, rollout.rig))
        if "flow" in request.sensors:
            outputs.append(FlowImages(folder, rollout.rig))
    if "lidar" in request.sensors:
        from flows.simulation.lidar_files import LidarSweeps

        outputs.append(LidarSweeps(folder, rollout.recorded.log, rollout.checked.path))
    if "rgb" in request.sensors:
        outputs.append(Films(folder, rollout.rig, rollout.checked.path.times_s, rollout.pose_s))
    return outputs
