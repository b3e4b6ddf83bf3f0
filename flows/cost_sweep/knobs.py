"""The knobs that trade accuracy for time, and the settings of a sweep.

A setting is the preset with one knob turned, or one of a few designed combinations (``together``): not the full
product, which would take years.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from flows.configuration import load_configuration
from genre_tasks.config import EffectsConfig, PipelineConfig
from genre_tasks.errors import ConfigError

End = Literal["gnet", "enet"]
PRESET_ITSELF = "preset"
TOGETHER, EFFECTS = "together", "effects"
LENGTHS = (1, 4, 8, 16, 24, 48, 72, 144)
ENHANCING = (1 / 6, 1 / 3, 2 / 3, 2.0)
"""ENet's lengths, of the preset's."""
SIZES = ((160, 90), (240, 136), (320, 180), (480, 270))
GAUSSIANS = (0.25, 0.5, 1.0, 2.0, 4.0)
VIEWS = (1, 3, 6, 12)
PERCEPTUAL = (0.0, 0.1, 0.2)
NOT_SWEPT = frozenset({"ego_mask"})
"""Effects that change what is judged, or are knobs of their own (``fixer``)."""


@dataclass(frozen=True)
class Setting:
    """One point of a sweep: ``changes`` are ``section.key=value`` over the preset.

    ``end`` is the stage whose scene is the result: gnet where nothing is fixed. ``threads`` of the CPU, 0: as they are.
    """

    knob: str
    value: str
    changes: tuple[str, ...] = ()
    end: End = "enet"
    threads: int = 0

    @property
    def name(self) -> str:
        """``knob=value``."""
        return self.knob if self.knob == PRESET_ITSELF else f"{self.knob}={self.value}"

    @property
    def effect(self) -> str | None:
        """The effect that the setting turns on or off, if that is its knob."""
        return self.value.split()[0] if self.knob == EFFECTS else None

    @property
    def word(self) -> str:
        """``on`` or ``off``, of :attr:`effect`."""
        return self.value.split()[-1]

    def configuration(self, preset: str, settings: Sequence[str], seed: int) -> PipelineConfig:
        """The preset, the user's settings, the knob, and the seed that orders views and draws noise."""
        seeds = [f"{section}.seed={seed}" for section in ("gnet", "fnet", "enet")]
        return load_configuration(preset, settings=(*settings, *self.changes, *seeds))


def settings_of(preset: str, settings: Sequence[str] = (), knobs: Sequence[str] = ()) -> list[Setting]:
    """The preset itself first, then every value of the ``knobs`` (default: all) that differs from the preset's.

    Raises ``ConfigError`` for a knob that does not exist.
    """
    base = load_configuration(preset, settings=settings)
    known = _knobs(base)
    for name in knobs:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"Did you mean {near[0]}? " if near else ""
            raise ConfigError(f"there is no knob {name!r}", remedy=f"{hint}Known: {', '.join(known)}.")
    out = [Setting(PRESET_ITSELF, "")]
    for name in knobs or known:
        for one in known[name]:
            if (
                one.end != "enet"
                or one.threads
                or load_configuration(preset, settings=(*settings, *one.changes)) != base
            ):
                out.append(one)
    return out


def _knobs(base: PipelineConfig) -> Mapping[str, list[Setting]]:
    points = base.initial.max_points
    enhancing = [max(1, round(base.enet.iterations * x)) for x in ENHANCING]
    return {
        "gnet_iterations": [Setting("gnet_iterations", f"{t}", (f"gnet.iterations={t}",)) for t in LENGTHS],
        "enet_iterations": [Setting("enet_iterations", f"{t}", (f"enet.iterations={t}",)) for t in enhancing],
        "resolution": [
            Setting("resolution", f"{w}x{h}", (f"ingest.width_px={w}", f"ingest.height_px={h}")) for w, h in SIZES
        ],
        "gaussians": [
            Setting("gaussians", f"{n}", (f"initial.max_points={n}",)) for n in (round(points * x) for x in GAUSSIANS)
        ],
        "views": [Setting("views", f"{n}", (f"gnet.views_per_iteration={n}",)) for n in VIEWS],
        "perceptual": [Setting("perceptual", f"{x:g}", (f"gnet.loss.perceptual={x}",)) for x in PERCEPTUAL],
        "fixer": [
            Setting("fixer", "off", end="gnet"),
            *(Setting("fixer", f"gate {x:g}", (f"fnet.gate={x}",)) for x in (0.05, 0.2)),
            *(Setting("fixer", "bfloat16" if x else "float32", (f"fnet.half={x}".lower(),)) for x in (True, False)),
        ],
        "shifts": [
            Setting("shifts", " ".join(f"{x:g}" for x in shifts), (f"novel_views.shifts_m={list(shifts)}",))
            for shifts in ((3.0,), (1.5, -1.5), (3.0, 1.5, -1.5, -3.0))
        ],
        EFFECTS: [
            Setting(EFFECTS, f"{name} {word}", (f"effects.{name}={word}",))
            for name, field in EffectsConfig.model_fields.items()
            for word in ("on", "off")
            if name not in NOT_SWEPT and field.annotation != Literal["auto", "off"]
        ],
        "threads": [Setting("threads", f"{n}", threads=n) for n in _halved(os.cpu_count() or 1)],
        TOGETHER: _together(points, (enhancing[0], enhancing[-1])),
    }


def _together(points: int, enhancing: tuple[int, int]) -> list[Setting]:
    """Several knobs at once: lengths of GNet and ENet, as they share stages; and the cheapest and the costliest."""
    fewer = f"initial.max_points={points // 2}"
    small = ("ingest.width_px=240", "ingest.height_px=136")
    designed: list[tuple[str, tuple[str, ...], End]] = [("least", (*small, fewer, "gnet.iterations=8"), "gnet")]
    for gnet in (4, 8, 16, 24, 48, 144):
        designed.append((f"GNet {gnet} alone", (f"gnet.iterations={gnet}",), "gnet"))
        for enet in enhancing:
            changes = (f"gnet.iterations={gnet}", f"enet.iterations={enet}")
            designed.append((f"GNet {gnet}, ENet {enet}", changes, "enet"))
    most = (f"initial.max_points={2 * points}", "gnet.iterations=144", "gnet.views_per_iteration=6")
    designed.append(("most", (*most, f"enet.iterations={enhancing[1]}"), "enet"))
    return [Setting(TOGETHER, name, changes, end) for name, changes, end in designed]


def _halved(cores: int) -> list[int]:
    """1, 2, 4 … below the number of cores."""
    out = [1]
    while 2 * out[-1] < cores:
        out.append(2 * out[-1])
    return [n for n in out if n < cores]
