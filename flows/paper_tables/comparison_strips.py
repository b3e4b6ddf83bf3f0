"""The rows of a figure that compares methods, and how they are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    pass

Pixels = NDArray[np.uint8]  # [H, W, 3] sRGB


@dataclass(frozen=True)
class ComparisonStrip:
    """A row of the picture.

    Attributes:
        label: the method's name, or what else the row shows.
        images: one for each column, [H, W, 3] sRGB.
        captions: what each image shows, after the label.
    """

    label: str
    images: tuple[Pixels, ...]
    captions: tuple[str, ...]


def draw_strips(strips: Sequence[ComparisonStrip], title: str) -> Pixels:
    """Draws the picture.

    Args:
        strips: its rows, at least one, all with as many images.
        title: above the rows.

    Returns:
        [H, W, 3] sRGB.
    """
    # Imported here, because the command line should start without matplotlib.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height, width = strips[0].images[0].shape[:2]
    columns = len(strips[0].images)
    dpi = 100
    # One image pixel is about one pixel of the picture; labels take 24 pixels a row, the title 40.
    size = ((columns * width + 40) / dpi, (len(strips) * (height + 24) + 40) / dpi)
    figure = Figure(figsize=size, dpi=dpi, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=9)
    panels = figure.subplots(len(strips), columns, squeeze=False)
    for line, strip in zip(panels, strips, strict=True):
        for axes, image, caption in zip(line, strip.images, strip.captions, strict=True):
            # Smoothing would hide the very artefacts that the figure compares.
            axes.imshow(image, interpolation="nearest")
            axes.set_axis_off()
            axes.set_title(f"{strip.label}, {caption}", fontsize=8, pad=2)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
