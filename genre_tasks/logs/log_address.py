"""Addresses of logs with options, as in ``kitti:PATH?labels=FILE``."""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import parse_qsl, unquote

from genre_tasks.errors import ConfigError
from genre_tasks.suggestions import did_you_mean


def split_log_address(rest: str, known: Sequence[str], layout: str) -> tuple[str, dict[str, str]]:
    """Splits what follows a reader's name.

    Args:
        rest: ``PATH?option=value&…``; special characters are written with %, as in URLs.
        known: names of options.
        layout: whose logs they are, for the error.

    Returns:
        The path, and the options that have a value.

    Raises:
        ConfigError: an option is unknown.

    >>> split_log_address("data/a%3Fb?labels=x+1.txt", ("labels",), "KITTI")
    ('data/a?b', {'labels': 'x+1.txt'})
    """
    path, _, query = rest.partition("?")
    # A plus is a plus here, as in the path, and no space as in the forms of web pages.
    options = dict(parse_qsl(query.replace("+", "%2B"), keep_blank_values=True))
    for name in options:
        if name not in known:
            hint = did_you_mean(name, known) or f"Known: {', '.join(known)}."
            raise ConfigError(f"logs of {layout} have no option '{name}'", remedy=hint)
    # An option without a value is as if it were not there.
    return unquote(path), {name: value for name, value in options.items() if value}
