"""FNet over the images of a rollout: all of them, or what removed actors hid alone, with the filled area as masks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from flows.simulation.outputs import image_path, make_camera_folders
from flows.simulation.prepared_rollout import PreparedRollout
from flows.simulation.request import SimulationRequest
from genre_tasks.config import PipelineConfig
from genre_tasks.rollout.fix_rollout import FixedRolloutImages, RolloutFixer
from genre_tasks.rollout.render_rollout import RolloutImages
from genre_tasks.rollout.rig import RigCamera
from storage.codecs.png import encode_png
from storage.files import write_file

FILLED_FOLDER = "filled"
"""Masks of what FNet drew in place of removed actors: ``filled/CAMERA/000012.png``, white where it did."""

Repair = Callable[[RolloutImages], RolloutImages]


class FnetRepair:
    """Repairs images, and writes which pixels show what removed actors hid.

    Args:
        repair: fixes or fills the images of a pose.
        folder: of the rollout.
        rig: the cameras.
    """

    def __init__(
        self, repair: Callable[[RolloutImages], FixedRolloutImages], folder: Path, rig: Sequence[RigCamera]
    ) -> None:
        self._repair = repair
        self._folder = folder
        self._rig = rig

    def __call__(self, images: RolloutImages) -> RolloutImages:
        """Repairs the images of a pose; poses follow each other in order."""
        fixed = self._repair(images)
        if images.chunk_scene.removed:
            folder = self._folder / FILLED_FOLDER
            folder.mkdir(exist_ok=True)
            make_camera_folders(folder, self._rig)
            for view, mask in zip(images.views, fixed.filled.numpy(), strict=True):
                path = image_path(folder, view.camera, images.index, ".png")
                write_file(path, encode_png(mask.astype(np.uint8) * 255))
        # With the render's opacity, an EXR file's colours would be divided by what they were not multiplied with.
        return replace(images, color=fixed.color.clamp(0, 1), alpha=fixed.alpha, depth=fixed.depth)


def choose_repair(request: SimulationRequest, config: PipelineConfig, rollout: PreparedRollout, folder: Path) -> Repair:
    """Chooses what is done with images after they are rendered.

    Args:
        request: says whether all images are fixed.
        config: of FNet.
        rollout: that is rendered.
        folder: of the rollout, for masks.

    Returns:
        A function of the images of a pose; the identity where FNet has nothing to do.

    Raises:
        InputError: FNet's weights are missing or do not fit.
    """
    if not request.fix and rollout.source is rollout.recorded:
        return _leave_as_rendered
    fixer = RolloutFixer(config.fnet, rollout.recorded, config.novel_views.lidar_max_points)
    return FnetRepair(fixer.fix if request.fix else fixer.fill, folder, rollout.rig)


def _leave_as_rendered(images: RolloutImages) -> RolloutImages:
    return images
