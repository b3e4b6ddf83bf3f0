"""The finished run that formats, pages and services are measured on."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.common.run_stages import reconstruct
from benchmarks.common.task import require_log_folder
from flows.configuration import diff_from_preset, load_configuration
from flows.pipeline.stage_runner import Job
from flows.reconstruction.run_records import FinishedRun, summarise_run, write_run_record


@dataclass(frozen=True)
class RunCase:
    """A run to make.

    Attributes:
        log: URI of the log, whose chunk 0 is reconstructed.
        preset: small, for claims.
        settings: over the preset.
        store: folder of the artifacts.
    """

    log: str
    preset: str
    settings: tuple[str, ...]
    store: str

    def make(self) -> str:
        """Runs all stages that the store lacks, and writes the run's record and report.

        Returns:
            The run's name.

        Raises:
            NotMeasuredError: the log's folder is missing.
        """
        require_log_folder(self.log)
        config = load_configuration(self.preset, settings=self.settings)
        values = config.model_dump(mode="json")
        refs = reconstruct(Job(self.log, 0, self.store, values))
        run = FinishedRun(
            log=self.log,
            preset=self.preset,
            store=self.store,
            config=values,
            differs=diff_from_preset(config, self.preset),
            chunks={0: refs},
        )
        write_run_record(run, summarise_run(run), {})
        return run.name
