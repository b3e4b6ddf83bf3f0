"""Paths in the configuration, written so that they name the same files from every working folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from flows.configuration.keys import find_annotation, takes_text
from flows.configuration.settings import parse_setting
from flows.configuration.validation import validate_config
from flows.yaml_values import KeyPath
from genre_tasks.config import LPIPS_NETWORKS, PipelineConfig
from genre_tasks.user_paths import expand_user_path

PATH_KEYS = frozenset({"points", "scene", "weights", "inception", "lpips"})
"""Last parts of the keys that take the path of a file or folder."""


def make_paths_absolute(config: PipelineConfig) -> PipelineConfig:
    """Writes a configuration so that it names the same files from every working folder.

    Args:
        config: the merged configuration, wherever its values come from.

    Returns:
        The configuration with absolute paths of those files and folders that are here; the same object where there is
        no such path.

    Raises:
        ConfigError: the working folder's own path has a character that no value may have.
        InputError: a path begins with ``~NAME``, and there is no such user.

    >>> config = PipelineConfig()
    >>> make_paths_absolute(config) is config
    True
    """
    values = config.model_dump(mode="json")
    absolute = _replace_paths((), values)
    return config if absolute == values else validate_config(absolute, "the working folder")


def make_setting_absolute(setting: str) -> str:
    """Writes a setting so that it names the same files from every working folder.

    A merged configuration is made absolute as a whole. This is for settings that travel as text: to a worker, or in a
    table of costs.

    Args:
        setting: ``section.key=value``, or ``section={key: value}``.

    Returns:
        The setting with absolute paths of those files and folders that are here, as JSON where it is of a section; as
        it was where there is no such path.

    Raises:
        ConfigError: as :func:`flows.configuration.settings.parse_setting` raises it.
        InputError: a path begins with ``~NAME``, and there is no such user.

    >>> make_setting_absolute("fnet.weights=builtin"), make_setting_absolute("gnet.iterations=9")
    ('fnet.weights=builtin', 'gnet.iterations=9')
    """
    path, value = parse_setting(setting)
    # Numbers and lists hold no paths.
    if not isinstance(value, str | Mapping):
        return setting
    absolute = _replace_paths(path, value)
    if absolute == value:
        return setting
    text = absolute if isinstance(absolute, str) else json.dumps(absolute, ensure_ascii=False)
    return f"{'.'.join(path)}={text}"


def _replace_paths(path: KeyPath, value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _replace_paths((*path, key), part) for key, part in value.items()}
    annotation = find_annotation(path)
    is_path = path[-1] in PATH_KEYS and annotation is not None and takes_text(annotation)
    return _make_absolute(path[-1], value) if is_path and isinstance(value, str) else value


def _make_absolute(key: str, value: str) -> str:
    # A path from the root stays as it is written, since results are named by what is written.
    if _is_name(key, value) or Path(value).is_absolute():
        return value
    file = expand_user_path(value)
    # What cannot be looked up is an error where the file is needed, with the path that the user wrote.
    with suppress(OSError):
        if file.exists():
            return str(file.absolute())
    return value


def _is_name(key: str, value: str) -> bool:
    """Whether a value names weights that ship or a network, as stages read it even where a file is called so."""
    if key == "weights":
        return value.partition(":")[0] == "builtin"
    return key == "lpips" and value in LPIPS_NETWORKS
