"""The work pool, its queues and GenRe's deployments, made through Prefect's API."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flows.operations.heartbeat_automation import install_heartbeat_automation

COORDINATOR_QUEUE = "datasets"
RUN_QUEUE = "default"
_COMMAND = "python -m prefect.engine"
"""What a worker starts. Without it, a worker starts Prefect twice, first to prepare a folder that no flow needs. By its
name, since the interpreter of another machine may lie at another path."""


@dataclass(frozen=True)
class FlowDeployment:
    """A deployment as prefect.yaml names it, which an installed package does not carry."""

    name: str
    entrypoint: str
    queue: str = RUN_QUEUE
    parameters: dict[str, Any] = field(default_factory=dict)


DEPLOYMENTS = (
    FlowDeployment(
        "log",
        "flows/reconstruction/flow.py:reconstruct_log",
        parameters={"log": "synthetic:street?seed=1000", "preset": "demo"},
    ),
    FlowDeployment(
        "dataset",
        "flows/dataset/flow.py:reconstruct_dataset",
        # Not the runs' queue: a parent must not take the slot that its children wait for.
        queue=COORDINATOR_QUEUE,
        parameters={"logs": ["synthetic:street?seed=1000"], "preset": "demo"},
    ),
    FlowDeployment(
        "training-scenes",
        "flows/training/optimiser_flow.py:train_scenes",
        parameters={"folder": "training", "recipe": "shipped"},
    ),
    FlowDeployment(
        "training",
        "flows/training/optimiser_flow.py:train_network",
        parameters={"network": "gnet", "folder": "training", "recipe": "shipped"},
    ),
)


def fill_parameters(deployment: FlowDeployment, store: str, training_folder: Path) -> dict[str, Any]:
    """Gives the parameters of a deployment, with the places where its runs keep what they make.

    Args:
        deployment: one of :data:`DEPLOYMENTS`.
        store: the default store; a path must be absolute.
        training_folder: as :func:`deploy_flows` takes it.

    Returns:
        Plain values by name.

    >>> fill_parameters(DEPLOYMENTS[0], "/store", Path("/training"))["store"]
    '/store'
    """
    # A training has its own store, below its folder.
    place = {"folder": str(training_folder)} if "folder" in deployment.parameters else {"store": store}
    return {**deployment.parameters, **place}


def deploy_flows(api_url: str, auth_string: str | None, pool: str, store: str, *, training_folder: Path) -> list[str]:
    """Makes pool, queues, deployments and the heartbeat automation; what exists is brought up to date.

    Args:
        api_url: the address of the Prefect API.
        auth_string: its password; ``None``: the environment's.
        pool: the work pool, of type process.
        store: the default store of the deployments; a path must be absolute.
        training_folder: what the workers of trainings keep, as they see it; an absolute path.

    Returns:
        The deployments' names, such as ``reconstruct-log/log``.
    """
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.actions import WorkPoolCreate
    from prefect.exceptions import ObjectAlreadyExists
    from prefect.flows import load_flow_from_entrypoint
    from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings
    from prefect.utilities.callables import parameter_schema

    settings = {PREFECT_API_URL: api_url}
    if auth_string is not None:
        settings[PREFECT_API_AUTH_STRING] = auth_string
    names = []
    with temporary_settings(settings), get_client(sync_client=True) as client:
        if pool not in {found.name for found in client.read_work_pools()}:
            # Another deployment may have made it just now.
            with suppress(ObjectAlreadyExists):
                client.create_work_pool(WorkPoolCreate(name=pool, type="process"))
        with suppress(ObjectAlreadyExists):
            client.create_work_queue(name=COORDINATOR_QUEUE, work_pool_name=pool)
        for deployment in DEPLOYMENTS:
            # By its module, a run imports the flow where it starts; by its file, Prefect asks for steps to fetch it.
            entrypoint = deployment.entrypoint.replace(".py:", ".").replace("/", ".")
            loaded: Any = load_flow_from_entrypoint(entrypoint)
            client.create_deployment(
                flow_id=client.create_flow_from_name(loaded.name),
                name=deployment.name,
                entrypoint=entrypoint,
                parameters=fill_parameters(deployment, store, training_folder),
                parameter_openapi_schema=parameter_schema(loaded).model_dump_for_openapi(),
                work_pool_name=pool,
                work_queue_name=deployment.queue,
                job_variables={"command": _COMMAND},
                enforce_parameter_schema=False,
            )
            names.append(f"{loaded.name}/{deployment.name}")
    install_heartbeat_automation(api_url, auth_string)
    return names
