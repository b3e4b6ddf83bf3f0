"""The help of every command: an example that parses, options that say what they do, and an answer at once."""

from __future__ import annotations

import re
import resource
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from flows.cli.main import app

ROOT = Path(__file__).resolve().parents[2]
UNRUN_COMMAND = re.compile(r"""^(?:docker compose exec \w+ |eval "\$\()?genre (.*?)(?:\)")?$""", flags=re.MULTILINE)


def all_commands() -> Iterator[tuple[str, Any]]:
    """(words, command) of every command that does something, such as ``train gnet``."""
    for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        if hasattr(command, "commands"):
            for part, subcommand in command.commands.items():
                yield f"{name} {part}", subcommand
        else:
            yield name, command


COMMANDS = dict(all_commands())


def examples(command: Any) -> list[str]:
    return [line.strip() for line in command.help.splitlines() if line.startswith("    genre ")]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_example_in_the_help_parses(name: str) -> None:
    found = examples(COMMANDS[name])
    assert found
    for example in found:
        _, *words = shlex.split(example)
        assert " ".join(words).startswith(name)
        COMMANDS[name].make_context(name, words[len(name.split()) :])


def unrun_examples() -> Iterator[Any]:
    """The commands of the documents' ``text`` blocks, which need files or machines that the tests do not have."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        for block in re.findall(r"```text\n(.*?)```", page.read_text(), flags=re.DOTALL):
            for line in UNRUN_COMMAND.findall(block):
                yield pytest.param(line, id=f"{page.stem}: {line}")


@pytest.mark.parametrize("line", list(unrun_examples()))
def test_every_command_of_the_documents_that_is_not_run_parses(line: str) -> None:
    words = shlex.split(line, comments=True)
    name = " ".join(words[:2]) if " ".join(words[:2]) in COMMANDS else words[0]
    context = COMMANDS[name].make_context(name, words[len(name.split()) :])
    assert context.info_name == name


def test_the_documents_have_commands_that_are_not_run() -> None:
    assert len(list(unrun_examples())) >= 14


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_is_in_sentences(name: str) -> None:
    command = COMMANDS[name]
    first = command.help.splitlines()[0]
    assert first[0].isupper() and first.endswith(".") and len(first) <= 67, first
    for parameter in command.params:
        text = getattr(parameter, "help", None)
        assert text and text.endswith("."), (name, parameter.name)


def test_the_version_is_that_of_the_package() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    done = CliRunner().invoke(app, ["--version"])
    assert done.exit_code == 0
    assert done.output == f"genre {version}\n", "after a change of the version, run `make setup`"


def test_the_help_answers_within_a_second() -> None:
    seconds = []
    for _ in range(3):
        start_s = cpu_seconds_of_children()
        done = subprocess.run(
            [sys.executable, "-m", "flows.cli.main", "--help"], cwd=ROOT, capture_output=True, check=True
        )
        seconds.append(cpu_seconds_of_children() - start_s)
        assert b"Usage: " in done.stdout
    # Not by the clock, as other tests take the cores meanwhile; the fastest of three, as they take the caches too.
    assert min(seconds) < 1.0


def cpu_seconds_of_children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def test_the_page_on_training_names_the_commands_that_take_an_option() -> None:
    page = (ROOT / "docs/guides/training.md").read_text()
    options = {
        name.removeprefix("train "): {word for parameter in command.params for word in parameter.opts}
        for name, command in COMMANDS.items()
        if name.startswith("train ")
    }
    rows = re.findall(r"^\| `(--[a-z-]+)[^`]*` \| (.*) \|$", page, flags=re.MULTILINE)
    assert {option for option, _ in rows} >= {"--streets", "--recipe"}
    for option, meaning in rows:
        # A row that names no command is of all of them.
        named = set(re.findall(r"`(\w+)`", meaning)).intersection(options)
        assert {name for name, words in options.items() if option in words} == (named or set(options)), option
