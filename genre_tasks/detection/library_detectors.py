"""Detectors of libraries that a user may have installed: torchvision's and Detectron2's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.detection.class_names import read_class_names
from genre_tasks.detection.detections import Detections
from genre_tasks.detection.suppression import sort_detections
from genre_tasks.errors import ConfigError, InputError


@dataclass(frozen=True)
class TorchvisionDetector:
    """A detector of torchvision; see :class:`genre_tasks.detection.detector.Detector`.

    Attributes:
        network: takes a list of images [3, H, W] in [0, 1].
        device: where it computes.
        class_names: names by the classes' numbers; torchvision's number 0 is the background.
        has_masks: whether detections have masks.
        min_score: detections have at least this score.
    """

    network: Callable[[list[torch.Tensor]], list[dict[str, torch.Tensor]]]
    device: str
    class_names: tuple[str, ...]
    has_masks: bool
    min_score: float

    @staticmethod
    def load(name: str, class_names_file: Path | None, min_score: float) -> TorchvisionDetector:
        """Loads a network with torchvision's weights, which are downloaded once.

        Args:
            name: as torchvision calls it, such as ``maskrcnn_resnet50_fpn``.
            class_names_file: names of its classes; ``None`` for torchvision's.
            min_score: detections with a lower score are left out.

        Raises:
            ConfigError: torchvision is not installed.
            InputError: torchvision has no such detector, or the list of names does not fit it.
        """
        try:
            from torchvision import models
        except ImportError as error:
            raise ConfigError(
                f"the detector torchvision:{name} needs torchvision, which is not installed",
                remedy="Run `pip install torchvision`.",
            ) from error
        # It lists classifiers, too, whose output is no box.
        known = models.list_models(module=models.detection)
        if name not in known:
            raise InputError(f"torchvision has no detector '{name}'", remedy=f"It has {', '.join(sorted(known))}.")
        # The best weights that torchvision has; their list of classes comes with them.
        weights = models.get_model_weights(name).DEFAULT
        names = _choose_names(tuple(weights.meta["categories"]), class_names_file)
        device = _find_device()
        network = models.get_model(name, weights=weights).eval().to(device)
        return TorchvisionDetector(network, device, names, name.startswith("maskrcnn"), min_score)

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Finds objects in an image.

        Args:
            image: [H, W, 3] sRGB.

        Returns:
            The detections, best score first.
        """
        # A copy, since torch warns about arrays that may not be written.
        values = torch.from_numpy(image.copy()).to(self.device).permute(2, 0, 1).float() / 255
        with torch.no_grad():
            found = {key: value.cpu().numpy() for key, value in self.network([values])[0].items()}
        # A mask is a map of probabilities with an axis for a channel.
        masks = found["masks"][:, 0] > 0.5 if self.has_masks else None
        detections = Detections(
            found["boxes"].astype(np.float32),
            found["scores"].astype(np.float32),
            found["labels"].astype(np.int64),
            masks,
        )
        return sort_detections(detections, self.min_score, image.shape[1], image.shape[0])


@dataclass(frozen=True)
class Detectron2Detector:
    """A detector of Detectron2; see :class:`genre_tasks.detection.detector.Detector`.

    Attributes:
        predictor: takes an image [H, W, 3] with blue first, and gives ``instances``.
        class_names: names by the classes' numbers.
        has_masks: whether detections have masks.
        min_score: detections have at least this score.
    """

    predictor: Callable[[NDArray[np.uint8]], dict[str, Any]]
    class_names: tuple[str, ...]
    has_masks: bool
    min_score: float

    @staticmethod
    def load(name: str, class_names_file: Path | None, min_score: float) -> Detectron2Detector:
        """Loads a network of a configuration.

        Args:
            name: a configuration of the model zoo, such as ``COCO-InstanceSegmentation/mask_rcnn_R_50_FPN_3x.yaml``,
                whose weights are downloaded once; or a file whose key ``MODEL.WEIGHTS`` says where they are.
            class_names_file: names of its classes; ``None`` for those of its training data.
            min_score: detections with a lower score are left out.

        Raises:
            ConfigError: Detectron2 is not installed.
            InputError: there is no such configuration, or the list of names does not fit it.
        """
        try:
            from detectron2 import model_zoo
            from detectron2.config import get_cfg
            from detectron2.data import MetadataCatalog
            from detectron2.engine import DefaultPredictor
        except ImportError as error:
            raise ConfigError(
                f"the detector detectron2:{name} needs Detectron2, which is not installed",
                remedy="Install the package detectron2 from its source, as its documentation says.",
            ) from error
        config = get_cfg()
        try:
            # A file of the user comes first; in the model zoo names have the form of paths, too.
            if Path(name).is_file():
                config.merge_from_file(name)
            else:
                config.merge_from_file(model_zoo.get_config_file(name))
                config.MODEL.WEIGHTS = model_zoo.get_checkpoint_url(name)
        except (RuntimeError, OSError, KeyError, ValueError) as error:
            raise InputError(
                f"Detectron2 has no configuration '{name}': {error}",
                remedy="Name a configuration of its model zoo, or a file with one.",
            ) from error
        config.MODEL.DEVICE = _find_device()
        config.MODEL.ROI_HEADS.SCORE_THRESH_TEST = min_score
        # Data that are not registered have no names.
        known = getattr(MetadataCatalog.get(config.DATASETS.TRAIN[0]), "thing_classes", None)
        names = _choose_names(None if known is None else tuple(known), class_names_file)
        return Detectron2Detector(DefaultPredictor(config), names, bool(config.MODEL.MASK_ON), min_score)

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Finds objects in an image.

        Args:
            image: [H, W, 3] sRGB.

        Returns:
            The detections, best score first.
        """
        # Detectron2's predictor takes images as OpenCV reads them.
        found = self.predictor(np.ascontiguousarray(image[..., ::-1]))["instances"].to("cpu")
        detections = Detections(
            found.pred_boxes.tensor.numpy().astype(np.float32),
            found.scores.numpy().astype(np.float32),
            found.pred_classes.numpy().astype(np.int64),
            found.pred_masks.numpy().astype(bool) if self.has_masks else None,
        )
        return sort_detections(detections, self.min_score, image.shape[1], image.shape[0])


def _find_device() -> str:
    """A graphics card where there is one: these networks take seconds for an image on a CPU."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def _choose_names(known: tuple[str, ...] | None, class_names_file: Path | None) -> tuple[str, ...]:
    """The user's names where a file is given, and else the library's."""
    if class_names_file is None:
        if known is None:
            raise InputError(
                "the detector's training data have no class names",
                remedy="Give a text file with a name for each of the detector's classes, one a line.",
            )
        return known
    names = read_class_names(class_names_file)
    if known is not None and len(names) != len(known):
        raise InputError(
            f"the detector has {len(known)} classes, and the list of class names has {len(names)}",
            remedy="Give a text file with a name for each of the detector's classes, one a line.",
            file=class_names_file,
        )
    return names
