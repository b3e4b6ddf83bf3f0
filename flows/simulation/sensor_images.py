"""Masks and optical flow of a rollout: 16-bit PNG with a table of labels, and EXR."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from genre_tasks.render.types import RenderSettings
from genre_tasks.rollout.instance_masks import render_masks
from genre_tasks.rollout.optical_flow import compute_flow
from genre_tasks.rollout.render_rollout import DEFAULT_SETTINGS, RolloutImages
from genre_tasks.rollout.rig import RigCamera
from genre_tasks.scene.actor_node import ActorNode
from storage.codecs.exr import write_channels
from storage.files import write_file

INSTANCES_FOLDER = "instances"
CLASSES_FOLDER = "classes"
FLOW_FOLDER = "flow"
LABELS_FILE = "labels.json"


class MaskImages:
    """Masks, ``instances/CAMERA/000012.png`` and ``classes/CAMERA/000012.png``; a ``RolloutOutput``.

    Numbers stay the same over a rollout, although scenes of several chunks number their actors anew. ``labels.json``
    says what they stand for.

    Args:
        folder: of the rollout.
        rig: the cameras.
        settings: backend and threads.
    """

    def __init__(self, folder: Path, rig: Sequence[RigCamera], settings: RenderSettings = DEFAULT_SETTINGS) -> None:
        self._folder = folder
        self._settings = settings
        self._instances: dict[str, tuple[int, ActorNode]] = {}
        self._classes = {"empty": 0, "static": 1, "distant": 2}
        _make_folders(folder, (INSTANCES_FOLDER, CLASSES_FOLDER), rig)

    def write(self, images: RolloutImages) -> None:
        """Renders and writes the masks of a pose."""
        masks = render_masks(images, self._settings)
        instance_numbers = np.array([0, *(self._number_actor(actor) for actor in masks.actors)], np.uint16)
        class_numbers = np.array([self._number_class(name) for name in masks.class_names], np.uint16)
        for c, view in enumerate(images.views):
            name = f"{view.camera}/{images.index:06d}.png"
            _write_png16(self._folder / INSTANCES_FOLDER / name, instance_numbers[masks.instances[c].numpy()])
            _write_png16(self._folder / CLASSES_FOLDER / name, class_numbers[masks.classes[c].numpy()])

    def close(self) -> None:
        """Writes the table of labels."""
        table = {
            "classes": {str(number): name for name, number in self._classes.items()},
            "instances": {
                str(number): {"track_id": actor.track_id, "label": actor.label, "size_m": list(actor.size_m)}
                for number, actor in self._instances.values()
            },
        }
        write_file(self._folder / LABELS_FILE, json.dumps(table, indent=2).encode())

    def abort(self) -> None:
        """Nothing is under way between two poses."""

    def list_warnings(self) -> tuple[str, ...]:
        """Nothing limits them."""
        return ()

    def _number_actor(self, actor: ActorNode) -> int:
        return self._instances.setdefault(actor.track_id, (len(self._instances) + 1, actor))[0]

    def _number_class(self, name: str) -> int:
        return self._classes.setdefault(name, len(self._classes))


class FlowImages:
    """Optical flow from each pose to the next, ``flow/CAMERA/000012.exr``; a ``RolloutOutput``.

    Channels U and V are pixels to the right and down, NaN where there is none. The last pose has no file.

    Args:
        folder: of the rollout.
        rig: the cameras.
        settings: backend and threads.
    """

    def __init__(self, folder: Path, rig: Sequence[RigCamera], settings: RenderSettings = DEFAULT_SETTINGS) -> None:
        self._folder = folder / FLOW_FOLDER
        self._settings = settings
        self._previous: RolloutImages | None = None
        _make_folders(folder, (FLOW_FOLDER,), rig)

    def write(self, images: RolloutImages) -> None:
        """Writes the flow from the pose before to this one."""
        if self._previous is not None:
            flow = compute_flow(self._previous, images, self._settings).numpy()
            for c, view in enumerate(self._previous.views):
                path = self._folder / view.camera / f"{self._previous.index:06d}.exr"
                write_channels(path, {"U": flow[c, ..., 0].copy(), "V": flow[c, ..., 1].copy()})
        self._previous = images

    def close(self) -> None:
        """Nothing is left to do: every file is complete."""

    def abort(self) -> None:
        """Nothing is under way between two poses."""

    def list_warnings(self) -> tuple[str, ...]:
        """Nothing limits them."""
        return ()


def _make_folders(folder: Path, names: Sequence[str], rig: Sequence[RigCamera]) -> None:
    for name in names:
        for camera in rig:
            (folder / name / camera.name).mkdir(parents=True, exist_ok=True)


def _write_png16(path: Path, values: NDArray[np.uint16]) -> None:
    sink = io.BytesIO()
    Image.fromarray(values).save(sink, "PNG")
    write_file(path, sink.getvalue())
