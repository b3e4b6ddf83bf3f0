"""What the record of a run says of its simulations, which another version may have written."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from flows.configuration import validate_config
from genre_tasks.config import PipelineConfig
from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.errors import InputError
from genre_tasks.scene_edits.edits import EditList


def read_recorded_config(record: Mapping[str, Any]) -> PipelineConfig:
    """Reads the settings of a run, which its simulations take unless others are asked for.

    Args:
        record: of the run, as ``run.json`` holds it.

    Returns:
        The configuration that was asked for; what a budget chose over it plays no part in simulations.

    Raises:
        ConfigError: another version wrote the record, with settings that this one does not know.
    """
    return validate_config(record["config"], f"the record of run {record['run']}")


def read_simulate_config(record: Mapping[str, Any]) -> SimulateConfig:
    """Reads the settings of simulations of a run.

    Args:
        record: of the run, as ``run.json`` holds it.

    Returns:
        The section ``simulate``. Other sections are not read, so that they may be those of another version.

    Raises:
        ConfigError: another version wrote the record, with settings of simulations that this one does not know.
    """
    # A record from before there were simulations has no such section.
    section = record["config"].get("simulate", {})
    return validate_config({"simulate": section}, f"the record of run {record['run']}").simulate


def read_recorded_edits(record: Mapping[str, Any]) -> EditList:
    """Reads the edits that a run was made with.

    Args:
        record: of the run, as ``run.json`` holds it.

    Returns:
        The edits; none if the run is not an edited one.

    Raises:
        InputError: another version wrote the record, with edits that this one does not know.
    """
    edited = record.get("edited")
    if edited is None:
        return EditList()
    try:
        return EditList.model_validate(edited["edits"])
    except ValidationError as error:
        # One at a time: further problems are often consequences of the first.
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise InputError(
            f"this version cannot read the edits of run {record['run']} ({place}: {first['msg']})",
            remedy=f"Edit run {edited['run']} again with `genre edit`.",
        ) from error
