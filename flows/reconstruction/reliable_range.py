"""A reliable range as files: a table with a row for each view, and the curves as a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from genre_tasks.atomic_path import atomic_path
from storage.codecs.png import write_png
from storage.codecs.tables import column, schema, write_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from genre_tasks.reliability.guards import Guards
    from genre_tasks.reliability.reliable_range import ReliableRange

RANGE_SCHEMA = schema(
    "reliable_range/2",
    [
        column("camera", pa.string(), "of the rig"),
        column("frame", pa.int64(), "of the log"),
        column("shift_m", pa.float64(), "metres beside the path, left is positive"),
        column("estimate_db", pa.float64(), "the PSNR that the view is likely to have, dB"),
        column("agreement_db", pa.float64(), "PSNR against recorded images looked up by LiDAR's depth, dB"),
        column("shown", pa.float64(), "share of pixels that some recorded image bears out"),
        column("thin", pa.float64(), "share of pixels covered by less than half"),
        column("floating", pa.float64(), "share of pixels far before the LiDAR's depth"),
        column("actors", pa.int64(), "wholly in the image, counted where a detector was given"),
        column("detected", pa.int64(), "of these by the detector"),
    ],
)


def write_range(folder: Path, reliable_range: ReliableRange, facts: Mapping[str, str]) -> list[str]:
    """Writes a reliable range as ``range.parquet`` and ``range.png``; each file appears whole or not at all.

    Args:
        folder: where to write; it is made if it does not exist.
        reliable_range: the range, its curve and the guards of all views.
        facts: what the table says of itself, such as ``log`` and ``chunk``.

    Returns:
        The paths of the two files.

    Raises:
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # The result itself stands in the table's facts, so that the table can be read without the picture.
    limits = {"left_m": f"{reliable_range.left_m:.3f}", "right_m": f"{reliable_range.right_m:.3f}"}
    table = folder / "range.parquet"
    with atomic_path(table) as part:
        write_table(part, RANGE_SCHEMA, _columns(reliable_range.guards), {**facts, **limits})
    picture = folder / "range.png"
    title = f"{facts.get('log', '')} chunk {facts.get('chunk', '')}: {reliable_range}"
    with atomic_path(picture) as part:
        write_png(part, plot_range(reliable_range, title))
    return [str(table), str(picture)]


def plot_range(reliable_range: ReliableRange, title: str) -> NDArray[np.uint8]:
    """Plots every view's estimated PSNR and the median guards against the shift, and the range that holds.

    Args:
        reliable_range: the range, its curve and the guards of all views.
        title: written above the plot.

    Returns:
        An sRGB image [H, W, 3].
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), dpi=110, layout="constrained")
    # The canvas is made by hand: pyplot would keep figures in a global list and may look for a display.
    canvas = FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    _plot_estimates(above, reliable_range)
    _plot_guards(below, reliable_range)
    # Left of the path is positive, and it belongs on the left of the plot.
    above.invert_xaxis()
    figure.suptitle(title, fontsize=9)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _columns(guards: Sequence[Guards]) -> dict[str, list[Any]]:
    return {
        "camera": [view.camera for view in guards],
        "frame": [view.frame for view in guards],
        "shift_m": [view.shift_m for view in guards],
        "estimate_db": [view.estimate_db for view in guards],
        "agreement_db": [view.agreement_db for view in guards],
        "shown": [view.shown for view in guards],
        "thin": [view.thin for view in guards],
        "floating": [view.floating for view in guards],
        "actors": [view.actors for view in guards],
        "detected": [view.detected for view in guards],
    }


def _plot_estimates(axes: Axes, reliable_range: ReliableRange) -> None:
    points = reliable_range.points
    guards = reliable_range.guards
    on_path = next(point for point in points if point.shift_m == 0)
    shifts = [point.shift_m for point in points]
    axes.axvspan(-reliable_range.right_m, reliable_range.left_m, color="C2", alpha=0.15, label="holds")
    axes.plot([view.shift_m for view in guards], [view.estimate_db for view in guards], ".", color="C0", alpha=0.25)
    axes.plot(shifts, [point.estimate_db for point in points], "o-", color="C0", label="median view")
    limit_db = on_path.estimate_db - reliable_range.limits.max_drop_db
    axes.axhline(limit_db, color="C3", linestyle=":", label="limit")
    axes.set(ylabel="estimated PSNR, dB")
    axes.legend(fontsize=8)


def _plot_guards(axes: Axes, reliable_range: ReliableRange) -> None:
    points = reliable_range.points
    limits = reliable_range.limits
    on_path = next(point for point in points if point.shift_m == 0)
    shifts = [point.shift_m for point in points]
    curves = {
        "shown": ([point.shown - on_path.shown for point in points], -limits.max_hidden),
        "thin": ([point.thin - on_path.thin for point in points], limits.max_thin),
        "floating": ([point.floating - on_path.floating for point in points], limits.max_floating),
    }
    for name, (values, limit) in curves.items():
        (line,) = axes.plot(shifts, values, "o-", label=name)
        axes.axhline(limit, color=line.get_color(), linestyle=":")
    # NaN without a detector, and without any actor in view.
    if math.isfinite(on_path.detected):
        axes.plot(shifts, [p.detected - on_path.detected for p in points], "s--", color="0.4", label="detected")
    axes.axvspan(-reliable_range.right_m, reliable_range.left_m, color="C2", alpha=0.15)
    axes.set(xlabel="metres beside the path (left is positive)", ylabel="fraction, less the path's")
    axes.legend(fontsize=8)
