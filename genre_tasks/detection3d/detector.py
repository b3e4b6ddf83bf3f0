"""A trained detector: a network and its settings, used on images and kept in a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ValidationError

from genre_tasks.atomic_path import write_atomically
from genre_tasks.detection3d.decode import Detections3d, decode_boxes, find_peaks
from genre_tasks.detection3d.examples import fit_lens, resize_image
from genre_tasks.detection3d.network import Detector3dNetwork
from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.json_files import read_json_object
from genre_tasks.logs.types import Lens
from genre_tasks.threads import torch_threads
from genre_tasks.weight_checks import require_weights_fit

REMEDY = "Train the detector again, or give the files of a trained one."


@dataclass(frozen=True)
class Detector3d:
    """A trained detector.

    Attributes:
        network: ready for inference.
        config: of its training.
        losses: the loss of each step of its training; empty for a detector from a file.
    """

    network: Detector3dNetwork
    config: Detector3dConfig
    losses: tuple[float, ...] = ()

    def detect(self, image: NDArray[np.uint8], lens: Lens) -> Detections3d:
        """Finds boxes in an image.

        Args:
            image: [H, W, 3] sRGB.
            lens: of the image's size.

        Returns:
            At most ``max_detections`` boxes, best score first.

        Raises:
            InputError: the lens is of another size than the image.
        """
        if image.shape != (lens.height_px, lens.width_px, 3):
            raise InputError(
                f"the image has shape {image.shape}, and its lens is of {lens.width_px} × {lens.height_px} pixels",
                remedy="Give the lens of the resized image.",
            )
        fitted = fit_lens(lens, self.config)
        pixels = resize_image(image, fitted, self.config)[None].float() / 255
        # One thread: the last bits, and with them the order of equal scores, do not depend on the machine's load.
        with torch_threads(1), torch.inference_mode():
            logits, features = self.network(pixels, torch.tensor([[fitted.cx_px, fitted.cy_px]]))
            peaks = find_peaks(torch.sigmoid(logits[0]), self.config.max_detections)
            found = self.network.regress(features, torch.zeros_like(peaks.classes), peaks.cells)
        return decode_boxes(peaks, found, lens, self.config)


def build_network(config: Detector3dConfig) -> Detector3dNetwork:
    """Builds an untrained network.

    Args:
        config: its width, classes and seed.

    Returns:
        The network, its weights drawn from the seed alone.
    """
    # Layers draw their weights from torch's global generator, whose state is restored.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = Detector3dNetwork(len(config.classes), config.width)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def save_detector(detector: Detector3d, weights: Path) -> None:
    """Writes a detector; each file is complete or absent at any moment.

    Args:
        detector: to write.
        weights: the file ``X.safetensors``; the settings go to ``X.json``.
    """
    from safetensors.torch import save

    tensors = {name: value.detach().contiguous() for name, value in detector.network.state_dict().items()}
    # The settings first: weights without them are not readable.
    write_atomically(weights.with_suffix(".json"), (detector.config.model_dump_json(indent=2) + "\n").encode())
    write_atomically(weights, save(tensors))


def load_detector(weights: Path) -> Detector3d:
    """Reads a detector from its weights and the settings that lie with them.

    Args:
        weights: a file ``X.safetensors``, with ``X.json`` in the same folder.

    Returns:
        The detector.

    Raises:
        InputError: a file is missing or unreadable, or the weights are of another network.
        ConfigError: the settings are not valid.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    config_file = weights.with_suffix(".json")
    for path in (weights, config_file):
        if not path.is_file():
            raise InputError("the detector's weights are missing", remedy=REMEDY, file=path)
    values = read_json_object(config_file, "detector's settings", REMEDY, kind=ConfigError)
    try:
        config = Detector3dConfig.model_validate(values)
    except ValidationError as error:
        detail = "; ".join(str(error).splitlines()[:4])
        raise ConfigError(f"the detector's settings are not valid: {detail}", remedy=REMEDY, file=config_file) from None
    try:
        tensors = load_file(weights)
    except (SafetensorError, OSError) as error:
        raise InputError(f"the weights cannot be read: {error}", remedy=REMEDY, file=weights) from error
    network = build_network(config)
    require_weights_fit(tensors, network.state_dict(), weights, REMEDY)
    network.load_state_dict(tensors)
    return Detector3d(network.eval().requires_grad_(False), config)
