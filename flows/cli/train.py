"""``genre train``: the training commands behind the shipped weights."""

from __future__ import annotations

import typer

app = typer.Typer(help="Train the networks (hours on a CPU; resumable).", no_args_is_help=True)
