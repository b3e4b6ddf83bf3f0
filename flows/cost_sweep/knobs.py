"""The knobs that trade accuracy for time, and the settings of a sweep.

A setting is the preset with one knob turned, or one of a few designed combinations (``together``): not the full
product, which would take years.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from flows.configuration import load_configuration
from flows.machine.facts import count_cores
from genre_tasks.config import EffectsConfig, PipelineConfig
from genre_tasks.errors import ConfigError
from genre_tasks.suggestions import did_you_mean

End = Literal["gnet", "enet"]
PRESET_ITSELF = "preset"
TOGETHER = "together"
MORE_GAUSSIANS = "more_gaussians"
EFFECTS = "effects"
RESOLUTION = "resolution"
GNET_ITERATIONS = (1, 4, 8, 16, 24, 48, 72, 144)
ENET_FRACTIONS = (1 / 6, 1 / 3, 2 / 3, 2.0)
"""ENet's iterations, as fractions of the preset's."""
IMAGE_SIZES = ((160, 90), (240, 136), (320, 180), (480, 270))
GAUSSIAN_FRACTIONS = (0.25, 0.5, 1.0, 2.0, 4.0)
VIEWS_PER_ITERATION = (1, 3, 6, 12)
PERCEPTUAL_WEIGHTS = (0.0, 0.1, 0.2)
FIXER_GATES = (0.05, 0.2)
NOVEL_VIEW_SHIFTS_M = ((3.0,), (1.5, -1.5), (3.0, 1.5, -1.5, -3.0))
IN_TURNS = "novel_views.every=2"
"""The left side at even source frames, the right side at odd ones: half as many views to render and to repair."""
COMBINED_GNET_ITERATIONS = (4, 8, 16, 24, 48, 144)
# On validation street 900, 160 000 LiDAR points and 72 iterations of GNet alone give the perceptual distance at 3 m
# that the preset small reaches with its fixer, in half of the time.
# Eight times as many lower that distance on validation streets 900–902 as well, but cost 0.3 dB at 3 m on two of them.
# Of four times as many, GNet alone makes images at 3 m worse again beyond 144 iterations, on street 900.
COMBINED_GAUSSIAN_FACTORS = (2, 4)
# A short ENet at the preset's learning rates first undoes what GNet reached: on street 900, after 144 iterations of
# GNet on 160 000 points, 16 iterations bring back the perceptual distance at 3 m that they began with. At the
# preset's rates times this factor, and without a split, they lower it from 0.428 to 0.411, as 32 iterations on twice
# the Gaussians do at full rates (one order of views).
LOW_RATE_FACTOR = 0.35
NOT_SWEPT = frozenset({"ego_mask"})
"""Effects that change which pixels are compared, or that are knobs of their own (``fixer``)."""


@dataclass(frozen=True)
class Setting:
    """One point of a sweep.

    Attributes:
        knob: what is turned; ``preset`` for the preset itself.
        value: to what it is turned.
        changes: ``section.key=value`` over the preset.
        end: the stage whose scene is the result; ``gnet`` where nothing is fixed.
        threads: threads of the CPU; 0 leaves them as they are.
    """

    knob: str
    value: str
    changes: tuple[str, ...] = ()
    end: End = "enet"
    threads: int = 0

    @property
    def name(self) -> str:
        """Names the setting, as ``knob=value``.

        >>> Setting("views", "6").name
        'views=6'
        """
        return self.knob if self.knob == PRESET_ITSELF else f"{self.knob}={self.value}"

    @property
    def effect(self) -> str | None:
        """The effect that the setting turns on or off, if that is its knob."""
        return self.value.split()[0] if self.knob == EFFECTS else None

    @property
    def effect_state(self) -> str:
        """Tells whether :attr:`effect` is set ``on`` or ``off``.

        >>> Setting("effects", "exposure off").effect_state
        'off'
        """
        return self.value.split()[-1]

    def configuration(self, preset: str, settings: Sequence[str], seed: int) -> PipelineConfig:
        """Builds the configuration of this setting.

        Args:
            preset: name of the preset.
            settings: the user's ``section.key=value`` over the preset; the knob comes after them.
            seed: orders the views of GNet and ENet, and draws the fixer's noise.

        Raises:
            ConfigError: a setting is unknown or out of range.
        """
        # Seeds come last, so that no setting of the user can make two cells equal.
        seeds = [f"{section}.seed={seed}" for section in ("gnet", "fnet", "enet")]
        return load_configuration(preset, settings=(*settings, *self.changes, *seeds))


def list_settings(preset: str, settings: Sequence[str] = (), knobs: Sequence[str] = ()) -> list[Setting]:
    """Lists what a sweep measures.

    Args:
        preset: name of the preset.
        settings: the user's ``section.key=value`` over the preset.
        knobs: names of knobs; all of them if empty.

    Returns:
        The preset itself first, then every value of the knobs that differs from the preset's.

    Raises:
        ConfigError: there is no such knob, or one is named twice.

    >>> [s.name for s in list_settings("small", knobs=["views"])]
    ['preset', 'views=1', 'views=6', 'views=12']
    """
    base = load_configuration(preset, settings=settings)
    known = _knobs(base)
    for name in knobs:
        if name not in known:
            remedy = f"{did_you_mean(name, known)}Known: {', '.join(known)}."
            raise ConfigError(f"there is no knob {name!r}", remedy=remedy)
    if len(set(knobs)) != len(knobs):
        raise ConfigError(f"the knobs {', '.join(knobs)} name one twice", remedy="Name each knob once.")
    # The preset comes first: without its cells nothing can be compared when a sweep is stopped.
    out = [Setting(PRESET_ITSELF, "")]
    for name in knobs or known:
        out += [setting for setting in known[name] if _differs_from_preset(setting, preset, settings, base)]
    # Rounding may give a value several times, and a setting with more cells than the preset is compared with nothing.
    return list({setting.name: setting for setting in out}.values())


def _differs_from_preset(setting: Setting, preset: str, settings: Sequence[str], base: PipelineConfig) -> bool:
    # An earlier end and a number of threads are not in the configuration, so comparing it would miss them.
    if setting.end != "enet" or setting.threads:
        return True
    return load_configuration(preset, settings=(*settings, *setting.changes)) != base


def _knobs(base: PipelineConfig) -> Mapping[str, list[Setting]]:
    points = base.initial.max_points
    enet_iterations = [max(1, round(base.enet.iterations * x)) for x in ENET_FRACTIONS]
    return {
        "gnet_iterations": [_turn("gnet_iterations", f"{n}", f"gnet.iterations={n}") for n in GNET_ITERATIONS],
        "enet_iterations": [_turn("enet_iterations", f"{n}", f"enet.iterations={n}") for n in enet_iterations],
        RESOLUTION: [
            _turn(RESOLUTION, f"{w}x{h}", f"ingest.width_px={w}", f"ingest.height_px={h}") for w, h in IMAGE_SIZES
        ],
        "gaussians": [
            _turn("gaussians", f"{n}", f"initial.max_points={n}")
            for n in (round(points * x) for x in GAUSSIAN_FRACTIONS)
        ],
        "views": [_turn("views", f"{n}", f"gnet.views_per_iteration={n}") for n in VIEWS_PER_ITERATION],
        "perceptual": [_turn("perceptual", f"{x:g}", f"gnet.loss.perceptual={x}") for x in PERCEPTUAL_WEIGHTS],
        "fixer": [
            Setting("fixer", "off", end="gnet"),
            *(_turn("fixer", f"gate {x:g}", f"fnet.gate={x}") for x in FIXER_GATES),
            _turn("fixer", "bfloat16", "fnet.half=true"),
            _turn("fixer", "float32", "fnet.half=false"),
        ],
        "shifts": [
            *(
                _turn("shifts", " ".join(f"{x:g}" for x in shifts), f"novel_views.shifts_m={list(shifts)}")
                for shifts in NOVEL_VIEW_SHIFTS_M
            ),
            _turn("shifts", "in turns", IN_TURNS),
        ],
        EFFECTS: [
            _turn(EFFECTS, f"{name} {state}", f"effects.{name}={state}")
            for name in _switchable_effects()
            for state in ("on", "off")
        ],
        "threads": [Setting("threads", f"{n}", threads=n) for n in _fewer_threads(count_cores())],
        TOGETHER: _combinations(points, (enet_iterations[0], enet_iterations[-1])),
        MORE_GAUSSIANS: _settings_of_more_gaussians(base, enet_iterations[:3]),
    }


def _turn(knob: str, value: str, *changes: str) -> Setting:
    return Setting(knob, value, changes)


def _switchable_effects() -> list[str]:
    fields = EffectsConfig.model_fields.items()
    # An effect that can only be off or automatic has nothing to turn on.
    return [n for n, field in fields if n not in NOT_SWEPT and field.annotation != Literal["auto", "off"]]


def _combinations(points: int, enet_iterations: tuple[int, int]) -> list[Setting]:
    """Turns several knobs at once: GNet's and ENet's iterations, as they share stages, and the two extremes."""
    # Designed combinations instead of the full product, which would take years.
    half_the_points = f"initial.max_points={points // 2}"
    small_images = ("ingest.width_px=240", "ingest.height_px=136")
    out = [Setting(TOGETHER, "least", (*small_images, half_the_points, "gnet.iterations=8"), "gnet")]
    for gnet in COMBINED_GNET_ITERATIONS:
        out.append(Setting(TOGETHER, f"GNet {gnet} alone", (f"gnet.iterations={gnet}",), "gnet"))
        for enet in enet_iterations:
            changes = (f"gnet.iterations={gnet}", f"enet.iterations={enet}")
            out.append(Setting(TOGETHER, f"GNet {gnet}, ENet {enet}", changes))
    most = (f"initial.max_points={2 * points}", "gnet.iterations=144", "gnet.views_per_iteration=6")
    out.append(Setting(TOGETHER, "most", (*most, f"enet.iterations={enet_iterations[1]}")))
    return out


def _settings_of_more_gaussians(base: PipelineConfig, enet_iterations: Sequence[int]) -> list[Setting]:
    """Starts from more LiDAR points, and spends less on ENet or nothing on the fixer."""
    shortest, short, longer = enet_iterations
    out = []
    for points in (base.initial.max_points * factor for factor in COMBINED_GAUSSIAN_FACTORS):
        start = f"initial.max_points={points}"
        most = GNET_ITERATIONS[-1]
        for gnet in sorted({base.gnet.iterations, most}):
            alone = (start, f"gnet.iterations={gnet}")
            out.append(Setting(MORE_GAUSSIANS, f"{points}, GNet {gnet} alone", alone, "gnet"))
        for enet in (short, longer):
            fixed = (start, f"gnet.iterations={most}", f"enet.iterations={enet}")
            out.append(Setting(MORE_GAUSSIANS, f"{points}, GNet {most}, ENet {enet}", fixed))
        for enet in (shortest, short):
            unsplit = (start, f"gnet.iterations={most}", f"enet.iterations={enet}", *_low_rate_enet(base))
            name = f"{points}, GNet {most}, ENet {enet} at low rates"
            out.append(Setting(MORE_GAUSSIANS, name, unsplit))
            # With both sides this takes half as long again as GNet alone, and budgets in between would find nothing.
            if enet == shortest:
                out.append(Setting(MORE_GAUSSIANS, f"{name}, sides in turns", (*unsplit, IN_TURNS)))
    return out


def _low_rate_enet(base: PipelineConfig) -> tuple[str, ...]:
    """Splits nothing before ENet, and lowers its learning rates."""
    rates = base.enet.learning_rates
    # Without rates of the preset, those that the weights were trained with stay.
    if rates is None:
        return ("enet.split_fraction=0",)
    lowered = ", ".join(f"{name}: {LOW_RATE_FACTOR * value:.4g}" for name, value in rates.model_dump().items())
    return ("enet.split_fraction=0", f"enet.learning_rates={{{lowered}}}")


def _fewer_threads(cores: int) -> list[int]:
    """Lists 1, 2, 4 … below the number of cores."""
    out = [1]
    # All cores are the preset itself, so the list stays below their number.
    while 2 * out[-1] < cores:
        out.append(2 * out[-1])
    return [n for n in out if n < cores]
