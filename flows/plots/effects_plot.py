"""A plan of effects as a picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.types import EffectsPlan


def drawn(effects: EffectsPlan, title: str = "") -> NDArray[np.uint8]:
    """[H, W, 3], a bar an effect: its value in thresholds, on a logarithmic axis; red where it is called for."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = effects.decisions[::-1]
    figure = Figure(figsize=(8, 0.36 * len(rows) + 1.2), dpi=120, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    least = 0.01
    told = [d.value == d.value and d.threshold > 0 for d in rows]
    parts = [max(d.value / d.threshold, least) if known else least for d, known in zip(rows, told, strict=True)]
    wide = [part - least for part in parts]
    axes.barh(range(len(rows)), wide, left=least, color=["tab:grey" if d.choice == "off" else "tab:red" for d in rows])
    axes.axvline(1, color="black", linewidth=1)
    axes.set(xscale="log", xlim=(least, max(*parts, 10.0) * 30), title=title)
    axes.set_xlabel("value / threshold: right of the line it is called for")
    axes.set_yticks(range(len(rows)), [d.name.replace("_", " ") for d in rows])
    for k, (d, known) in enumerate(zip(rows, told, strict=True)):
        said = f"{d.value:.3g} {d.unit}" if known else d.reason
        axes.text(parts[k] * 1.2, k, f"{d.choice}: {said}", va="center", fontsize=7, backgroundcolor="white")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
