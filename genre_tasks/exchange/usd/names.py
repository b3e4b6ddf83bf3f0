"""Names of attributes, and of what GenRe adds to a stage in ``customData``."""

from __future__ import annotations

COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"
DEGREE = "radiance:sphericalHarmonicsDegree"

COLORS = "displayColor"
MATRICES = "matrices"
SHOWN = "shown"
"""Names of arrays between the process that reads a stage and its caller, as is the one before."""

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
