"""The automation by which a Prefect server notices flow runs whose process is gone."""

from __future__ import annotations

from datetime import timedelta

from flows.operations.prefect_services import HEARTBEAT_SECONDS

AUTOMATION_NAME = "genre: a run without heartbeats has crashed"
SILENT_STATE_NAME = "Silent"
"""The name of the Crashed state that the automation sets.

The server counts the time by the clocks of the workers, so a run whose clock jumps back is called silent while it
lives. Who watches a run takes this state as a question, and the heartbeats as the answer.
"""
_PERIODS = 3


def install_heartbeat_automation(
    api_url: str, auth_string: str | None = None, heartbeat_seconds: int = HEARTBEAT_SECONDS
) -> str:
    """Asks the server to mark a flow run as Crashed when its heartbeats stop; a second call brings it up to date.

    Any event of the run within three periods counts, not only a heartbeat: a run that has just finished sends
    its last state instead.

    Args:
        api_url: the address of the Prefect API.
        auth_string: its password; ``None``: the one of the environment.
        heartbeat_seconds: the workers' ``PREFECT_FLOWS_HEARTBEAT_FREQUENCY``.

    Returns:
        The automation's id.
    """
    from prefect.client.orchestration import get_client
    from prefect.events.actions import ChangeFlowRunState
    from prefect.events.schemas.automations import AutomationCore, EventTrigger, Posture
    from prefect.events.schemas.events import ResourceSpecification
    from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings
    from prefect.states import StateType

    trigger = EventTrigger(
        after={"prefect.flow-run.heartbeat"},
        expect={"prefect.flow-run.*"},
        match=ResourceSpecification({"prefect.resource.id": ["prefect.flow-run.*"]}),
        for_each={"prefect.resource.id"},
        posture=Posture.Proactive,
        threshold=1,
        within=timedelta(seconds=_PERIODS * heartbeat_seconds),
    )
    action = ChangeFlowRunState(
        name=SILENT_STATE_NAME,
        state=StateType.CRASHED,
        message="No heartbeat: the run's process is gone.",
    )
    wanted = AutomationCore(name=AUTOMATION_NAME, trigger=trigger, actions=[action])
    settings = {PREFECT_API_URL: api_url}
    if auth_string is not None:
        settings[PREFECT_API_AUTH_STRING] = auth_string
    with temporary_settings(settings), get_client(sync_client=True) as client:
        found = client.read_automations_by_name(AUTOMATION_NAME)
        if found:
            client.update_automation(found[0].id, wanted)
            return str(found[0].id)
        return str(client.create_automation(wanted))
