"""How a street calls for each effect, or does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.effects.measures import apart_psnr, beside_psnr, heldout_depth, heldout_people, heldout_psnr, sharp_psnr
from genre_tasks.effects.plan import effect_of
from genre_tasks.logs.types import Truth
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph


@dataclass(frozen=True)
class Case:
    """How a street calls for an effect, how it does not (both as queries), and what is judged, in ``unit``.

    ``calls`` is given how far beyond the threshold (a factor) the property shall be, and the pixels a second that the
    street's fastest camera moves over the scene. ``timed``: whether it asks for the latter; ``plain`` is then at the
    factor ``LITTLE``, for what cannot be set on where the log states nothing of it.
    """

    calls: Callable[[float, float], str]
    measure: Callable[[Chunk, SceneGraph, Truth | None], float]
    unit: str = "dB"
    plain: str = ""
    timed: bool = False

    def query(self, factor: float, px_per_s: float) -> str:
        """Of a street; factor 0 is the one that does not call for it."""
        if factor == 0 and self.timed:
            return self.calls(LITTLE, px_per_s)
        return self.calls(factor, px_per_s) if factor else self.plain


LITTLE = 0.25
LONGEST_S = 0.1
"""The street's cameras take no more for a readout or an exposure."""

PX_PER_K1 = 265.0
"""About what a pixel is shifted for a k1 of 1."""

GLOSS = 0.25
"""Of a street, for each factor: its ratio is 0.4 to 0.5 without any and grows with it, but not in proportion."""


def _limit(name: str) -> float:
    return effect_of(name).threshold


def _seconds(parameter: str, name: str) -> Callable[[float, float], str]:
    def query(factor: float, px_per_s: float) -> str:
        return f"&{parameter}={min(LONGEST_S, factor * _limit(name) / px_per_s):.4g}"

    return query


def _bent(factor: float, _: float) -> str:
    return f"&distortion={factor * _limit('lens_distortion') / PX_PER_K1:.4g}"


PEOPLE_PER_AREA = 3.5
"""About how many walk beside the lane where they cover a per cent of the images; a street has twenty at most."""


def _crowd(factor: float, _: float) -> str:
    count = min(20, max(1, round(factor * _limit("nonrigid_actors") * PEOPLE_PER_AREA)))
    return f"&stride=1&pedestrians={count}&pedestrians_aside_m=5.3"


CASES: dict[str, Case] = {
    "rigid_actors": Case(lambda *_: "", heldout_psnr, plain="&moving=0&pedestrians=0"),
    "nonrigid_actors": Case(_crowd, heldout_people, plain="&pedestrians=0"),
    "rolling_shutter": Case(_seconds("rolling_shutter_s", "rolling_shutter"), beside_psnr, timed=True),
    "lens_distortion": Case(_bent, heldout_psnr, plain=_bent(LITTLE, 0.0)),
    "exposure": Case(lambda x, _: f"&exposure_jitter={x * _limit('exposure') / 100:.4g}", heldout_psnr),
    "motion_blur": Case(_seconds("exposure_s", "motion_blur"), sharp_psnr, timed=True),
    "view_dependent_colour": Case(lambda x, _: f"&gloss={x * GLOSS:.4g}", heldout_psnr),
    "lidar_depth": Case(lambda *_: "", heldout_depth, "%", plain="&lidar_beams=1&lidar_azimuths=90"),
    "anti_aliasing": Case(lambda *_: "", apart_psnr, plain="&standstill=1"),
    "ego_mask": Case(lambda x, _: f"&bonnet={x * _limit('ego_mask') / 100:.4g}", heldout_psnr),
}
"""Those that are modelled and that a street can be made to call for or not. Every street has a sky: there is none that
does not call for the distant region; and whoever drives sees one thing from many distances: a street that does not call
for anti-aliasing is one where the vehicle stands, and no factor is asked for. Rolling shutter is judged beside the
path: held-out frames are sheared as source frames are, and a scene that is sheared too fits them. So is anti-aliasing:
there footprints are other than in any image that the scene was made from, and over what is seen from far and from near
alone. Motion blur is judged by what an ideal camera
would have seen in place of held-out frames, which are blurred, too: three metres beside, errors of place hide most of
what is sharp."""
