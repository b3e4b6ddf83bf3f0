"""Which settings differ between two configurations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_ABSENT = "not there"


def list_differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Lists the settings that differ, with both values.

    Args:
        a: nested settings.
        b: nested settings; either may lack some, as another version wrote it.

    Returns:
        Rows with the setting's name, its value in A and in B.

    >>> list_differences({"gnet": {"iterations": 24, "seed": 0}}, {"gnet": {"iterations": 8, "seed": 0}})
    [{'setting': 'gnet.iterations', 'A': 24, 'B': 8}]
    """
    flat_a = dict(_flatten(a))
    flat_b = dict(_flatten(b))
    rows = [
        {"setting": name, "A": flat_a.get(name, _ABSENT), "B": flat_b.get(name, _ABSENT)}
        for name in dict.fromkeys([*flat_a, *flat_b])
    ]
    return [row for row in rows if row["A"] != row["B"]]


def _flatten(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    flat: list[tuple[str, Any]] = []
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            flat += _flatten(value, f"{prefix}{name}.")
        else:
            flat.append((f"{prefix}{name}", value))
    return flat
