"""How a street calls for each effect, or does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.effects.measures import (
    SceneMeasure,
    footprint_change_psnr,
    heldout_depth_score,
    heldout_people_psnr,
    heldout_psnr,
    masked_cameras_psnr,
    novel_view_psnr,
    sharp_psnr,
)
from genre_tasks.effects.plan import load_effect

MILD_FACTOR = 0.25
LONGEST_S = 0.1
"""The street's cameras take no more for a readout or an exposure."""
PX_PER_K1 = 265.0
"""About how many pixels a point is shifted for a k1 of 1."""
GLOSS_PER_FACTOR = 0.25
"""Gloss of a street for each factor: its ratio is 0.4 to 0.5 without any and grows with it, but not in proportion."""
PEOPLE_PER_PERCENT = 3.5
"""About how many walk beside the lane where they cover a per cent of the images; a street has twenty at most."""
MOST_PEOPLE = 20


@dataclass(frozen=True)
class Case:
    """How a street calls for an effect, how it does not, and what is measured.

    Attributes:
        query_at: makes the query of a street that calls for the effect. Its arguments are by which factor the
            property exceeds the threshold, and pixels per second at which the street's fastest camera moves over the
            scene.
        measure: what scenes are evaluated by.
        unit: of the measure.
        plain: query of a street that does not call for the effect; ``None`` where every street calls for it.
        needs_speed: whether ``query_at`` uses the speed. The street that does not call for the effect is then at
            ``MILD_FACTOR``, as a log that states no times cannot have the effect set on.
    """

    query_at: Callable[[float, float], str]
    measure: SceneMeasure
    unit: str = "dB"
    plain: str | None = ""
    needs_speed: bool = False

    def query(self, factor: float, px_per_s: float) -> str:
        """Makes the query of a street.

        Args:
            factor: of the threshold; 0 for the street that does not call for the effect.
            px_per_s: speed of the fastest camera over the scene.

        Returns:
            Parameters to append to the street's URI.

        Raises:
            ValueError: every street calls for the effect, and the factor is 0.

        >>> CASES["rigid_actors"].query(0, 0.0)
        '&moving=0&pedestrians=0'
        """
        if factor == 0:
            # A street without times could not have the effect set on, and the loss could not be measured.
            plain = self.query_at(MILD_FACTOR, px_per_s) if self.needs_speed else self.plain
            if plain is None:
                raise ValueError("every street calls for the effect")
            return plain
        return self.query_at(factor, px_per_s)


def _threshold(name: str) -> float:
    return load_effect(name).threshold


def _in_percent(parameter: str, effect: str) -> Callable[[float, float], str]:
    """Makes a query whose parameter is a fraction where the threshold is in per cent."""
    return lambda factor, _: f"&{parameter}={factor * _threshold(effect) / 100:.4g}"


def _in_seconds(parameter: str, effect: str) -> Callable[[float, float], str]:
    """Makes a query whose parameter is a duration where the threshold is in pixels."""

    def query(factor: float, px_per_s: float) -> str:
        # The street's cameras take no longer durations, however slowly they move.
        return f"&{parameter}={min(LONGEST_S, factor * _threshold(effect) / px_per_s):.4g}"

    return query


def _same_at_every_factor(query: str) -> Callable[[float, float], str]:
    return lambda factor, px_per_s: query


def _distorted(factor: float, _px_per_s: float) -> str:
    return f"&distortion={factor * _threshold('lens_distortion') / PX_PER_K1:.4g}"


def _glossy(factor: float, _px_per_s: float) -> str:
    return f"&gloss={factor * GLOSS_PER_FACTOR:.4g}"


def _crowded(factor: float, _px_per_s: float) -> str:
    # A street places whole people, so the share of pixels is reached only roughly.
    people = round(factor * _threshold("nonrigid_actors") * PEOPLE_PER_PERCENT)
    return f"&stride=1&pedestrians={min(MOST_PEOPLE, max(1, people))}&pedestrians_aside_m=5.3"


# Every street has a sky: there is none that does not call for the distant region, so that has no case.
CASES: dict[str, Case] = {
    "rigid_actors": Case(_same_at_every_factor(""), heldout_psnr, plain="&moving=0&pedestrians=0"),
    "nonrigid_actors": Case(_crowded, heldout_people_psnr, plain="&pedestrians=0"),
    # Held-out frames are sheared as source frames are, and a scene that is sheared too fits them. Only views away
    # from the path tell the two apart.
    "rolling_shutter": Case(_in_seconds("rolling_shutter_s", "rolling_shutter"), novel_view_psnr, needs_speed=True),
    "lens_distortion": Case(_distorted, heldout_psnr, plain=_distorted(MILD_FACTOR, 0.0)),
    "exposure": Case(_in_percent("exposure_jitter", "exposure"), heldout_psnr),
    # Held-out frames are blurred too, so an ideal camera in their place is the truth. Three metres beside the path
    # errors of place would hide most of what is sharp.
    "motion_blur": Case(_in_seconds("exposure_s", "motion_blur"), sharp_psnr, needs_speed=True),
    "view_dependent_colour": Case(_glossy, heldout_psnr),
    # A handful of returns an image lower the error of depth already. Without any, neither state has a term.
    "lidar_depth": Case(_same_at_every_factor(""), heldout_depth_score, unit="%", plain=None),
    # A vehicle that drives sees each thing from many distances: only a standing one does not call for anti-aliasing.
    # Away from the path footprints differ from those in any image that the scene was made from.
    "anti_aliasing": Case(_same_at_every_factor(""), footprint_change_psnr, plain="&standstill=1"),
    "ego_mask": Case(_in_percent("bonnet", "ego_mask"), masked_cameras_psnr),
}
"""The effects that are modelled and that a street can be made to call for or not."""
