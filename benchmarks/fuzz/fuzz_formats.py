"""All readers that are fed with damaged files."""

from __future__ import annotations

from benchmarks.fuzz import fuzz_dataset_formats, fuzz_log_formats, fuzz_store_formats
from benchmarks.fuzz.fuzz_target import FuzzTarget

_GROUPS = (
    fuzz_log_formats.json_targets,
    fuzz_log_formats.pickle_targets,
    fuzz_log_formats.image_targets,
    fuzz_log_formats.yaml_targets,
    fuzz_store_formats.table_targets,
    fuzz_store_formats.exr_targets,
    fuzz_store_formats.splat_targets,
    fuzz_store_formats.weight_targets,
    fuzz_store_formats.manifest_targets,
    fuzz_dataset_formats.dataset_targets,
)


def list_targets() -> tuple[FuzzTarget, ...]:
    """Lists all targets in a fixed order."""
    return tuple(target for group in _GROUPS for target in group())
