"""Methods of the user's own, from YAML files::

name: GNet, 24 iterations
settings: [gnet.iterations=24]
end: gnet                        # or enet (the default), or fnet: a fixer, for table 3
note: what the reader should know
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from flows.configuration.keys import Place, describe_value
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.paper_tables.methods import End, Method
from flows.yaml_values import read_yaml_mapping
from genre_tasks.errors import ConfigError
from genre_tasks.suggestions import did_you_mean

_KEYS = ("name", "settings", "end", "note")


def read_method(file: Path, preset: str, settings: Sequence[str] = ()) -> Method:
    """Reads a method of the user's own.

    Args:
        file: a YAML file, see the top of this module.
        preset: the method's settings are checked on this preset.
        settings: ``section.key=value`` over the preset.

    Returns:
        The method.

    Raises:
        ConfigError: the file is not there or no such YAML, a key or setting is not allowed, or a built-in method
            has this name. The error names the file.
    """
    remedy = "Check --method; flows/paper_tables/user_methods.py shows such a file."
    content = read_yaml_mapping(file, "method's file", "name, settings, end", remedy)
    values = content.values
    for key in values:
        # An unknown key is most likely a typo, and ignoring it would measure another method.
        if key not in _KEYS:
            remedy = f"{did_you_mean(key, _KEYS)}Known: {', '.join(_KEYS)}."
            raise Place(str(file), content.lines[(key,)]).error(f"a method has no {describe_value(key)}", remedy)
    name = values.get("name")
    own_settings = values.get("settings", [])
    end = values.get("end", "enet")
    # A bar would split the cell of the Markdown table.
    if not isinstance(name, str) or not name.strip() or "|" in name:
        raise ConfigError("the method has no name", remedy="Write `name: …`, a line without |.", file=file)
    # Cells find their row by the name, so a second one would take over the first one's numbers.
    if name in {m.name for m in BUILT_IN.values()}:
        raise ConfigError(f"a built-in method is called {name!r}", remedy="Give yours another name.", file=file)
    if not isinstance(own_settings, list) or not all(isinstance(s, str) for s in own_settings):
        raise ConfigError("settings is no list of strings", remedy="Write `settings: [gnet.iterations=24]`.", file=file)
    if end not in get_args(End):
        raise ConfigError(f"no scene or image ends at {end!r}", remedy="Write `end: gnet`, enet or fnet.", file=file)
    method = Method(name.strip(), tuple(own_settings), end, str(values.get("note", "")))
    try:
        # Built once for its errors alone: a typo should show now and not after the other methods.
        method.configuration(preset, settings)
    except ConfigError as error:
        raise ConfigError(error.problem, remedy=error.remedy, file=file) from error
    return method
