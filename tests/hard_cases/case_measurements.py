"""The rows of ``docs/reference/stability.md``: those of the scenes, and those of tests of their own."""

from __future__ import annotations

from tests.hard_cases.render_cases import COMPOSITING, GEOMETRY, Case
from tests.hard_cases.stability import BACKENDS, Row

CPU = ("cpu",)
WHOLE_GRADIENT = 5e-4
"""Of gradients with the threshold band: float32 and float64 fall on different sides of a few decisions."""


def _rows(case: Case) -> tuple[Row, ...]:
    backends = BACKENDS if case.light else CPU
    of = [("image", case.image), ("gradient", case.gradient)]
    if case.whole:
        of.append(("whole gradient", WHOLE_GRADIENT))
    return tuple(Row(case.number, case.words, quantity, bound, backends) for quantity, bound in of)


SCENES = {case: _rows(case) for case in GEOMETRY + COMPOSITING}

FAR_WORLD = Row(4, "the world 1e6 m (or UTM) away, rebased in float64", "change of the image", 1e-4)
_DIRECT = "against direct float32 exponentials"
STREET_DIRECT = Row(7, f"300 000 Gaussians, a street, {_DIRECT}", "image and whole gradient, relative L2", 2e-4, CPU)
NEEDLES_ONLY = Row(7, "100 000 needles, against float64", "image and gradient, relative L2", 5e-5, CPU)
ORDER = Row(8, "one depth or one place: any thread count, again", "changed values", 0.0)
HIDDEN = Row(9, "culled Gaussians added among the others", "changed values", 0.0)
POISON = Row(10, "NaN, Inf or −Inf in one of the 14 attributes of one Gaussian", "changed values elsewhere", 0.0)
# Beside the clamp 1 / (1 − α) multiplies every rounding by up to 100.
DIFFERENCES = {
    "clamp": Row(13, "on both sides of the alpha clamp, against finite differences", "gradient", 5e-5),
    "stop": Row(13, "on both sides of the stop, against finite differences", "gradient", 1e-5),
}
ALPHA_BOUND = Row(14, "alpha over 1 − (1 − p)^N: a cloud, a street, 30 000 layers", "excess", 2e-6)
NO_WEIGHT = Row(15, "expected depth where Σw = 0", "value and gradient", 0.0)
HALF = {
    name: Row(16, f"{name} inputs, against the reference of the same rounded values", "image", 1e-5, CPU)
    for name in ("bfloat16", "float16")
}

FOLDING = Row(
    50, "Gaussians just within and beyond the radius where a distortion folds back", "image and gradient", 1e-5
)
CROSSING = Row(51, "Gaussians that the near plane passes during the readout", "image and gradient", 1e-5)
NO_READOUT = Row(51, "readout 0", "changed values", 0.0)

ROWS = (
    *(row for rows in SCENES.values() for row in rows),
    FAR_WORLD,
    STREET_DIRECT,
    NEEDLES_ONLY,
    ORDER,
    HIDDEN,
    POISON,
    *DIFFERENCES.values(),
    ALPHA_BOUND,
    NO_WEIGHT,
    *HALF.values(),
    FOLDING,
    CROSSING,
    NO_READOUT,
)
