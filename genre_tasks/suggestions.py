"""Suggestions for words that a user mistyped."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[str], prefix: str = "") -> str:
    """Suggests the known word that is nearest to a mistyped one, for the remedy of an error.

    Args:
        word: what the user wrote.
        known: the words that are allowed.
        prefix: written before the suggestion, such as the configuration section that the word belongs to.

    Returns:
        A sentence that ends with a space, or an empty string where no known word is near.

    >>> did_you_mean("gnett", ["gnet", "enet"])
    "Did you mean 'gnet'? "
    >>> did_you_mean("xyz", ["gnet", "enet"])
    ''
    """
    # Lower than difflib's own 0.6: most words here are short, where one wrong letter counts much.
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)
    # With a space at the end, so that a remedy can go on after it.
    return f"Did you mean '{prefix}{near[0]}'? " if near else ""
