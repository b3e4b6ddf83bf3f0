"""Names and files that the layouts of training sets have in common."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.training_sets.labelled_images import LabelledImage


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Writes a PNG; its folder is made where it is missing.

    Args:
        path: the file.
        image: [H, W, 3] sRGB.
    """
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.ascontiguousarray(image)).save(path, "PNG")


def write_json(path: Path, value: Any) -> None:
    """Writes JSON; its folder is made where it is missing.

    Args:
        path: the file.
        value: of plain values; NaN is refused, as most readers do.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, allow_nan=False), encoding="utf-8")


def name_viewpoint(labelled: LabelledImage) -> str:
    """Names the path that an image was taken from.

    Args:
        labelled: recorded or rendered.

    Returns:
        ``recorded``, or where a render's path lies: ``left-3m``, ``right-1.5m``, ``rendered-0m``.
    """
    if not labelled.rendered:
        return "recorded"
    side = "left" if labelled.shift_m > 0 else "right"
    return f"{side}-{abs(labelled.shift_m):g}m" if labelled.shift_m else "rendered-0m"


def name_image(labelled: LabelledImage) -> str:
    """Names an image for people who look through its folder; images of two runs of a log have the same name.

    Args:
        labelled: the image.

    Returns:
        Log, path, camera and frame, good for a file name: ``002_left-3m_front_camera_000012``.
    """
    # Names of logs and cameras are made by others.
    log, camera = (re.sub(r"[^\w.=,+-]", "_", name, flags=re.ASCII) for name in (labelled.log, labelled.camera))
    return f"{log}_{name_viewpoint(labelled)}_{camera}_{labelled.frame:06d}"
