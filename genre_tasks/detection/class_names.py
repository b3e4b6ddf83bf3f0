"""Names of a detector's classes: from a file that the user gives, from the network's file, or COCO's."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

from genre_tasks.detection.coco_classes import COCO_CLASSES
from genre_tasks.errors import InputError


def choose_class_names(
    class_count: int | None, metadata: dict[str, str], class_names_file: Path | None, file: Path
) -> tuple[str, ...]:
    """Chooses the names of a network's classes.

    Args:
        class_count: how many classes the network has; ``None`` where that is unknown.
        metadata: what the network's file says about itself, as texts.
        class_names_file: the user's list, a name a line; ``None`` for the list in the network's file, or COCO's.
        file: the network's file, for errors.

    Returns:
        The names, in the order of the classes' numbers.

    Raises:
        InputError: the list cannot be read, or has another length than ``class_count``.

    >>> choose_class_names(2, {"names": "{0: 'car', 1: 'tram'}"}, None, Path("x.onnx"))
    ('car', 'tram')
    """
    # Most published weights are trained on COCO, and few files say so.
    names: tuple[str, ...] = COCO_CLASSES
    source = "COCO's list of class names"
    stored = find_stored_names(metadata)
    # What the user gives counts more than what the file says of itself.
    if class_names_file is not None:
        names = read_class_names(class_names_file)
        source = f"the list {class_names_file}"
    elif stored is not None:
        names = stored
        source = "the file's list of class names"
    # A list that is too short would fail at some image, and a longer one would give wrong names without an error.
    if class_count is not None and len(names) != class_count:
        raise InputError(
            f"the detector has {class_count} classes, and {source} has {len(names)}",
            remedy="Give a text file with a name for each of the detector's classes, one a line.",
            file=file,
        )
    return names


def read_class_names(path: Path) -> tuple[str, ...]:
    """Reads a list of class names.

    Args:
        path: a text file with a name a line; empty lines are skipped.

    Raises:
        InputError: the file is missing, no text, or empty.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"the list of class names cannot be read: {error}", remedy="Give a text file, a name a line.", file=path
        ) from error
    # Editors leave an empty line at the end.
    names = tuple(line.strip() for line in lines if line.strip())
    if not names:
        raise InputError("the list of class names is empty", remedy="Give a text file, a name a line.", file=path)
    return names


def find_stored_names(metadata: dict[str, str]) -> tuple[str, ...] | None:
    """Finds the class names that a network's file holds.

    Args:
        metadata: texts by their keys: a mapping from numbers to names under ``names``, or such a mapping in a text
            that is JSON or a Python literal.

    Returns:
        The names in the order of their numbers; ``None`` where there are none.

    >>> find_stored_names({"metadata.json": '{"names": {"0": "car", "1": "tram"}}'})
    ('car', 'tram')
    """
    for key, text in metadata.items():
        # ONNX files hold the mapping itself, archives behind TFLite files a text with all facts.
        value = _parse_literal(text)
        found = value if key == "names" else value.get("names") if isinstance(value, dict) else None
        if isinstance(found, list | tuple) and found:
            return tuple(str(name) for name in found)
        # JSON has only texts for keys, so the numbers are compared as numbers: "10" comes after "9".
        if isinstance(found, dict) and found and all(str(number).isdigit() for number in found):
            return tuple(str(found[number]) for number in sorted(found, key=int))
    return None


def _parse_literal(text: str) -> Any:
    """The value of a text in JSON or Python's literals, which run no code; ``None`` for other texts."""
    try:
        return json.loads(text)
    except ValueError:
        pass
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return None
