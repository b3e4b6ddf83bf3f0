"""``genre ops``: the services of a deployment on this machine, without containers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.options import JsonOption
from flows.cli.parsing import parse_path

app = typer.Typer(
    help="""Start, show and stop the services of a deployment on this machine.

    Example:

    \b
        genre ops up --workers 2
        eval "$(genre ops status --env)"
        genre ops down
    """,
    no_args_is_help=True,
)

FolderOption = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="The folder for data, logs and passwords. `operations` in the state folder if not given.",
    ),
]

TrainingFolderOption = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="The folder of the training deployments, by the path that it has for workers. `training` in this folder "
        "if not given.",
    ),
]


def _find_folder(folder: Path | None) -> Path:
    from flows.machine.state_folder import find_state_folder

    return (find_state_folder() / "operations" if folder is None else folder).absolute()


@app.command(name="up")
def up(
    folder: FolderOption = None,
    workers: Annotated[int, typer.Option(min=0, help="How many workers take logs, one log each at a time.")] = 2,
    pool: Annotated[str, typer.Option(help="The name of the work pool.")] = "genre",
    store_server: Annotated[
        bool, typer.Option("--store-server/--no-store-server", help="Start an S3 server for the store.")
    ] = True,
    database: Annotated[str, typer.Option(help="The Prefect server's database: postgres or sqlite.")] = "postgres",
) -> None:
    """Start the services that do not run yet, and deploy the flows.

    Example:

    \b
        genre ops up --workers 2 --database sqlite --no-store-server
    """
    from flows.operations.stack import Stack, describe_services

    state = _find_folder(folder)
    Stack(state, workers, pool, store_server, database).start()
    _print_services(describe_services(state), as_json=False)
    typer.echo('For clients: eval "$(genre ops status --env)"')


@app.command(name="status")
def status(
    folder: FolderOption = None,
    env: Annotated[
        bool, typer.Option("--env", help="Print the variables for clients, passwords included, for eval.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Show the services, or what clients of them must export.

    Example:

    \b
        genre ops status --json
    """
    from flows.cli.outcome import print_outcome
    from flows.operations.stack import describe_services, read_client_environment
    from genre_tasks.errors import InputError

    state = _find_folder(folder)
    if not env:
        _print_services(describe_services(state), as_json=json)
        return
    file = state / "env"
    if not file.exists():
        raise InputError("no services were started", remedy="Start them by `genre ops up`.", file=file)
    # Also before they are printed as they are: a shell would take half of a value for all of it.
    values = read_client_environment(file)
    if json:
        print_outcome("done", {"environment": values})
        return
    typer.echo(file.read_text(), nl=False)


@app.command(name="down")
def down(
    folder: FolderOption = None,
    delete: Annotated[
        bool, typer.Option("--delete", help="Remove data, logs and passwords too, but no trainings.")
    ] = False,
) -> None:
    """Stop all services, workers first.

    Example:

    \b
        genre ops down
    """
    from flows.operations.stack import stop_stack

    stopped = stop_stack(_find_folder(folder), delete)
    typer.echo(f"Stopped: {', '.join(stopped)}" if stopped else "Nothing ran.")


@app.command(name="deploy")
def deploy(
    pool: Annotated[str, typer.Option(help="The name of the work pool.")] = "genre",
    store: Annotated[str, typer.Option(help="The default store of the deployments.")] = "genre-store",
    training_folder: TrainingFolderOption = None,
) -> None:
    """Deploy the flows at the Prefect server of PREFECT_API_URL.

    Example:

    \b
        genre ops deploy --store s3://bucket/store
    """
    from flows.operations.deployments import deploy_flows
    from flows.prefect_api.connection import check_server, read_api_url
    from genre_tasks.errors import ConfigError
    from storage.opening import make_address_absolute

    url = read_api_url()
    if url is None:
        raise ConfigError("PREFECT_API_URL is not set", remedy="Set it to the address of the Prefect API.")
    address = make_address_absolute(store)
    check_server(url)
    trainings = Path("training") if training_folder is None else training_folder
    for name in deploy_flows(url, None, pool, address, training_folder=trainings.absolute()):
        typer.echo(name)


def _print_services(rows: list[dict[str, object]], as_json: bool) -> None:
    if as_json:
        from flows.cli.outcome import print_outcome

        print_outcome("done", {"services": rows})
        return
    from flows.cli.printing import print_rows

    print_rows("services", rows)
