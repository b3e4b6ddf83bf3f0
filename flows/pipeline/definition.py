"""The stages of the pipeline as data: name, artifact kind, configuration section, inputs, weights, function.

Reading this file tells what flows into what. Stage functions are named, not imported: a run that is served from the
cache never pays for torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from genre_tasks.config import EffectsConfig, PipelineConfig
from storage import keys
from storage.code_digest import code_digest
from storage.keys import digest_file, digest_value

RECONSTRUCTING = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet")


@dataclass(frozen=True)
class StageSpec:
    """One stage.

    ``function`` is ``module:name``; it is called as ``function(config section, *arguments, progress=…)``, where each
    argument is the name of an earlier stage (its value) or one of ``log``, ``chunk_index``, ``stage_name``, ``truth``.
    ``weights`` names the weights it loads. ``splits`` names a setting that bounds memory and does not change a
    payload's bytes: it is halved when memory runs out, and is not part of the key. ``lazy`` modules are its code too,
    though no import of the stage names them.
    """

    name: str
    kind: str
    section: str
    function: str
    arguments: tuple[str, ...]
    weights: str | None = None
    splits: str | None = None
    lazy: tuple[str, ...] = ()

    @property
    def module(self) -> str:
        return self.function.partition(":")[0]

    @property
    def inputs(self) -> tuple[str, ...]:
        """The earlier stages it reads."""
        return tuple(a for a in self.arguments if a not in SPECIAL_ARGUMENTS)

    @property
    def needs_log(self) -> bool:
        """Whether it reads the driving log itself (its frames, or the truth a synthetic log has)."""
        return "log" in self.arguments or "truth" in self.arguments


SPECIAL_ARGUMENTS = ("log", "chunk_index", "stage_name", "truth")
_STAGES = "genre_tasks.stages"

PIPELINE: tuple[StageSpec, ...] = (
    StageSpec("ingest", "chunk", "ingest", f"{_STAGES}.ingest:ingest", ("log", "chunk_index")),
    StageSpec(
        "effects",
        "effects",
        "effects",
        f"{_STAGES}.effects:effects",
        ("ingest", "log"),
        lazy=tuple(f"genre_tasks.effects.{name}" for name in EffectsConfig.model_fields),
    ),
    StageSpec("initial", "reconstruction", "initial", f"{_STAGES}.initial:initial", ("ingest", "effects")),
    StageSpec(
        "gnet", "reconstruction", "gnet", f"{_STAGES}.gnet:gnet", ("ingest", "initial", "effects"), weights="gnet"
    ),
    StageSpec(
        "novel_views", "novel_views", "novel_views", f"{_STAGES}.novel_views:novel_views", ("ingest", "gnet", "effects")
    ),
    StageSpec(
        "fnet",
        "fixed_views",
        "fnet",
        f"{_STAGES}.fnet:fnet",
        ("ingest", "novel_views", "effects"),
        weights="fnet",
        splits="batch_views",
    ),
    StageSpec(
        "enet", "reconstruction", "enet", f"{_STAGES}.enet:enet", ("ingest", "gnet", "fnet", "effects"), weights="enet"
    ),
    *(
        StageSpec(
            f"evaluate/{name}",
            "evaluation",
            "evaluate",
            f"{_STAGES}.evaluate:evaluate_scene",
            ("ingest", "stage_name", name, "truth", "effects"),
        )
        for name in ("initial", "gnet", "enet")
    ),
    StageSpec(
        "evaluate/fnet",
        "evaluation",
        "evaluate",
        f"{_STAGES}.evaluate:evaluate_fixed",
        ("ingest", "fnet", "novel_views", "truth"),
    ),
)
_FILES = {"ingest": ("points",), "evaluate": ("inception", "lpips")}
"""Settings that name files, by section."""
BY_NAME: Mapping[str, StageSpec] = {spec.name: spec for spec in PIPELINE}


def reconstructing_until(end: str) -> tuple[str, ...]:
    """The reconstructing stages up to ``end``, whose scene is the result."""
    return RECONSTRUCTING[: RECONSTRUCTING.index(end) + 1]


def section_of(spec: StageSpec, config: PipelineConfig) -> Any:
    """The configuration subtree that the stage gets."""
    return getattr(config, spec.section)


def weights_file(spec: StageSpec, config: PipelineConfig) -> Path | None:
    """The weights that the stage will load, or ``None`` if it loads none."""
    section = section_of(spec, config)
    method = getattr(section, "method", "learned")
    if spec.weights is None or method not in ("learned", "g3r"):
        return None
    from genre_tasks.weights import network_of, resolve_weights

    return resolve_weights(network_of(spec.weights, method), section.weights)


def stage_weights(spec: StageSpec, config: PipelineConfig) -> str | None:
    """Digest of all weights that the stage will load, or ``None`` if it loads none."""
    first, finish = weights_digest(weights_file(spec, config)), getattr(section_of(spec, config), "refinement", None)
    if finish is None:
        return first
    from genre_tasks.weights import resolve_weights

    return digest_value([first, weights_digest(resolve_weights("gnet", finish.weights, "gnet.refine.weights"))])


def weights_digest(path: Path | None) -> str | None:
    """sha256 over the weights (a file with its JSON beside it, or all files of a folder)."""
    if path is None:
        return None
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path, path.with_suffix(".json")]
    return digest_value([[file.name, digest_file(file)] for file in files if file.exists()])


def stage_key(
    spec: StageSpec,
    config: PipelineConfig,
    inputs: Mapping[str, str],
    weights: str | None,
    reader: tuple[str, ...] = (),
) -> str:
    """The artifact's key: sha256 of stage, code digest, configuration subtree, inputs' payload digests, weights.

    ``inputs`` maps each input's name to the digest of its payload (for ``log``: the log's digest and the chunk);
    ``reader`` is the module that reads the log, which no import of the stage names but which is part of its code.
    """
    configuration = section_of(spec, config).model_dump(mode="json", exclude={spec.splits} if spec.splits else set())
    for key in _FILES.get(spec.section, ()):
        if configuration[key] and Path(configuration[key]).is_file():  # an input: its bytes count, not its name alone
            configuration[key] = digest_file(Path(configuration[key]))
    code = code_digest(spec.module, also=(*spec.lazy, *reader))
    return keys.stage_key(spec.name, code, configuration, inputs, weights)
