"""References of the documents, from the code: commands, configuration, presets."""

from __future__ import annotations

import inspect
import json
from typing import Any, get_args

from docs.result_tables import table


def presets() -> str:
    """What the presets differ in, and what they are for."""
    from flows.configuration import PRESETS, load_configuration

    purpose = {
        "demo": "a first look: the synthetic street, minutes",
        "small": "quick runs, parameter studies",
        "fine": "the default: real logs on a CPU",
        "long": "a longer GNet at the size of `small`",
        "hd": "the paper's image size on a CPU: minutes and 6 GB a chunk",
        "paper": "the paper's settings with SD-Turbo; too slow for a CPU, never run whole",
    }
    lines = []
    for name in PRESETS:
        config = load_configuration(name)
        size = f"{config.ingest.width_px}×{config.ingest.height_px}"
        gaussians = f"{config.initial.max_points + config.initial.distant_count:,}"
        lines.append(
            [f"`{name}`", purpose[name], size, gaussians, str(config.gnet.iterations), str(config.enet.iterations)]
        )
    head = [
        "preset",
        "use it for",
        "image size",
        "Gaussians at the start, at most",
        "GNet iterations",
        "ENet iterations",
    ]
    return table(head, lines)


def configuration_reference() -> str:
    """docs/reference/configuration.md: every key, its type, default, bounds and meaning."""
    from genre_tasks.config import PipelineConfig, RangeConfig

    parts = [
        "# Configuration\n\nThis page is generated from `genre_tasks/config/`. Set a key with "
        "`--set section.key=value`, or in a YAML file given by `--config`. A preset is such a file; "
        "`genre show config --preset NAME` prints its values.\n\n"
        "A default holds where the preset sets nothing. `genre run` takes the preset `fine` where you name none.\n"
    ]
    for name, field in PipelineConfig.model_fields.items():
        parts.append(_section(name, field.annotation, field.default))
    parts.append(_section("range (options of `genre range`, and fixed values)", RangeConfig, RangeConfig()))
    return "\n".join(parts)


def _section(name: str, model: Any, default: Any) -> str:
    about = (model.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")
    lines = []
    nested = []
    for key, field in model.model_fields.items():
        value = getattr(default, key) if default is not None else field.default
        kinds = [k for k in (field.annotation, *get_args(field.annotation)) if hasattr(k, "model_fields")]
        if kinds:
            nested.append((f"{name}.{key}", kinds[0], value))
            shown = "null" if value is None else "a section, below"
        else:
            shown = "required" if field.is_required() and default is None else f"`{_plain(value)}`"
        lines.append([f"`{key}`", shown, _bounds(field), field.description or ""])
    text = f"## {name}\n\n{about}\n\n" + table(["key", "default", "allowed", "meaning"], lines)
    return "\n".join([text, *(_section(*n) for n in nested)])


def _plain(value: Any) -> str:
    return "null" if value is None or repr(value) == "PydanticUndefined" else json.dumps(value, ensure_ascii=False)


def _bounds(field: Any) -> str:
    words = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    found = [f"{words[k]} {getattr(m, k):g}" for m in field.metadata for k in words if getattr(m, k, None) is not None]
    choices = [str(a) for a in get_args(field.annotation) if isinstance(a, str)]
    return ", ".join(found) or ", ".join(f"`{c}`" for c in choices)


def cli_reference() -> str:
    """docs/reference/cli.md: every command with its arguments and options."""
    import typer

    from flows.cli.main import app

    parts = [
        "# Commands\n\nThis page is generated from the commands' own help. `genre --version` prints the version.\n"
        "Every command takes `--debug`, which shows the traceback of an error.\n"
    ]
    root = typer.main.get_command(app)
    parts += [_command(f"genre {name}", command) for name, command in root.commands.items()]  # type: ignore[attr-defined]
    return "\n".join(parts)


def _command(path: str, command: Any) -> str:
    text = f"## {path}\n\n{_paragraphs(command.help or '')}\n"
    if hasattr(command, "commands"):
        return "\n".join([text, *(_command(f"{path} {name}", c) for name, c in command.commands.items())])
    rows = []
    for parameter in command.params:
        if parameter.name == "help" or getattr(parameter, "hidden", False):
            continue
        names = f"`{parameter.name.upper()}`" if parameter.param_type_name == "argument" else _option(parameter)
        default = parameter.default
        # 0 is a default like any other, and equals False.
        is_shown = default not in (None, (), [], "") and default is not False
        shown = "required" if parameter.required else f"`{default}`" if is_shown else ""
        rows.append([names, shown, " ".join((getattr(parameter, "help", "") or "").split()).replace("|", "\\|")])
    return text + "\n" + (table(["argument or option", "default", "meaning"], rows) if rows else "")


def _option(parameter: Any) -> str:
    return ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))


def _paragraphs(text: str) -> str:
    return inspect.cleandoc(text).replace("\b\n", "")
