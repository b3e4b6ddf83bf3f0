"""``genre train``: the commands behind the shipped weights, in their order: pairs, fnet, enet, gnet.

Everything goes into one folder and is resumable: a command that was stopped goes on where it was.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="Train the networks (an hour each on a CPU; resumable).", no_args_is_help=True)

Folder = Annotated[Path, typer.Option(help="Where pairs, scenes, checkpoints and curves are kept.")]
Seeds = Annotated[str, typer.Option(help="Training seeds of the synthetic street, first:last:step.")]
Real = Annotated[str | None, typer.Option(help="A real log whose chunk 0 is trained on too, e.g. pandaset:PATH/002.")]


def _seeds(text: str) -> list[int]:
    try:
        first, last, step = (int(part) for part in text.split(":"))
    except ValueError:
        from genre_tasks.errors import ConfigError

        raise ConfigError(f"cannot read --seeds {text!r}", remedy="Write first:last:step, e.g. 0:899:30.") from None
    return list(range(first, last + 1, step))


@app.command()
def pairs(folder: Folder = Path("training"), seeds: Seeds = "0:899:30", real: Real = None) -> None:
    """Make FNet's training pairs: degraded render and truth, with reference image and LiDAR map."""
    from flows.cli.terminal import TerminalReporter
    from flows.train.fixer import make_pairs

    with TerminalReporter("training pairs") as reporter:
        made = make_pairs(folder / "pairs", _seeds(seeds), real=real, progress=reporter.progress)
    typer.echo(f"{len(made)} files of pairs in {folder / 'pairs'}")


@app.command()
def fnet(folder: Folder = Path("training")) -> None:
    """Train FNet on the pairs."""
    from flows.cli.terminal import TerminalReporter
    from flows.train.fixer import train_fnet
    from genre_tasks.errors import InputError

    files = sorted((folder / "pairs").glob("*.npz"))
    if not files:
        raise InputError("there are no training pairs", remedy="Run `genre train pairs` first.", file=folder / "pairs")
    with TerminalReporter("training fnet") as reporter:
        weights = train_fnet(files, folder / "fnet", progress=reporter.progress)
    typer.echo(f"weights in {weights}; use them with --set fnet.weights={weights}")
