"""Edits of a run's traffic as people write them: in a YAML file, and in options of a command::

edits:
  - remove: car-12
  - insert: 7                  # an actor, by name, number or track id
    from_run: 4b1c             # of another run; without it: of the same one
    name: taxi
    ahead_m: 12
    turn_deg: 180
  - move: car-3
    forward_m: 2
    left_m: -1
  - retime: car-4
    delay_s: 0.5
  - rotate: car-5
    degrees: 90
  - scale_speed: taxi
    factor: 0.5
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from flows.configuration.keys import Place, describe_value
from flows.yaml_values import YamlError, parse_yaml, read_yaml_mapping
from genre_tasks.errors import ConfigError
from genre_tasks.scene_edits.edits import EDIT_KINDS, EditList
from genre_tasks.suggestions import did_you_mean

MAX_EDITS = 1000
"""More edits than that are no list that a person wrote."""

_REMEDY = "flows/simulation/edit_file.py shows such a file."
_MESSAGES = {
    "float_type": "it should be a number",
    "string_type": "it should be text",
    "finite_number": "it should be a finite number",
    "missing": "it is missing",
    "string_too_short": "it should not be empty",
}


@dataclass(frozen=True)
class _Shorthand:
    # How an option of the command line is written.
    kind: str
    keys: Mapping[str, str]
    bare_key: str | None
    example: str

    @property
    def option(self) -> str:
        return "--" + self.kind.replace("_", "-")


_INSERT_KEYS = {
    "ahead": "ahead_m",
    "left": "left_m",
    "turn": "turn_deg",
    "speed": "speed_m_s",
    "start": "start_s",
}
_SHORTHANDS = {
    "remove": _Shorthand("remove", {}, None, "--remove car-12"),
    "insert": _Shorthand("insert", _INSERT_KEYS, None, "--insert taxi@RUN:7,ahead=12,left=-3,turn=180,speed=5"),
    "move": _Shorthand(
        "move", {"forward": "forward_m", "left": "left_m", "up": "up_m"}, None, "--move car-3,forward=2,left=-1"
    ),
    "retime": _Shorthand("retime", {"delay": "delay_s"}, "delay_s", "--retime car-3,delay=0.5"),
    "rotate": _Shorthand("rotate", {"degrees": "degrees"}, "degrees", "--rotate car-3,degrees=90"),
    "scale_speed": _Shorthand("scale_speed", {"factor": "factor"}, "factor", "--scale-speed car-3,0.5"),
}


def read_edit_file(path: Path) -> EditList:
    """Reads a list of edits from a YAML file.

    Args:
        path: the file, see the top of this module.

    Returns:
        The edits in the order of the file.

    Raises:
        ConfigError: the file is not there, is no such YAML, or has an edit or a key that is not allowed. The error
            names the file, the line and the number of the edit.
    """
    content = read_yaml_mapping(path, "file of edits", "a list `edits`", _REMEDY)
    for key in content.values:
        if key != "edits":
            remedy = f"{did_you_mean(key, ['edits'])}The only key is `edits`, a list."
            raise Place(str(path), content.lines[(key,)]).error(f"a file of edits has no {describe_value(key)}", remedy)
    entries = content.values.get("edits", [])
    if not isinstance(entries, list) or len(entries) > MAX_EDITS:
        line = content.lines[("edits",)]
        raise Place(str(path), line).error(f"`edits` is no list of up to {MAX_EDITS} edits", _REMEDY)
    edits = []
    for index, entry in enumerate(entries):
        lines = {key[2]: line for key, line in content.lines.items() if key[:2] == ("edits", str(index)) and key[2:]}
        texts = {key[2]: text for key, text in content.texts.items() if key[:2] == ("edits", str(index)) and key[2:]}
        edits.append(_make_edit(entry, _EntryPlace(str(path), index + 1, lines), texts))
    return EditList(edits=tuple(edits))


def parse_edit_options(
    remove: Sequence[str] = (),
    insert: Sequence[str] = (),
    move: Sequence[str] = (),
    retime: Sequence[str] = (),
    rotate: Sequence[str] = (),
    scale_speed: Sequence[str] = (),
) -> EditList:
    """Reads edits from the options of a command.

    Args:
        remove: actors, such as ``car-12``.
        insert: ``[NAME@][RUN:]ACTOR`` with ``ahead``, ``left``, ``turn``, ``speed`` and ``start``.
        move: an actor with ``forward``, ``left`` and ``up``.
        retime: an actor with ``delay``.
        rotate: an actor with ``degrees``.
        scale_speed: an actor with ``factor``.

    Returns:
        The edits; those of one option in the order in which they were written.

    Raises:
        ConfigError: an option cannot be read, or a key or a value of it is not allowed.

    >>> parse_edit_options(remove=["12"], move=["car-3,left=-1"]).edits[1].left_m
    -1.0
    """
    options = {
        "remove": remove,
        "insert": insert,
        "move": move,
        "retime": retime,
        "rotate": rotate,
        "scale_speed": scale_speed,
    }
    edits = [_parse_option(_SHORTHANDS[kind], text) for kind, texts in options.items() for text in texts]
    return EditList(edits=tuple(edits))


@dataclass(frozen=True)
class _EntryPlace:
    # Where an edit stands: an entry of a file, or an option.
    source: str
    number: int | None
    lines: Mapping[str, int]

    def error(self, problem: str, remedy: str, key: str | None = None) -> ConfigError:
        if self.number is None:
            return ConfigError(f"{self.source}: {problem}", remedy=remedy)
        line = self.lines.get(key or "", min(self.lines.values(), default=None))
        return Place(self.source, line).error(f"edit {self.number}: {problem}", remedy)


def _make_edit(entry: object, place: _EntryPlace, texts: Mapping[str, str]) -> Any:
    """``texts``: what was written where a value is a number, by key."""
    known = ", ".join(EDIT_KINDS)
    if not isinstance(entry, dict):
        raise place.error(f"expected an edit such as `remove: car-3`, got {describe_value(entry)}", f"Known: {known}.")
    kinds = [key for key in entry if key in EDIT_KINDS]
    if len(kinds) != 1:
        suggestion = next((s for s in (did_you_mean(key, EDIT_KINDS) for key in entry) if s), "") if not kinds else ""
        problem = "it says not what to do" if not kinds else f"it says {' and '.join(kinds)}, which are two edits"
        raise place.error(problem, f"{suggestion}One of {known}, with the actor as its value.")
    kind = kinds[0]
    values = {key: value for key, value in entry.items() if key != kind}
    # Numbers are names here, as they were written: 0012 may be a track of the log, and 77e2 a run.
    values["actor"] = texts.get(kind, entry[kind])
    values |= {key: texts[key] for key in ("from_run", "name") if key in texts}
    return _validate(kind, values, place)


def _validate(kind: str, values: Mapping[str, Any], place: _EntryPlace) -> Any:
    model = EDIT_KINDS[kind]
    allowed = [key for key in model.model_fields if key not in ("kind", "actor")]
    for key in values:
        if key not in allowed and key != "actor":
            remedy = f"{did_you_mean(key, allowed)}Known: {', '.join(allowed) or 'the actor alone'}."
            raise place.error(f"{kind} has no {describe_value(key)}", remedy, key)
    try:
        return model.model_validate(values)
    except ValidationError as error:
        # One at a time: further problems are often consequences of the first.
        first = error.errors()[0]
        key = str(first["loc"][0])
        message = first["msg"].removeprefix("Value error, ").replace("Input should", "it should")
        reason = _MESSAGES.get(first["type"], message)
        got = "" if first["type"] == "missing" else f" (got {describe_value(first['input'])})"
        shown = kind if key == "actor" else key
        raise place.error(f"the value of {shown} is not allowed: {reason}{got}", "Write another value.", key) from error


def _parse_option(shorthand: _Shorthand, text: str) -> Any:
    place = _EntryPlace(f"{shorthand.option} {text}", None, {})
    example = f"Write {shorthand.example}."
    actor, *parts = [part.strip() for part in text.split(",")]
    values: dict[str, Any] = {"actor": actor}
    if shorthand.kind == "insert":
        values = _parse_inserted_actor(actor)
    if not values["actor"]:
        raise place.error("the actor is missing", example)
    for part in parts:
        key, equals, number = part.partition("=")
        if not equals and shorthand.bare_key is not None:
            key, number = "", part
        name = shorthand.bare_key if not key else shorthand.keys.get(key.strip())
        if name is None or (not equals and key):
            suggestion = did_you_mean(key, shorthand.keys)
            known = f"Known: {', '.join(shorthand.keys) or 'the actor alone'}. "
            raise place.error(f"cannot read {part!r}", f"{suggestion}{known}{example}")
        if name in values:
            raise place.error(f"{key or name} is there twice", example)
        values[name] = _parse_value(number.strip(), part, place, example)
    return _validate(shorthand.kind, values, place)


def _parse_inserted_actor(text: str) -> dict[str, Any]:
    name, at, rest = text.rpartition("@")
    run, _, actor = rest.rpartition(":")
    values: dict[str, Any] = {"actor": actor.strip()}
    if at:
        values["name"] = name.strip()
    if run:
        values["from_run"] = run.strip()
    return values


def _parse_value(number: str, part: str, place: _EntryPlace, example: str) -> float:
    try:
        value = parse_yaml(number)
    except YamlError:
        value = None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise place.error(f"{part!r} has no number", example)
    return value
