"""``genre train``: the commands behind the shipped weights, in their order: pairs, fnet, gnet, enet.

Everything goes into one folder and is resumable: a command that was stopped goes on where it was.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="Train the networks (tens of minutes each on a CPU; resumable).", no_args_is_help=True)

Folder = Annotated[Path, typer.Option(help="Where pairs, scenes, checkpoints and curves are kept.")]
Seeds = Annotated[str, typer.Option(help="Training seeds of the synthetic street, first:last:step.")]
Real = Annotated[str | None, typer.Option(help="A real log whose chunk 0 is trained on too, e.g. pandaset:PATH/002.")]
Novel = Annotated[float, typer.Option(min=0, help="λ_novel; 0: recorded views alone, for gnet.method=g3r.")]


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


@app.command()
def gnet(folder: Folder = Path("training"), real: Real = None, novel: Novel = 0.1) -> None:
    """Train GNet on streets made on the spot; FNet is not needed."""
    from flows.cli.terminal import TerminalReporter
    from flows.train.recipes import train_gnet
    from genre_tasks.optimiser.weights import save
    from storage.local import LocalStore

    with TerminalReporter("training gnet") as reporter:
        network = train_gnet(LocalStore(folder / "store"), folder / "gnet", real, reporter.progress, novel)
    save(network, folder / "gnet.safetensors")
    typer.echo(
        f"weights in {folder / 'gnet.safetensors'}; use them with --set gnet.weights={folder / 'gnet.safetensors'}"
    )


@app.command()
def enet(folder: Folder = Path("training"), real: Real = None) -> None:
    """Train ENet from GNet's weights, on scenes that GNet made and with FNet's images of them."""
    from flows.cli.terminal import TerminalReporter
    from flows.train.recipes import train_enet
    from genre_tasks.errors import InputError
    from genre_tasks.optimiser.weights import save
    from storage.local import LocalStore

    start = folder / "gnet" / "fine" / "weights.safetensors"
    if not start.is_file():
        raise InputError("GNet is not trained yet", remedy="Run `genre train gnet` first.", file=start)
    with TerminalReporter("training enet") as reporter:
        network = train_enet(LocalStore(folder / "store"), folder / "enet", folder / "gnet", real, reporter.progress)
    save(network, folder / "enet.safetensors")
    typer.echo(
        f"weights in {folder / 'enet.safetensors'}; use them with --set enet.weights={folder / 'enet.safetensors'}"
    )
