"""Detectors of other people behind one interface, opened by their file or by the name of a library's network."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from genre_tasks.detection.detections import Detections
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.user_paths import expand_user_path

DEFAULT_MIN_SCORE = 0.3
"""Detections with a lower score are left out, unless another one is asked for."""


class Detector(Protocol):
    """Finds objects in images.

    Attributes:
        class_names: names of the classes; a detection's class is an index of this list.
        has_masks: whether detections have masks.
    """

    @property
    def class_names(self) -> tuple[str, ...]: ...

    @property
    def has_masks(self) -> bool: ...

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Finds objects in an image.

        Args:
            image: [H, W, 3] sRGB.

        Returns:
            The detections, best score first, with boxes inside of the image; of boxes of a class that overlap much,
            the best one alone.
        """
        ...


def open_detector(
    path_or_name: str, class_names_file: Path | None = None, min_score: float = DEFAULT_MIN_SCORE
) -> Detector:
    """Opens a detector.

    Args:
        path_or_name: a file ``.onnx`` or ``.tflite`` of a YOLO family; ``torchvision:NAME`` for a network of
            torchvision, such as ``torchvision:maskrcnn_resnet50_fpn``; or ``detectron2:CONFIG`` for a configuration of
            Detectron2's model zoo or a file with one.
        class_names_file: a text file with the names of the classes, one a line; ``None`` for the names that the
            detector brings, or COCO's.
        min_score: detections with a lower score are left out, in [0, 1].

    Returns:
        The detector.

    Raises:
        ConfigError: a package that the detector needs is not installed, or ``min_score`` is out of range.
        InputError: there is no such detector, it is of no supported family, or the names do not fit it.
    """
    # Written so that NaN is refused, too.
    if not 0 <= min_score <= 1:
        raise ConfigError(f"a detector's least score is {min_score}", remedy="Give one between 0 and 1.")
    # Only these two words: a drive letter or any other colon belongs to a path.
    library, colon, name = path_or_name.partition(":")
    if colon and library in ("torchvision", "detectron2"):
        # The libraries are imported by who asks for them.
        from genre_tasks.detection.library_detectors import Detectron2Detector, TorchvisionDetector

        kind = TorchvisionDetector if library == "torchvision" else Detectron2Detector
        return kind.load(name, class_names_file, min_score)
    return _open_file(expand_user_path(path_or_name), class_names_file, min_score)


def _open_file(path: Path, class_names_file: Path | None, min_score: float) -> Detector:
    """A detector whose network is in a file."""
    from genre_tasks.detection.networks import Network, open_litert, open_onnx
    from genre_tasks.detection.yolo_detector import YoloDetector

    openers: dict[str, Callable[[Path], Network]] = {".onnx": open_onnx, ".tflite": open_litert}
    opener = openers.get(path.suffix.lower())
    # The ending first: a folder, say, is no detector in any case.
    if opener is None:
        raise InputError(
            "this is no detector",
            remedy="Give a file .onnx or .tflite, torchvision:NAME or detectron2:CONFIG.",
            file=path,
        )
    if not path.is_file():
        raise InputError("no such detector", remedy="Check the path.", file=path)
    return YoloDetector.from_network(opener(path), path, class_names_file, min_score)
