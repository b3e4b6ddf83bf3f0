"""Log records know their stage, hide credentials, and are JSON lines where the environment asks for it."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.observability.log_records import LOG_FORMAT, JsonFormatter, prepare_logs, wants_json_logs
from flows.observability.redaction import redact
from flows.observability.stage_context import enter_stage, get_stage_context, with_stage_context
from flows.pipeline.stage_runner import Job
from genre_tasks.errors import ConfigError
from tests.faults.small_run import ROOT

SECRET = "pa55word"
TEXTS = (
    f"cannot reach s3://key:{SECRET}@127.0.0.1:9000/bucket/logs",
    f"postgresql+asyncpg://genre:{SECRET}@db/prefect is gone",
    f"http://user:{SECRET}@with-at@host:4200/api",
    f"http://{SECRET}@host/api",
    f"GET https://host/a?X-Amz-Credential={SECRET}%2F1&X-Amz-Signature={SECRET}&part=1 failed",
    f"https://account.blob/a?sv=2024&sig={SECRET}",
    f"https://host/a?token={SECRET}",
    f"AWS_SECRET_ACCESS_KEY={SECRET}",
    f"secret_access_key={SECRET}",
    f"{{'Authorization': 'Basic {SECRET}'}}",
    f"authorization: Bearer {SECRET}",
)


@pytest.fixture()
def records() -> Iterator[list[str]]:
    """The lines that a logger below ``prefect`` writes as JSON."""
    lines: list[str] = []

    class Sink(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(self.format(record))

    factory = logging.getLogRecordFactory()
    prepare_logs()
    logger = logging.getLogger("prefect.observability_test")
    sink = Sink()
    sink.setFormatter(JsonFormatter())
    logger.addHandler(sink)
    level = logger.level
    logger.setLevel(logging.INFO)
    yield lines
    logger.setLevel(level)
    logger.removeHandler(sink)
    logging.setLogRecordFactory(factory)


@pytest.mark.parametrize("text", TEXTS)
def test_credentials_are_masked(text: str) -> None:
    assert SECRET not in redact(text)
    assert "***" in redact(text)


@pytest.mark.parametrize(
    "text",
    [
        "synthetic:street?seed=1000&frames=8",
        "s3://bucket/a/b@2x.png",
        "see https://host/path?part=1",
        "mail a@b.example",
        "gnet.iterations=2",
        "pandaset:/data/002",
    ],
)
def test_what_is_no_secret_stays(text: str) -> None:
    assert redact(text) == text


def test_a_record_of_any_logger_has_the_stage(records: list[str]) -> None:
    log = logging.getLogger("prefect.observability_test")
    with enter_stage(f"s3://u:{SECRET}@host/log", 3, "gnet") as context:
        log.info("before the key")
        context.key = "5f41"
        log.warning("at %d of %d", 1, 2)
    log.info("after")
    first, second, last = map(json.loads, records)
    assert (first["log"], first["chunk"], first["stage"]) == ("s3://***@host/log", 3, "gnet")
    assert "key" not in first
    assert (second["key"], second["message"], second["level"]) == ("5f41", "at 1 of 2", "WARNING")
    assert second["pid"] == os.getpid()
    assert second["host"] and second["time"].endswith("+00:00")
    assert not {"log", "chunk", "stage", "key"} & set(last)


def test_messages_arguments_and_tracebacks_have_no_credentials(records: list[str]) -> None:
    log = logging.getLogger("prefect.observability_test")
    log.info("cannot reach %s", f"s3://a:{SECRET}@host/b")
    try:
        raise OSError(f"https://host/a?X-Amz-Signature={SECRET}")
    except OSError:
        log.exception("failed at %s", "a stage")
    assert SECRET not in "".join(records)
    assert "X-Amz-Signature=***" in json.loads(records[1])["traceback"]
    assert json.loads(records[1])["message"] == "failed at a stage"


def test_a_message_with_lines_stays_one_line(records: list[str]) -> None:
    logging.getLogger("prefect.observability_test").info('a "quoted"\nsecond line :key:')
    assert "\n" not in records[0]
    assert json.loads(records[0])["message"] == 'a "quoted"\nsecond line :key:'


def test_a_record_names_the_flow_run(records: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    log = logging.getLogger("prefect.observability_test")
    log.info("of Prefect", extra={"flow_run_id": "run-1", "task_run_name": "gnet · chunk 0"})
    monkeypatch.setenv("PREFECT__FLOW_RUN_ID", "run-2")
    log.info("of the process")
    assert [json.loads(line)["run"] for line in records] == ["run-1", "run-2"]
    assert json.loads(records[0])["task"] == "gnet · chunk 0"


def test_a_task_runs_in_the_context_of_its_stage() -> None:
    @with_stage_context
    def task(stage: str, chunk: int, job: Job, inputs: dict[str, str]) -> tuple[str, int, str]:
        context = get_stage_context()
        assert context is not None
        return context.log, context.chunk, context.stage

    job = Job("synthetic:street", 2, "store", {})
    assert task("gnet", 2, job, {}) == ("synthetic:street", 2, "gnet")
    assert task(stage="enet", chunk=2, job=job, inputs={})[2] == "enet"
    assert get_stage_context() is None


def test_an_unknown_format_is_refused() -> None:
    with pytest.raises(ConfigError, match="GENRE_LOG_FORMAT=yaml"):
        wants_json_logs({LOG_FORMAT: "yaml"})


@pytest.mark.parametrize("log_format", ["json", "text"])
def test_a_process_writes_what_its_environment_asks_for(tmp_path: Path, log_format: str) -> None:
    code = (
        "import flows.pipeline.progress, logging\n"
        "from flows.observability.stage_observation import observe_stage\n"
        "with observe_stage('synthetic:street', 0, 'gnet'):\n"
        f"    logging.getLogger('genre').warning('from s3://a:{SECRET}@host/b')\n"
        "    logging.getLogger('other.library').warning('hello')\n"
    )
    env = os.environ | {LOG_FORMAT: log_format, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=env, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert SECRET not in done.stderr
    lines = done.stderr.splitlines()
    if log_format == "text":
        assert lines == ["from s3://***@host/b", "hello"]
        return
    written = [json.loads(line) for line in lines]
    assert [line["logger"] for line in written] == ["genre", "other.library", "genre.stages"]
    assert all((line["stage"], line["chunk"]) == ("gnet", 0) for line in written)
    assert written[-1]["message"] == "gnet: computed"
    assert written[-1]["seconds"] > 0
