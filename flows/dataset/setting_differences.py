"""Settings that the logs of a dataset were made with, where they are not the preset's."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from genre_tasks.errors import InputError


@dataclass(frozen=True)
class SettingDifference:
    """A setting that some logs were not made with as the preset has it.

    Attributes:
        key: ``section.key``.
        preset: the preset's value.
        used: the value that was used.
        logs: how many logs were made so.
    """

    key: str
    preset: Any
    used: Any
    logs: int


class LogDifference(NamedTuple):
    """A setting that one run did not have as the preset has it.

    Attributes:
        log: the log's URI.
        key: ``section.key``.
        preset: the preset's value.
        used: the value that was used.
    """

    log: str
    key: str
    preset: Any
    used: Any


def list_differences(record: Mapping[str, Any]) -> list[LogDifference]:
    """Lists the settings of a run that differ from its preset.

    Args:
        record: of the run.

    Returns:
        One entry for each setting.

    Raises:
        InputError: the record does not have two values for a setting.
    """
    differences = []
    for key, values in record["differs"].items():
        if not isinstance(values, list) or len(values) != 2:
            raise InputError(
                f"the record of run {record['run']} names no two values for {key}", remedy="Run the log again."
            )
        differences.append(LogDifference(record["log"], key, values[0], values[1]))
    return differences


def count_differences(differences: Iterable[LogDifference]) -> tuple[SettingDifference, ...]:
    """Counts the logs that were made with a setting.

    Args:
        differences: of all runs; several may be of chunks of one log.

    Returns:
        One entry for each setting and value, in the order of the keys.

    >>> count_differences([LogDifference("a", "gnet.iterations", 100, 2)] * 2)
    (SettingDifference(key='gnet.iterations', preset=100, used=2, logs=1),)
    """
    equal: dict[tuple[str, str], list[LogDifference]] = {}
    for difference in differences:
        values = repr([difference.preset, difference.used])
        equal.setdefault((difference.key, values), []).append(difference)
    return tuple(
        SettingDifference(same[0].key, same[0].preset, same[0].used, len({difference.log for difference in same}))
        for _, same in sorted(equal.items())
    )
