"""The keys of the configuration: which there are, what kind of value each takes, and the nearest of a mistyped one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel

from flows.configuration.key_tables import REMOVED_KEYS, RENAMED_KEYS
from flows.yaml_values import KeyPath
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ConfigError
from genre_tasks.suggestions import did_you_mean

_LONGEST_SHOWN = 80


@dataclass(frozen=True)
class Place:
    """Where a value comes from, for errors.

    Attributes:
        file: the file, or a word such as ``preset small``; ``None`` for a setting, which names itself.
        line: the line in the file, from 1; ``None`` where there are no lines.
    """

    file: str | None
    line: int | None = None

    def error(self, problem: str, remedy: str) -> ConfigError:
        """Makes an error that names the place.

        Args:
            problem: what is wrong, without a full stop.
            remedy: what to do.

        >>> print(Place("a.yaml", 3).error("there is no key 'x'", "Delete it."))
        line 3: there is no key 'x' (file a.yaml). Delete it.
        """
        where = "" if self.line is None else f"line {self.line}: "
        return ConfigError(where + problem, remedy=remedy, file=self.file)


@dataclass(frozen=True)
class Places:
    """Where all values of a configuration come from.

    Attributes:
        default: of keys that are not listed.
        by_key: the place of a key, by the keys that lead to it.
    """

    default: Place
    by_key: Mapping[KeyPath, Place]

    def find(self, path: KeyPath) -> Place:
        """Finds the place of a key: its own, or that of the nearest key around it.

        Args:
            path: the keys that lead to it.
        """
        for length in range(len(path), 0, -1):
            if path[:length] in self.by_key:
                return self.by_key[path[:length]]
        return self.find_last_change(path)

    def find_last_change(self, path: KeyPath) -> Place:
        """Finds the place of what was changed last in a section, for a rule that several keys break together.

        Args:
            path: the keys that lead to the section.
        """
        below = [place for key, place in self.by_key.items() if key[: len(path)] == path]
        return below[-1] if below else self.default

    def replaced(self, path: KeyPath, place: Place) -> Places:
        """Gives the places after a change of one key and all below it.

        Args:
            path: the keys that lead to it.
            place: of the new value.
        """
        others = {key: known for key, known in self.by_key.items() if key[: len(path)] != path}
        return Places(self.default, {**others, path: place})


def describe_value(value: object) -> str:
    """Shows a value in an error: on one line, shortened where it is long.

    Args:
        value: whatever the user gave.

    >>> describe_value("8 m"), describe_value(True)
    ("'8 m'", 'true')
    """
    # As YAML and JSON write them.
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    try:
        text = repr(value)
    except ValueError:
        # Python refuses to write integers of thousands of digits.
        text = "a number of thousands of digits"
    except RecursionError:
        text = "a deeply nested value"
    return text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN - 1]}…"


def list_kinds(annotation: Any) -> tuple[Any, ...]:
    """Lists the types that a field's annotation allows.

    Args:
        annotation: of a field of a section.

    Returns:
        The members of a union, else the annotation itself; each without pydantic's constraints.

    >>> list_kinds(int | None)
    (<class 'int'>, <class 'NoneType'>)
    """
    if get_origin(annotation) is Annotated:
        return list_kinds(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return tuple(kind for member in get_args(annotation) for kind in list_kinds(member))
    return (annotation,)


def section_type(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    """Finds the section's model if a field's annotation is one, and whether the field may be null instead.

    Args:
        annotation: of a field; one that may be a section or null, as ``gnet.refine``, is a union of both.
    """
    kinds = list_kinds(annotation)
    for kind in kinds:
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind, type(None) in kinds
    return None, False


def takes_text(annotation: Any) -> bool:
    """Tells whether a field takes words alone, apart from null.

    Args:
        annotation: of the field.
    """
    kinds = [kind for kind in list_kinds(annotation) if kind is not type(None)]
    return all(kind is str or get_origin(kind) is Literal for kind in kinds)


def takes_list(annotation: Any) -> bool:
    """Tells whether a field takes a list.

    Args:
        annotation: of the field.
    """
    return any(get_origin(kind) is tuple for kind in list_kinds(annotation))


def find_annotation(path: KeyPath) -> Any:
    """Finds the annotation of a key.

    Args:
        path: the keys that lead to it, such as ``("gnet", "iterations")``.

    Returns:
        The field's annotation; ``None`` if there is no such key.

    >>> find_annotation(("gnet", "iterations"))
    <class 'int'>
    """
    model: type[BaseModel] | None = PipelineConfig
    annotation: Any = None
    for key in path:
        if model is None or key not in model.model_fields:
            return None
        annotation = model.model_fields[key].annotation
        model, _ = section_type(annotation)
    return annotation


def check_keys(values: Mapping[Any, Any], places: Places) -> None:
    """Checks that all keys exist and that sections are mappings.

    Args:
        values: plain values by section and key.
        places: where they come from.

    Raises:
        ConfigError: a key does not exist, was renamed or removed, or a section is no mapping.
    """
    _check_section(values, PipelineConfig, (), places)


def _check_section(values: Mapping[Any, Any], model: type[BaseModel], path: KeyPath, places: Places) -> None:
    for key, value in values.items():
        here = (*path, key if isinstance(key, str) else str(key))
        place = places.find(here)
        _check_key(here, model, place)
        section, is_optional = section_type(model.model_fields[key].annotation)
        if section is None or (is_optional and value is None):
            continue
        full_key = ".".join(here)
        if not isinstance(value, Mapping):
            raise place.error(
                f"'{full_key}' is a section, got {describe_value(value)}",
                f"Write e.g. --set {full_key}.{next(iter(section.model_fields))}=….",
            )
        _check_section(value, section, here, places)


def _check_key(path: KeyPath, model: type[BaseModel], place: Place) -> None:
    full_key = ".".join(path)
    if full_key in RENAMED_KEYS:
        raise place.error(f"the configuration key '{full_key}' was renamed", f"Write '{RENAMED_KEYS[full_key]}'.")
    if full_key in REMOVED_KEYS:
        raise place.error(f"the configuration key '{full_key}' was removed", REMOVED_KEYS[full_key])
    key = path[-1]
    if key not in model.model_fields:
        prefix = "".join(f"{part}." for part in path[:-1])
        # Shortened, as comparing words takes long where one of them has thousands of letters.
        suggestion = did_you_mean(key[:_LONGEST_SHOWN], model.model_fields, prefix)
        raise place.error(
            f"there is no configuration key {describe_value(full_key)}",
            f"{suggestion}Known here: {', '.join(model.model_fields)}.",
        )
