"""Classes of objects by the words of their labels: every log has names of its own."""

from __future__ import annotations

import re
from collections.abc import Sequence

ClassWords = Sequence[tuple[str, frozenset[str]]]
"""Class names with the words of labels that mean them; the first class that shares a word with a label is it."""


def find_class(label: str, classes: ClassWords, otherwise: str) -> str:
    """Finds the class of a label.

    Args:
        label: in a log's words, such as ``Medium-sized Truck``, ``vehicle.car`` or ``TYPE_PEDESTRIAN``.
        classes: in order of precedence.
        otherwise: the class of all other labels.

    Returns:
        The name of the class.

    >>> find_class("human.pedestrian.adult", [("Person", frozenset({"pedestrian"}))], "Other")
    'Person'
    """
    # Words in any spelling: with_underscores, with-dashes, inCamelCase.
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", label)
    words = set(re.findall(r"[a-z]+", spaced.lower()))
    # A plural names the same class.
    words |= {word.removesuffix("s") for word in words}
    return next((name for name, known in classes if words & known), otherwise)
