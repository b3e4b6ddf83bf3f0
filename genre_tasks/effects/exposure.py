"""Exposure and white balance: the same point is brighter in one image than in another.

``color_gain`` applies and removes gains; this module measures them. Gains have mean zero (in logarithms) over source
images, or scene and gains could drift apart together.
"""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Effect, EffectParameters, Measurement
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Gain, View


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures how much the gain varies between images that share points, in the channel where it varies most.

    Args:
        measurements: the chunk's colours of points.

    Returns:
        100 times the standard deviation of the log gain; no value where fewer than two images share points.
    """
    linked = measurements.linked
    if linked.sum() < 2:
        return Measurement(None, "no two images share enough points of LiDAR sweeps")
    # Of linked views alone: the others' gains are unknown, not 0.
    spread = measurements.log_gains[linked].std(0)
    channel = int(spread.argmax())
    return Measurement(100 * float(spread[channel]), f"of {int(linked.sum())} images, widest in {'RGB'[channel]}")


def fit(measurements: ChunkMeasurements) -> EffectParameters:
    """Estimates the gains of all views.

    Args:
        measurements: the chunk's colours of points.

    Returns:
        The gains that were measured of source views. Other views take theirs from their camera's neighbours in time,
        along the line through the two nearest ones before the first and after the last source view.
    """
    # Held-out views are not measured: their images are what the scene is judged by.
    known: dict[str, list[tuple[View, Gain]]] = {}
    views = zip(measurements.source_views, measurements.log_gains, measurements.linked, strict=True)
    for view, gain, linked in views:
        if linked:
            red, green, blue = (float(channel) for channel in gain)
            known.setdefault(view.camera, []).append((view, (red, green, blue)))
    gains = {
        (view.camera, view.frame): _interpolate_gain(view, known[view.camera])
        for view in measurements.chunk.views
        if view.camera in known
    }
    return EffectParameters(gains=gains)


def _interpolate_gain(view: View, known: list[tuple[View, Gain]]) -> Gain:
    ordered = sorted(known, key=lambda entry: entry[0].frame)
    times = np.array([source.timestamp_s for source, _ in ordered])
    gains = np.array([gain for _, gain in ordered])
    moment = view.timestamp_s
    if not (np.diff(times) > 0).all():
        # Times that repeat or go back say nothing of the order, which the frames have in any case.
        times = np.array([source.frame for source, _ in ordered], np.float64)
        moment = float(view.frame)
    if len(times) > 1:
        times, gains = _extend_linearly(times, gains)
    red, green, blue = (float(np.interp(moment, times, gains[:, k])) for k in range(3))
    return red, green, blue


def _extend_linearly(times: Float64, gains: Float64) -> tuple[Float64, Float64]:
    # An exposure that swings goes on swinging after the last source image. One interval further is as far as the
    # neighbours can tell: beyond it the gain is held, or a long gap would drive it away.
    before = 2 * gains[0] - gains[1]
    after = 2 * gains[-1] - gains[-2]
    steps = np.diff(times)
    times = np.concatenate([[times[0] - steps[0]], times, [times[-1] + steps[-1]]])
    return times, np.concatenate([before[None], gains, after[None]])


EFFECT = Effect(
    name="exposure",
    property="spread of gain between images",
    unit="%",
    threshold=8.0,
    cost="an affine colour map an image",
    measure=measure,
    fit=fit,
)
