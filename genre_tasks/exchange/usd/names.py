"""Names of attributes and of what GenRe adds to a stage in ``customData``, and the stage's time codes."""

from __future__ import annotations

COLOR_SPACE = "colorSpace:name"
"""Of a prim, for its colours and those of all prims below it."""

COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"
DEGREE = "radiance:sphericalHarmonicsDegree"

COLORS = "displayColor"
MATRICES = "matrices"
SHOWN = "shown"
"""Names of arrays between the process that reads a stage and its caller, as is that of the coefficients."""

VERSION = "genre:version"
"""Of these entries, on the scene's root prim; the others count only where it is there."""

TIMES_S = "genre:timesS"
FRAMES = "genre:frames"
WORLD_SE3_SCENE = "genre:worldSE3Scene"
LOSSES = "genre:losses"

NAME = "genre:name"
"""Of a node, on its Xform, as are the next ones."""
LABEL = "genre:label"
TRACK_ID = "genre:trackId"
SIZE_M = "genre:sizeM"
MOVES = "genre:moves"
ANTIALIASED = "genre:antialiased"
"""Only where it is known."""

SCENE_ENTRIES: dict[str, type] = {TIMES_S: list, FRAMES: list, WORLD_SE3_SCENE: list, LOSSES: list}
NODE_ENTRIES: dict[str, type] = {
    NAME: str,
    LABEL: str,
    TRACK_ID: str,
    SIZE_M: list,
    MOVES: bool,
    ANTIALIASED: bool,
}
"""Entries of ``customData`` and their kinds."""

CURRENT_VERSION = 1

ROOT_PRIM = "Scene"
GAUSSIANS_PRIM = "gaussians"

_CODE_DIGITS = 9


def to_time_code(time_s: float, rate: float) -> float:
    """Gives the time code of a moment: the same one when a stage is written and when it is read.

    Args:
        time_s: seconds.
        rate: time codes a second.

    Returns:
        Rounded to a billionth of a frame, so that frames at equal distances have whole numbers.

    >>> to_time_code(0.1 + 0.2, 10.0)
    3.0
    """
    # Visibility is held from one sample to the next: a code just before its sample would show the one before.
    return round(time_s * rate, _CODE_DIGITS)
