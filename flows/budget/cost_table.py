"""The table of a cost sweep as the list of settings that a budget chooses from."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flows.configuration import load_configuration
from flows.configuration.settings import keys_overlap
from flows.cost_sweep.knobs import EFFECTS
from flows.cost_sweep.parquet import read_settings
from flows.cost_sweep.summary import MEASURES, PSNR, Measure, SettingSummary
from flows.pipeline.definition import RECONSTRUCTION_STAGES, STAGE_BY_NAME
from genre_tasks.errors import ConfigError

_CONFIGS = Path(__file__).resolve().parents[2] / "configs"
_SIZE_KEYS = frozenset({"ingest.width_px", "ingest.height_px"})


@dataclass(frozen=True)
class CostPoint:
    """A setting that was measured: how accurate it is and how long its stages take.

    Attributes:
        name: the setting's name in the sweep, such as ``gnet_iterations=24``.
        changes: ``section.key=value`` over the preset.
        end: the stage whose scene is the result.
        accuracy: more is better; the unit is that of :attr:`CostTable.accuracy_label`.
        seconds: wall time by stage in a process that is warmed up.
    """

    name: str
    changes: tuple[str, ...]
    end: str
    accuracy: float
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class CostTable:
    """The measured settings of one preset, and how fast the machine was that they were measured on.

    Attributes:
        preset: the preset that the settings change.
        accuracy_label: what the accuracy is, for readers.
        points: the settings.
        images: images in a chunk of the sweep, source views and held-out ones.
        pixels: of an image of the sweep.
        settings: ``section.key=value`` over the preset that all of the sweep was measured with, as far as a run needs
            them: those that change a scene or what it takes, but for the size of images.
        calibration_s: seconds of :func:`flows.machine.calibration.measure_calibration_s` on the sweep's machine.
        first_call_s: by stage, how many seconds more the first call in a process takes than a later one.
        machine: the sweep's machine, one line.
    """

    preset: str
    accuracy_label: str
    points: tuple[CostPoint, ...]
    images: float
    pixels: int
    settings: tuple[str, ...]
    calibration_s: float
    first_call_s: Mapping[str, float]
    machine: str


def find_shipped_table(preset: str) -> Path:
    """Finds the table that ships with a preset.

    Args:
        preset: the preset's name.

    Returns:
        A Parquet file in ``configs/``.

    Raises:
        ConfigError: no table ships with the preset.

    >>> find_shipped_table("small").name
    'cost_small.parquet'
    """
    path = _CONFIGS / f"cost_{preset}.parquet"
    if not path.is_file():
        known = ", ".join(p.stem.removeprefix("cost_") for p in sorted(_CONFIGS.glob("cost_*.parquet"))) or "none"
        raise ConfigError(
            f"no times were measured for the preset {preset}",
            remedy=f"Choose a preset whose times ship ({known}), or measure them with "
            f"`genre cost LOG --preset {preset}` and give its cost.parquet with --table.",
        )
    return path


def load_cost_table(path: Path, preset: str, user_keys: Iterable[str] = ()) -> CostTable:
    """Loads the settings of a sweep over a preset that a budget may choose from.

    Left out are settings of effects (the log's plan decides them), of threads (the machine has them) and of the images'
    size (the user asked for it), and settings that were not measured on every chunk on which the preset was.

    Args:
        path: the cost.parquet of a sweep.
        preset: the preset of the run.
        user_keys: configuration keys that the user has set, as ``section.key``.

    Returns:
        The table.

    Raises:
        ConfigError: there is no table, it is of another preset, it does not say how fast its machine was, none of its
            settings was judged, or it changes a key that the user has set.
        ArtifactCorruptError: the file is not a sweep's table.

    >>> table = load_cost_table(find_shipped_table("small"), "small")
    >>> table.preset, "gnet" in table.points[0].seconds
    ('small', True)
    """
    remedy = f"Give the cost.parquet of `genre cost LOG --preset {preset}`."
    if not path.is_file():
        raise ConfigError("there is no table", remedy=remedy, file=path)
    summaries, facts = read_settings(path)
    if facts.get("base") != preset:
        raise ConfigError(f"this table is of the preset {facts.get('base')}", remedy=remedy, file=path)
    if not summaries:
        raise ConfigError("this table has no setting", remedy=remedy, file=path)
    # Without the speed of its machine, a table's seconds say nothing about this one.
    if missing := [name for name in ("calibration_s", "judged", "cold_seconds", "machine") if name not in facts]:
        raise ConfigError(f"this table does not say how fast its machine was ({missing[0]})", remedy=remedy, file=path)
    measure = next((m for m in MEASURES if m.name == facts["judged"]), PSNR)
    points = _list_points(summaries, measure)
    if not points:
        raise ConfigError(f"no setting of this table has a {measure.label}", remedy=remedy, file=path)
    changed_keys = {change.partition("=")[0] for point in points for change in point.changes}
    # A key that both the user and the table set has no right value: one would silently lose.
    if both := sorted(key for key in user_keys if any(keys_overlap(key, changed) for changed in changed_keys)):
        raise ConfigError(
            f"{', '.join(both)} is what a budget decides", remedy="Leave out either --budget or that setting."
        )
    try:
        measured = _Measured.parse(facts)
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ConfigError(f"this table's facts are damaged ({error})", remedy=remedy, file=path) from error
    ingest = load_configuration(preset, settings=measured.settings).ingest
    return CostTable(
        preset=preset,
        accuracy_label=measure.label,
        points=points,
        images=summaries[0].source_images,
        pixels=ingest.width_px * ingest.height_px,
        settings=tuple(setting for setting in measured.settings if _must_match(setting)),
        calibration_s=measured.calibration_s,
        first_call_s=measured.first_call_s,
        machine=facts["machine"],
    )


@dataclass(frozen=True)
class _Measured:
    """What a table says of the sweep that it is of."""

    settings: tuple[str, ...]
    calibration_s: float
    first_call_s: Mapping[str, float]

    @classmethod
    def parse(cls, facts: Mapping[str, str]) -> _Measured:
        """Reads it from the metadata of the table; raises what parsing raises."""
        cold_seconds = json.loads(facts["cold_seconds"])
        return cls(
            settings=tuple(str(setting) for setting in json.loads(facts.get("settings", "[]"))),
            calibration_s=float(facts["calibration_s"]),
            first_call_s={str(stage): float(seconds) for stage, seconds in cold_seconds.items()},
        )


def _list_points(summaries: Sequence[SettingSummary], measure: Measure) -> tuple[CostPoint, ...]:
    # Accuracy is better when larger; of distances it is the opposite.
    sign = 1.0 if measure.more_is_better else -1.0
    return tuple(
        CostPoint(x.setting, x.changes, x.end, sign * x.values[measure.name].average, x.stage_seconds)
        for x in summaries
        # The first line is the preset itself: fewer cells than it has means other chunks, which do not compare.
        if _budget_may_choose(x) and x.n == summaries[0].n and math.isfinite(x.values[measure.name].average)
    )


def _must_match(setting: str) -> bool:
    """Whether a run must have this setting of the sweep."""
    key = setting.partition("=")[0].strip()
    # Predictions allow for the number of pixels, which the table has.
    if key in _SIZE_KEYS:
        return False
    section, _, name = key.partition(".")
    # Evaluation is no part of a budget, and what is kept for its curve takes next to no time.
    return section in {STAGE_BY_NAME[stage].section for stage in RECONSTRUCTION_STAGES} and name != "snapshots"


def _budget_may_choose(summary: SettingSummary) -> bool:
    # The log's plan decides about effects, the machine has its threads, and the user asked for this size of images.
    resizes_images = any(change.startswith("ingest.") for change in summary.changes)
    return summary.knob != EFFECTS and not summary.threads and not resizes_images
