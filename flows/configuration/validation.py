"""Checks plain values and makes a configuration of them; what is wrong is said in one line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from flows.configuration.keys import Place, Places, check_keys, describe_value, find_annotation, takes_list
from flows.configuration.settings import example_list
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ConfigError

# pydantic speaks of types that YAML does not know.
_EXPECTED = {
    "int_type": "it should be a whole number",
    "float_type": "it should be a number",
    "bool_type": "it should be true or false",
    "string_type": "it should be text",
    "tuple_type": "it should be a list",
    "finite_number": "it should be a finite number",
    "too_short": "the list should have at least one item",
    "string_too_short": "it should not be empty",
    "missing": "it is missing",
}


def validate_config(values: Mapping[str, Any], source: str, places: Places | None = None) -> PipelineConfig:
    """Checks plain values: first the keys, so that a mistyped one is answered with the nearest, then the values.

    Args:
        values: plain values by section and key; keys that are left out keep their defaults.
        source: where the values come from, for the error.
        places: where each value comes from, if not all from ``source``.

    Returns:
        The checked configuration.

    Raises:
        ConfigError: a key does not exist, was renamed or removed, or a value is not allowed.

    >>> validate_config({"gnet": {"iteration": 8}}, "the example")
    Traceback (most recent call last):
    genre_tasks.errors.ConfigError: there is no configuration key 'gnet.iteration' (file the example). Did you mean …
    """
    places = places or Places(Place(source), {})
    # Values may also come from a flow's parameters, where JSON may hold anything.
    if not isinstance(values, Mapping):
        raise places.default.error(
            f"a configuration has sections, got {describe_value(values)}", "Write e.g. {gnet: {iterations: 8}}."
        )
    # Before pydantic sees the values: its own message about an unknown key has no suggestion.
    check_keys(values, places)
    try:
        return PipelineConfig.model_validate(values)
    except ValidationError as error:
        # One at a time: further problems are often consequences of the first.
        raise _translate(error.errors()[0], places) from error


def _translate(error: Mapping[str, Any], places: Places) -> ConfigError:
    path = tuple(str(part) for part in error["loc"])
    key = ".".join(path)
    message = error["msg"].removeprefix("Value error, ").replace("Input should", "it should")
    reason = _EXPECTED.get(error["type"], message)
    # A rule on several keys of a section has the section for its input, which nobody wants to read.
    is_section = isinstance(error["input"], Mapping)
    got = "" if is_section else f" (got {describe_value(error['input'])})"
    place = places.find_last_change(path) if is_section else places.find(path)
    remedy = "See `genre show config` for the keys and their values, and the configuration reference for bounds."
    annotation = find_annotation(path)
    if error["type"] == "tuple_type" and takes_list(annotation):
        remedy = f"Write a list: --set '{key}={example_list(annotation)}'."
    return place.error(f"the value of {key} is not allowed: {reason}{got}", remedy)
