"""Log records that know their stage and hold no credentials, as JSON lines where a worker's environment asks for it."""

from __future__ import annotations

import json
import logging
import os
import socket
import sys
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from flows.observability.redaction import redact
from flows.observability.stage_context import get_stage_context
from genre_tasks.errors import ConfigError

LOG_FORMAT = "GENRE_LOG_FORMAT"
"""The variable of the environment: ``json`` for JSON lines, ``text`` or nothing for text."""

# Private names: a record refuses extra values under a name that it has already.
_CONTEXT = "genre_context"
_SECONDS = "genre_seconds"
_RUN_VARIABLE = "PREFECT__FLOW_RUN_ID"
_make_record = logging.getLogRecordFactory()


class JsonFormatter(logging.Formatter):
    """Writes a record as one line of JSON.

    Every line has ``time`` (ISO 8601, UTC), ``level``, ``logger``, ``message``, ``host`` and ``pid``. Lines of a stage
    have ``log``, ``chunk``, ``stage`` and ``key`` as well, and the line of its end has ``seconds``. Lines of a flow run
    have its id as ``run``, and those of Prefect's tasks the task's name as ``task``.

    Args:
        arguments: of ``logging.Formatter``; none of them is used.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__()
        self._host = socket.gethostname()

    def format(self, record: logging.LogRecord) -> str:
        """Writes a record.

        Args:
            record: the record.

        Returns:
            One line without its end.
        """
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            # Records that were made before `prepare_logs` was called are not redacted yet.
            "message": redact(record.getMessage()),
        }
        line |= getattr(record, _CONTEXT, {})
        run = _find_run(record)
        if run:
            line["run"] = run
        task = getattr(record, "task_run_name", None)
        # Prefect's records of a task's start and end are made outside of the stage.
        if task:
            line["task"] = task
        line |= {"host": self._host, "pid": record.process}
        if hasattr(record, _SECONDS):
            line["seconds"] = round(getattr(record, _SECONDS), 6)
        if record.exc_info and not record.exc_text:
            record.exc_text = redact(self.formatException(record.exc_info))
        if record.exc_text:
            line["traceback"] = record.exc_text
        return json.dumps(line, ensure_ascii=False, default=str)


def wants_json_logs(environment: Mapping[str, str] = os.environ) -> bool:
    """Reads from the environment in which format logs are written.

    Args:
        environment: the variables.

    Returns:
        Whether they are JSON lines.

    Raises:
        ConfigError: the variable has a value that no format has.

    >>> wants_json_logs({"GENRE_LOG_FORMAT": "json"}), wants_json_logs({})
    (True, False)
    """
    value = environment.get(LOG_FORMAT) or "text"
    if value not in ("json", "text"):
        raise ConfigError(f"{LOG_FORMAT}={value} is no format of logs", remedy="Set it to json or text.")
    return value == "json"


def prepare_logs() -> None:
    """Makes all records of this process know their stage and hide credentials, and writes JSON lines if asked to.

    May be called again, which replaces the formats of handlers that were added since.

    Raises:
        ConfigError: the variable has a value that no format has.
    """
    logging.setLogRecordFactory(_make_stage_record)
    if not wants_json_logs():
        return
    known = [logging.getLogger(), *logging.root.manager.loggerDict.values()]
    for logger in known:
        # Names that only others lie below have a place holder without handlers.
        for handler in list(getattr(logger, "handlers", ())):
            _replace_handler(logger, handler)
    if not logging.getLogger().handlers:
        logging.getLogger().addHandler(_make_handler(sys.stderr, logging.NOTSET))


def log_stage_end(stage: str, outcome: str, seconds: float) -> None:
    """Writes a line with the seconds of a stage, where logs are JSON lines; in text, the reporter's line says enough.

    Args:
        stage: the stage's name.
        outcome: computed, cached or failed.
        seconds: wall time.
    """
    if wants_json_logs():
        logging.getLogger("genre.stages").info("%s: %s", stage, outcome, extra={_SECONDS: seconds})


def prefect_log_variables() -> dict[str, str]:
    """Names the variables that make Prefect's worker itself write JSON lines; flow runs do by :data:`LOG_FORMAT`.

    Returns:
        Values by name.

    >>> prefect_log_variables()["PREFECT_LOGGING_HANDLERS_CONSOLE_FORMATTER"]
    'json'
    """
    return {
        LOG_FORMAT: "json",
        "PREFECT_LOGGING_HANDLERS_CONSOLE_FORMATTER": "json",
        "PREFECT_LOGGING_FORMATTERS_JSON_CLASS": f"{__name__}.{JsonFormatter.__name__}",
        # Colours would put control codes into the lines.
        "PREFECT_LOGGING_COLORS": "false",
    }


def _make_stage_record(*arguments: Any, **options: Any) -> logging.LogRecord:
    """A record as Python makes it, with the context of the thread that logs, and without credentials."""
    record = _make_record(*arguments, **options)
    context = get_stage_context()
    if context is not None:
        setattr(record, _CONTEXT, {name: value for name, value in asdict(context).items() if value != ""})
    try:
        message = record.getMessage()
    except (TypeError, ValueError, KeyError):
        # The handler reports a message whose arguments do not fit.
        return record
    redacted = redact(message)
    # Left alone otherwise: some handlers group records by the message before its arguments are filled in.
    if redacted != message:
        record.msg = redacted
        record.args = ()
    if record.exc_info and record.exc_info[0] is not None:
        text = logging.Formatter().formatException(record.exc_info)
        # Formatters take a text that is there already.
        if redact(text) != text:
            record.exc_text = redact(text)
    return record


def _replace_handler(logger: Any, handler: logging.Handler) -> None:
    stream = getattr(handler, "stream", None)
    if stream is None or stream not in (sys.stderr, sys.stdout, sys.__stderr__, sys.__stdout__):
        return
    if isinstance(handler.formatter, JsonFormatter) and type(handler) is logging.StreamHandler:
        return
    # Prefect's handler of the console replaces codes such as ":key:" by pictures, which breaks JSON values.
    logger.removeHandler(handler)
    logger.addHandler(_make_handler(stream, handler.level))


def _make_handler(stream: Any, level: int) -> logging.Handler:
    handler = logging.StreamHandler(stream)
    handler.setLevel(level)
    handler.setFormatter(JsonFormatter())
    return handler


def _find_run(record: logging.LogRecord) -> str:
    # Prefect's own records name their run; others are of the run that this process was started for.
    run = getattr(record, "flow_run_id", None) or os.environ.get(_RUN_VARIABLE, "")
    if not run and "prefect.context" in sys.modules:
        context = sys.modules["prefect.context"].FlowRunContext.get()
        run = context.flow_run.id if context is not None and context.flow_run is not None else ""
    return "" if run in ("<unknown>", "None") else str(run)
