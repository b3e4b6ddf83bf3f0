"""A reliable range as files: a row for each view, and the curve as a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from genre_tasks.atomic_path import atomic_path
from storage.codecs.png import write_png
from storage.codecs.tables import column, schema, write_table

if TYPE_CHECKING:
    from genre_tasks.reliability.reliable_range import ReliableRange

VIEWS = schema(
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


def write(out: Path, found: ReliableRange, facts: Mapping[str, str]) -> list[str]:
    """``range.parquet`` and ``range.png`` in ``out``, each whole or not at all; their paths."""
    out.mkdir(parents=True, exist_ok=True)
    rows = found.guards
    facts = dict(facts) | {"left_m": f"{found.left_m:.3f}", "right_m": f"{found.right_m:.3f}"}
    files = [out / "range.parquet", out / "range.png"]
    with atomic_path(files[0]) as part:
        write_table(part, VIEWS, {f.name: [getattr(g, f.name) for g in rows] for f in VIEWS}, facts)
    with atomic_path(files[1]) as part:
        write_png(part, drawn(found, f"{facts.get('log', '')} chunk {facts.get('chunk', '')}: {found}"))
    return [str(file) for file in files]


def drawn(found: ReliableRange, title: str) -> NDArray[np.uint8]:
    """[H, W, 3]: the estimate of every view and their median against the shift, the range that holds, other guards."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), dpi=110, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    shifts = [p.shift_m for p in found.points]
    path = next(p for p in found.points if p.shift_m == 0)
    above.axvspan(-found.right_m, found.left_m, color="C2", alpha=0.15, label="holds")
    above.plot([g.shift_m for g in found.guards], [g.estimate_db for g in found.guards], ".", color="C0", alpha=0.25)
    above.plot(shifts, [p.estimate_db for p in found.points], "o-", color="C0", label="median view")
    above.axhline(path.estimate_db - found.limits.max_drop_db, color="C3", linestyle=":", label="limit")
    above.set(ylabel="estimated PSNR, dB")
    above.legend(fontsize=8)
    for name, limit in (("shown", -found.limits.max_hidden), ("thin", found.limits.max_thin), ("floating", 0.0)):
        (line,) = below.plot(shifts, [getattr(p, name) - getattr(path, name) for p in found.points], "o-", label=name)
        if limit:
            below.axhline(limit, color=line.get_color(), linestyle=":")
    if math.isfinite(path.detected):
        below.plot(shifts, [p.detected - path.detected for p in found.points], "s--", color="0.4", label="detected")
    below.axvspan(-found.right_m, found.left_m, color="C2", alpha=0.15)
    below.set(xlabel="metres beside the path (left is positive)", ylabel="share, less the path's")
    below.legend(fontsize=8)
    above.invert_xaxis()  # left is on the left
    figure.suptitle(title, fontsize=9)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
