"""Single settings, ``section.key=value``: what the text of a value means depends on what its key takes."""

from __future__ import annotations

from typing import Any, get_args, get_origin

from flows.configuration.keys import describe_value, find_annotation, list_kinds, section_type, takes_list, takes_text
from flows.yaml_values import NULLS, KeyPath, YamlError, parse_yaml
from genre_tasks.errors import ConfigError

_HOW = "Write --set section.key=value."


def parse_setting(setting: object) -> tuple[KeyPath, Any]:
    """Reads a setting.

    A key that takes words takes the text as it is, so that a path may have any characters; quotes around it are left
    out. Other values are YAML, and a text that is none stays text, which their key then refuses.

    Args:
        setting: ``section.key=value``.

    Returns:
        The keys that lead to the value, and the value.

    Raises:
        ConfigError: it is no such text, or a list or section is not written as one.

    >>> parse_setting("evaluate.shifts_m=[1, 2.5]")
    (('evaluate', 'shifts_m'), [1, 2.5])
    >>> parse_setting("ingest.points=C: #1 & 2.ply")
    (('ingest', 'points'), 'C: #1 & 2.ply')
    """
    # Settings also come from a flow's parameters, where JSON may hold anything.
    if not isinstance(setting, str):
        raise ConfigError(f"a setting is no text: {describe_value(setting)}", remedy=_HOW)
    key, equals, text = setting.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"cannot read --set {describe_value(setting)}", remedy=_HOW)
    path = tuple(part.strip() for part in key.split("."))
    return path, _parse_value(path, text.strip())


def keys_overlap(key: str, other: str) -> bool:
    """Says whether one of two keys of the configuration is the other, or a section that holds it.

    Args:
        key: such as ``enet.learning_rates.means``.
        other: the same, or ``enet.learning_rates``.

    >>> keys_overlap("enet.loss.rgb", "enet.loss"), keys_overlap("enet.los", "enet.loss")
    (True, False)
    """
    return f"{key}.".startswith(f"{other}.") or f"{other}.".startswith(f"{key}.")


def _parse_value(path: KeyPath, text: str) -> Any:
    annotation = find_annotation(path)
    if annotation is not None and takes_text(annotation):
        return _parse_text(annotation, text)
    try:
        return parse_yaml(text)
    except YamlError as error:
        expected = None if annotation is None else _expected_form(annotation)
        if expected is None:
            return text
        kind, form = expected
        full_key = ".".join(path)
        raise ConfigError(
            f"the value of {full_key} is {kind}, and {describe_value(text)} is none ({error.problem})",
            remedy=f"Write --set '{full_key}={form}'.",
        ) from error


def _parse_text(annotation: Any, text: str) -> str | None:
    if type(None) in list_kinds(annotation) and text in NULLS:
        return None
    if text.startswith(("'", '"')):
        try:
            unquoted = parse_yaml(text)
        except YamlError:
            return text
        # Quotes may also end before the text does.
        return unquoted if isinstance(unquoted, str) else text
    return text


def _expected_form(annotation: Any) -> tuple[str, str] | None:
    """What a key takes that is no single word or number, and how that is written."""
    if takes_list(annotation):
        return "a list", example_list(annotation)
    section, _ = section_type(annotation)
    if section is not None:
        return "a section", f"{{{next(iter(section.model_fields))}: …}}"
    return None


def example_list(annotation: Any) -> str:
    """Shows how the list of a key is written.

    Args:
        annotation: of a field that takes a list.

    >>> example_list(tuple[float, ...])
    '[1.0, 2.0]'
    """
    kind = next(kind for kind in list_kinds(annotation) if get_origin(kind) is tuple)
    return "[front_camera, back_camera]" if takes_text(get_args(kind)[0]) else "[1.0, 2.0]"
