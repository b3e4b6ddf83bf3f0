"""The services that a deployment needs, started and stopped on this machine without containers."""

from __future__ import annotations

from flows.operations.heartbeat_automation import install_heartbeat_automation
from flows.operations.object_server import ObjectServer
from flows.operations.postgres_server import PostgresServer
from flows.operations.prefect_services import PrefectServer, PrefectServices, Worker
from flows.operations.service import Service

__all__ = [
    "ObjectServer",
    "PostgresServer",
    "PrefectServer",
    "PrefectServices",
    "Service",
    "Worker",
    "install_heartbeat_automation",
]
