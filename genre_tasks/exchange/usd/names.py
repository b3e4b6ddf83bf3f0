"""What GenRe adds to a stage beyond OpenUSD's schema: names of entries in ``customData``."""

from __future__ import annotations

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

CURRENT_VERSION = 1

ROOT_PRIM = "Scene"
GAUSSIANS_PRIM = "gaussians"
