"""A detector of the YOLO families whose network is in a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genre_tasks.detection.class_names import choose_class_names
from genre_tasks.detection.decoding import decode_output
from genre_tasks.detection.detections import Detections
from genre_tasks.detection.image_fit import fit_image
from genre_tasks.detection.instance_masks import build_masks
from genre_tasks.detection.networks import Network
from genre_tasks.detection.output_forms import SUPPORTED_FORMS, OutputForm, recognise_form
from genre_tasks.detection.suppression import Candidates, finish_candidates
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float32


@dataclass(frozen=True)
class YoloDetector:
    """A network with what its output means; see :class:`genre_tasks.detection.detector.Detector`.

    Attributes:
        network: computes the output.
        form: how the image is prepared and the output decoded.
        class_names: names by the classes' numbers.
        min_score: detections have at least this score.
        file: where the network is from, for errors.
    """

    network: Network
    form: OutputForm
    class_names: tuple[str, ...]
    min_score: float
    file: Path

    @property
    def has_masks(self) -> bool:
        """Whether detections have masks."""
        return self.form.mask_channels > 0

    @staticmethod
    def from_network(
        network: Network, file: Path, class_names_file: Path | None = None, min_score: float = 0.3
    ) -> YoloDetector:
        """Recognises what a network gives.

        Args:
            network: of a supported family.
            file: where it is from, for errors.
            class_names_file: names of its classes; ``None`` for those in the network's file, or COCO's.
            min_score: detections with a lower score are left out.

        Raises:
            InputError: the network is of no supported family, or the list of names does not fit it.
        """
        height, width = network.input_size
        # Run once, because files may leave the shapes of their outputs open.
        try:
            outputs = network.run(np.full((1, 3, height, width), 0.5, np.float32))
        except Exception as error:  # the libraries' own exceptions have no common class
            raise InputError(f"the detector does not run: {error}", remedy=SUPPORTED_FORMS, file=file) from error
        shapes = [output.shape for output in outputs]
        form = recognise_form(network.input_size, shapes)
        if form is None:
            raise InputError(
                f"the detector gives {[list(shape) for shape in shapes]} for an image of {width} × {height}",
                remedy=SUPPORTED_FORMS,
                file=file,
            )
        names = choose_class_names(form.class_count, network.metadata, class_names_file, file)
        return YoloDetector(network, form, names, min_score, file)

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Finds objects in an image.

        Args:
            image: [H, W, 3] sRGB.

        Returns:
            The detections, best score first.

        Raises:
            InputError: the network gives a class that has no name.
        """
        height, width = image.shape[:2]
        values, placement = fit_image(image, self.network.input_size, self.form)
        outputs = self.network.run(values)
        rows, prototypes = self._split_outputs(outputs)
        found = decode_output(self.form, rows, self.network.input_size, self.min_score)
        # Before the boxes are chosen: a class without a name is an error of the list, wherever its box is.
        self._check_classes(found)
        moved = Candidates(placement.to_image(found.boxes), found.scores, found.classes, found.coefficients)
        best = finish_candidates(moved, width, height)
        masks = None if prototypes is None else build_masks(best, prototypes, placement, width, height)
        return Detections(best.boxes, best.scores, best.classes, masks)

    def _split_outputs(self, outputs: list[Float32]) -> tuple[Float32, Float32 | None]:
        """The output with boxes and the prototypes of masks, without the batch's axis."""
        if not self.has_masks:
            return outputs[0][0], None
        # In a file the outputs can be in either order.
        rows = next(output[0] for output in outputs if output.ndim == 3)
        return rows, next(output[0] for output in outputs if output.ndim == 4)

    def _check_classes(self, found: Candidates) -> None:
        """Stops at a class without a name; only networks that give the class's number itself can have one."""
        if len(found.classes) and int(found.classes.max()) >= len(self.class_names):
            raise InputError(
                f"the detector gives class {int(found.classes.max())}, and the list of class names has "
                f"{len(self.class_names)}",
                remedy="Give a text file with a name for each of the detector's classes, one a line.",
                file=self.file,
            )
