"""``genre train``: the commands behind the shipped weights: pairs, fnet; scenes, gnet, enet.

Everything goes into one folder and is resumable: a command that was stopped goes on where it was.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(help="Train the networks (tens of minutes each on a CPU; resumable).", no_args_is_help=True)

Folder = Annotated[Path, typer.Option(help="Where pairs, scenes, checkpoints and curves are kept.")]
Streets = Annotated[int, typer.Option(min=0, help="How many synthetic streets.")]
Real = Annotated[str | None, typer.Option(help="A real log whose chunk 0 is trained on too, e.g. pandaset:PATH/002.")]
Recipe = Annotated[
    str,
    typer.Option(
        help="shipped; paper: ENet on 3DGS scenes, GNet from it, ENet on GNet's; effects: GNet on logs with some."
    ),
]
Novel = Annotated[
    float | None, typer.Option(min=0, help="λ_novel, 0.1 if not given; 0: recorded views alone, for gnet.method=g3r.")
]
Fixer = Annotated[str, typer.Option(help="FNet's weights: builtin, or a path.")]
Device = Annotated[str, typer.Option(help="auto (a GPU where there is one), cpu or cuda.")]
SaveEvery = Annotated[int, typer.Option(min=1, help="Weight updates between checkpoints.")]
ValidateEvery = Annotated[
    int, typer.Option(min=0, help="Weight updates between validations against tuned Adam (seeds 900–902); 0: none.")
]
OneStage = Annotated[str | None, typer.Option(help="This stage alone, e.g. gnet/fine; without it all, in their order.")]


@app.command()
def pairs(folder: Folder = Path("training"), real: Real = None, streets: Streets = 28) -> None:
    """Make FNet's training pairs: degraded render and truth, with reference images and LiDAR map."""
    with _reported("training pairs"):
        from flows.training.fixer_flow import train_pairs

        made = train_pairs(str(folder), real, streets)
    typer.echo(f"{made['pairs']} pairs of {made['scenes']} scenes in {folder / 'store'}")
    for kind, share in made["shares"].items():
        typer.echo(f"  {kind:>13} {100 * share:5.1f} %")


@app.command()
def fnet(
    folder: Folder = Path("training"),
    real: Real = None,
    streets: Streets = 28,
    inputs: Annotated[str, typer.Option(help="What it is given, joined by +.")] = "render+reference+lidar",
    preset: Annotated[str, typer.Option(help="small; further and last, each from the one before; paper.")] = "small",
    start: Annotated[str | None, typer.Option(help="Weights to train further; SD-Turbo's for paper.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Weight updates; the preset's if not given.")] = None,
    validate: Annotated[bool, typer.Option(help="Scores and a picture of seeds 900–902 at each checkpoint.")] = False,
) -> None:
    """Train FNet on the pairs; those that are not there yet are made."""
    with _reported("training fnet"):
        from flows.training.fixer_flow import train_fnet

        weights = train_fnet(str(folder), real, streets, inputs, preset, start, steps, validate)["weights"]
    typer.echo(f"weights in {weights}; use them with --set fnet.weights={weights}")


@app.command()
def scenes(
    folder: Folder = Path("training"), recipe: Recipe = "shipped", real: Real = None, fnet: Fixer = "builtin"
) -> None:
    """Make the scenes that GNet and ENet train on: chunks, true views, per-scene 3DGS, FNet's images of it."""
    with _reported("training scenes"):
        from flows.training.optimiser_flow import train_scenes

        made = train_scenes(str(folder), recipe, real, fnet)
    typer.echo(f"{made['scenes']} scenes in {folder / 'store'}, {made['made']} artifacts of them made now")


@app.command()
def gnet(
    folder: Folder = Path("training"),
    recipe: Recipe = "shipped",
    real: Real = None,
    novel: Novel = None,
    fnet: Fixer = "builtin",
    device: Device = "auto",
    save_every: SaveEvery = 50,
    validate_every: ValidateEvery = 0,
    stage: OneStage = None,
) -> None:
    """Train GNet, in the stages of the recipe; scenes that are not there yet are made."""
    _train("gnet", folder, recipe, real, novel, fnet, device, save_every, validate_every, stage)


@app.command()
def enet(
    folder: Folder = Path("training"),
    recipe: Recipe = "shipped",
    real: Real = None,
    fnet: Fixer = "builtin",
    device: Device = "auto",
    save_every: SaveEvery = 50,
    validate_every: ValidateEvery = 0,
    stage: OneStage = None,
) -> None:
    """Train ENet, in the stages of the recipe, after those of GNet that they need."""
    _train("enet", folder, recipe, real, None, fnet, device, save_every, validate_every, stage)


def _train(network: str, folder: Path, *values: Any) -> None:
    with _reported(f"training {network}"):
        from flows.training.optimiser_flow import train_network

        result = train_network(network, str(folder), *values)
    typer.echo(f"weights in {result['weights']}; use them with --set {network}.weights={result['weights']}")
    rates = {
        "gnet": "gnet.learning_rates=null and, with small, --set gnet.refine.lr_before_refine=null",
        "enet": "enet.learning_rates=null",
    }
    typer.echo(f"A preset's rates are for the built-in weights: add --set {rates[network]}")


@contextmanager
def _reported(what: str) -> Iterator[None]:
    """The flow's progress on the terminal, and a home for Prefect."""
    from flows.cli.terminal import reporting

    with reporting(what):
        yield
