"""``genre train``: the commands behind the shipped weights: pairs, fnet; scenes, gnet, enet."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.parsing import parse_path

app = typer.Typer(
    help="""Train the networks (tens of minutes each on a CPU).

    Everything is kept in one folder. A command that was stopped goes on where it was when it is started again.

    Example:

    \b
        genre train fnet --folder training
        genre train gnet --folder training
    """,
    no_args_is_help=True,
)


def _parse_folder(text: str | Path) -> Path:
    from flows.cli.output_paths import check_output_folder

    # Checked here for all commands: a training that cannot write its first checkpoint has lost minutes.
    folder = parse_path(text)
    check_output_folder(folder, "--folder")
    return folder


FolderOption = Annotated[
    Path,
    typer.Option(
        parser=_parse_folder, metavar="PATH", help="The folder for pairs, scenes, checkpoints, curves and weights."
    ),
]
StreetsOption = Annotated[int, typer.Option(min=0, help="How many synthetic streets to train on.")]
RealLogOption = Annotated[
    str | None,
    typer.Option(help="A recorded log whose first chunk is trained on too, such as pandaset:data/002."),
]
RecipeOption = Annotated[
    str,
    typer.Option(
        help="The list of training stages: shipped, for the built-in weights; paper, for ENet on 3DGS scenes, then "
        "GNet from it, then ENet on GNet's scenes; or effects, for GNet on logs with effects."
    ),
]
NovelWeightOption = Annotated[
    float | None,
    typer.Option(
        min=0,
        help="The weight of the loss on novel views, 0.1 if not given. With 0 only recorded views count, for "
        "gnet.method=g3r.",
    ),
]
FixerOption = Annotated[str, typer.Option(help="FNet's weights: builtin, or a path.")]
DeviceOption = Annotated[str, typer.Option(help="auto (a GPU if there is one), cpu or cuda.")]
SaveEveryOption = Annotated[int, typer.Option(min=1, help="Weight updates between two checkpoints.")]
# Streets 900 to 902 are validation seeds of configs/seeds.yaml, which no training sees.
ValidateEveryOption = Annotated[
    int,
    typer.Option(
        min=0, help="Weight updates between two comparisons with tuned Adam on streets 900 to 902. 0 for none."
    ),
]
StageOption = Annotated[
    str | None, typer.Option(help="Train one stage of the recipe alone, such as gnet/fine. All stages if not given.")
]

# To be printed after a training; whoever tries new weights with old rates would judge them wrongly.
_RESET_LEARNING_RATES = {
    "gnet": "gnet.refine.lr_before_refine=null",
    "enet": "enet.learning_rates=null",
}
"""What to set with trained weights: the learning rates of the presets were swept for the built-in ones."""


@app.command()
def pairs(folder: FolderOption = Path("training"), real: RealLogOption = None, streets: StreetsOption = 28) -> None:
    """Make the image pairs that FNet trains on.

    A pair is a degraded render and the true image of the same view, with reference images and a map of LiDAR points.
    The pairs are kept in FOLDER/store.

    Example:

    \b
        genre train pairs --folder training --streets 28
    """
    from flows.cli.terminal import report_on_terminal
    from flows.training.fixer_job import FixerJob
    from flows.training.requirements import check_fixer_training

    # Here and below: what is missing shows before Prefect is imported, which takes seconds.
    check_fixer_training(FixerJob(str(folder), real, streets), is_training=False)
    with report_on_terminal("training pairs"):
        # Imported inside the block, here and below: Prefect takes seconds to import, and the live line is there
        # meanwhile.
        from flows.training.fixer_flow import train_pairs

        made = train_pairs(str(folder), real, streets)
    typer.echo(f"wrote {made['pairs']} pairs of {made['scenes']} scenes to {folder / 'store'}")
    for kind, fraction in made["shares"].items():
        typer.echo(f"  {kind:>13} {100 * fraction:5.1f} %")


@app.command()
def fnet(
    folder: FolderOption = Path("training"),
    real: RealLogOption = None,
    streets: StreetsOption = 28,
    inputs: Annotated[
        str, typer.Option(help="What FNet is given, joined by +: render, reference and lidar.")
    ] = "render+reference+lidar",
    preset: Annotated[
        str,
        typer.Option(
            help="The recipe: small; further and then last, each of which goes on from the one before; or paper."
        ),
    ] = "small",
    start: Annotated[str | None, typer.Option(help="Weights to go on from. For paper, those of SD-Turbo.")] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Number of weight updates. The recipe's if not given.")
    ] = None,
    validate: Annotated[
        bool, typer.Option(help="Score streets 900 to 902 and draw a picture at each checkpoint.")
    ] = False,
) -> None:
    """Train FNet, the fixer, on image pairs.

    Pairs that are not there yet are made first, as by `genre train pairs`.

    Example:

    \b
        genre train fnet --folder training --preset small
    """
    from flows.cli.terminal import report_on_terminal
    from flows.training.fixer_job import FixerJob
    from flows.training.requirements import check_fixer_training

    check_fixer_training(FixerJob(str(folder), real, streets, inputs, preset, start, steps, validate))
    with report_on_terminal("training fnet"):
        from flows.training.fixer_flow import train_fnet

        weights = train_fnet(str(folder), real, streets, inputs, preset, start, steps, validate)["weights"]
    typer.echo(f"wrote {weights}; use these weights with --set fnet.weights={weights}")


@app.command()
def scenes(
    folder: FolderOption = Path("training"),
    recipe: RecipeOption = "shipped",
    real: RealLogOption = None,
    fnet: FixerOption = "builtin",
) -> None:
    """Make the scenes that GNet and ENet train on.

    A scene has chunks, true views, and FNet's images of reconstructions by Adam (recipe shipped) or 3DGS (paper).
    Scenes that GNet's reconstruction starts are made once it is trained. All are kept in FOLDER/store.

    Example:

    \b
        genre train scenes --folder training
    """
    from flows.cli.terminal import report_on_terminal
    from flows.training.requirements import check_optimiser_training
    from flows.training.train_job import TrainJob

    check_optimiser_training(TrainJob(str(folder), recipe, real, fnet=fnet))
    with report_on_terminal("training scenes"):
        from flows.training.optimiser_flow import train_scenes

        made = train_scenes(str(folder), recipe, real, fnet)
    typer.echo(f"wrote {made['made']} new artifacts of {made['scenes']} scenes to {folder / 'store'}")


@app.command()
def gnet(
    folder: FolderOption = Path("training"),
    recipe: RecipeOption = "shipped",
    real: RealLogOption = None,
    novel: NovelWeightOption = None,
    fnet: FixerOption = "builtin",
    device: DeviceOption = "auto",
    save_every: SaveEveryOption = 50,
    validate_every: ValidateEveryOption = 0,
    stage: StageOption = None,
) -> None:
    """Train GNet, the optimiser that reconstructs a scene.

    The stages of the recipe are trained in order. Scenes that are not there yet are made first, as by `genre train
    scenes`.

    Example:

    \b
        genre train gnet --folder training --validate-every 200
    """
    from flows.cli.parsing import check_number
    from flows.cli.terminal import report_on_terminal
    from flows.training.requirements import check_optimiser_training
    from flows.training.train_job import TrainJob

    if novel is not None:
        check_number(novel, "--novel", 0, 1e6)
    job = TrainJob(str(folder), recipe, real, novel, fnet, device, save_every, validate_every)
    check_optimiser_training(job, job.weights_name("gnet"), stage)
    with report_on_terminal("training gnet"):
        from flows.training.optimiser_flow import train_network

        trained = train_network(
            "gnet",
            str(folder),
            recipe=recipe,
            real=real,
            novel=novel,
            fnet=fnet,
            device=device,
            save_every=save_every,
            validate_every=validate_every,
            stage=stage,
        )
    _print_weights("gnet", trained["weights"])


@app.command()
def enet(
    folder: FolderOption = Path("training"),
    recipe: RecipeOption = "shipped",
    real: RealLogOption = None,
    fnet: FixerOption = "builtin",
    device: DeviceOption = "auto",
    save_every: SaveEveryOption = 50,
    validate_every: ValidateEveryOption = 0,
    stage: StageOption = None,
) -> None:
    """Train ENet, the optimiser that enhances a scene.

    The stages of the recipe are trained in order, those of GNet that ENet's stages need included.

    Example:

    \b
        genre train enet --folder training --recipe paper
    """
    from flows.cli.terminal import report_on_terminal
    from flows.training.requirements import check_optimiser_training
    from flows.training.train_job import TrainJob

    job = TrainJob(str(folder), recipe, real, None, fnet, device, save_every, validate_every)
    check_optimiser_training(job, "enet", stage)
    with report_on_terminal("training enet"):
        from flows.training.optimiser_flow import train_network

        trained = train_network(
            "enet",
            str(folder),
            recipe=recipe,
            real=real,
            fnet=fnet,
            device=device,
            save_every=save_every,
            validate_every=validate_every,
            stage=stage,
        )
    _print_weights("enet", trained["weights"])


def _print_weights(network: str, weights: str) -> None:
    typer.echo(f"wrote {weights}; use these weights with --set {network}.weights={weights}")
    rates = _RESET_LEARNING_RATES[network]
    typer.echo(f"A preset's learning rates are for the built-in weights: add --set {rates}")
