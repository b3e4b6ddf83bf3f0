"""The stages of the pipeline as data: name, artifact kind, configuration section, inputs, weights, function.

Reading this file tells what flows into what. Stage functions are named, not imported: a run that is served from the
cache never pays for torch.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from genre_tasks.config import LPIPS_NETWORKS, EffectsConfig, PipelineConfig
from storage import keys
from storage.code_digest import code_digest
from storage.keys import digest_file, digest_value

RECONSTRUCTION_STAGES = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet")
"""The stages that make a scene, in their order; evaluation stages are not among them."""

SPECIAL_ARGUMENTS = ("log", "chunk_index", "stage_name", "truth")
"""Arguments of a stage function that are not the result of an earlier stage."""


@dataclass(frozen=True)
class StageSpec:
    """Describes one stage.

    Attributes:
        name: the stage's name, such as ``gnet`` or ``evaluate/gnet``.
        kind: the kind of artifact that the stage makes; it chooses the codec.
        section: the section of the configuration that the stage gets.
        function: ``module:name``; it is called as ``function(section, *arguments, progress=…)``.
        arguments: for each argument the name of an earlier stage (its value is passed) or a special argument.
        weights: the network whose weights the stage loads; ``None`` for a stage without a network.
        batch_setting: a setting of the section that bounds memory and changes the payload by rounding at most. It is
            halved when memory runs out, and it is not part of the key.
        lazy_modules: modules that belong to the stage's code although no import names them.
    """

    name: str
    kind: str
    section: str
    function: str
    arguments: tuple[str, ...]
    weights: str | None = None
    batch_setting: str | None = None
    lazy_modules: tuple[str, ...] = ()

    @property
    def module(self) -> str:
        """The full name of the module that holds the stage function."""
        return self.function.partition(":")[0]

    @property
    def inputs(self) -> tuple[str, ...]:
        """The earlier stages whose results the stage reads.

        >>> STAGE_BY_NAME["gnet"].inputs
        ('ingest', 'initial', 'effects')
        """
        return tuple(argument for argument in self.arguments if argument not in SPECIAL_ARGUMENTS)

    @property
    def needs_log(self) -> bool:
        """Whether the stage reads the driving log itself: its frames, or the truth of a synthetic log."""
        return "log" in self.arguments or "truth" in self.arguments


_STAGES = "genre_tasks.stages"

PIPELINE: tuple[StageSpec, ...] = (
    StageSpec("ingest", "chunk", "ingest", f"{_STAGES}.ingest:ingest", ("log", "chunk_index")),
    StageSpec(
        "effects",
        "effects",
        "effects",
        f"{_STAGES}.effects:effects",
        ("ingest", "log"),
        # The stage looks its effects up in a registry of names: reading its imports would not find their code.
        lazy_modules=tuple(f"genre_tasks.effects.{name}" for name in EffectsConfig.model_fields),
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
        batch_setting="batch_views",
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
"""All stages, each after the stages that it reads."""

STAGE_BY_NAME: Mapping[str, StageSpec] = {spec.name: spec for spec in PIPELINE}

_FILE_SETTINGS = {"ingest": ("points", "scene"), "initial": ("scene",), "evaluate": ("inception", "lpips")}
"""Settings that name files, by section."""

_SCENE_MODULES = {"ingest": f"{_STAGES}.scene_points", "initial": f"{_STAGES}.scene_file"}
"""What the stages run in addition where they read a file of Gaussians."""

_WEIGHTS_SETTINGS = {"weights": True, "refine": {"weights"}}
"""Settings that name weights: their digest is part of the key, so where they lie is not."""


def stages_until(end: str) -> tuple[str, ...]:
    """Lists the stages that a run goes through when the scene of stage ``end`` is its result.

    Args:
        end: a name in :data:`RECONSTRUCTION_STAGES`.

    Returns:
        The names from ``ingest`` to ``end``, in order.

    Raises:
        ValueError: ``end`` is not a reconstruction stage.

    >>> stages_until("gnet")
    ('ingest', 'effects', 'initial', 'gnet')
    """
    return RECONSTRUCTION_STAGES[: RECONSTRUCTION_STAGES.index(end) + 1]


def config_section(spec: StageSpec, config: PipelineConfig) -> Any:
    """Picks the part of the configuration that a stage gets.

    Args:
        spec: the stage.
        config: the configuration of the whole pipeline.

    Returns:
        The pydantic model of the stage's section, such as ``GnetConfig``.

    >>> config_section(STAGE_BY_NAME["evaluate/gnet"], PipelineConfig()) == PipelineConfig().evaluate
    True
    """
    return getattr(config, spec.section)


def find_weights_file(spec: StageSpec, config: PipelineConfig) -> Path | None:
    """Finds the network's weights that a stage will load.

    Args:
        spec: the stage.
        config: the configuration of the whole pipeline.

    Returns:
        The file or folder, or ``None`` if the stage runs without a network.

    Raises:
        InputError: the configuration names weights that do not exist.
    """
    section = config_section(spec, config)
    method = getattr(section, "method", "learned")
    # Methods without a network, such as tuned Adam and per-scene 3DGS, load nothing whatever `weights` says.
    if spec.weights is None or method not in ("learned", "g3r"):
        return None
    from genre_tasks.weights import resolve_weights, select_network

    return resolve_weights(select_network(spec.weights, method), section.weights)


def digest_stage_weights(spec: StageSpec, config: PipelineConfig) -> str | None:
    """Digests all weights that a stage will load, those of a refinement part included.

    Args:
        spec: the stage.
        config: the configuration of the whole pipeline.

    Returns:
        64 hex digits, or ``None`` if the stage loads no weights.

    Raises:
        InputError: the configuration names weights that do not exist.
    """
    stage_digest = digest_weights(find_weights_file(spec, config))
    refinement = getattr(config_section(spec, config), "refinement", None)
    # The bare digest where nothing is refined, so that stages without this option keep a key of their own form.
    if refinement is None:
        return stage_digest
    from genre_tasks.weights import resolve_weights

    return digest_value(
        [stage_digest, digest_weights(resolve_weights("gnet", refinement.weights, "gnet.refine.weights"))]
    )


def digest_weights(path: Path | None) -> str | None:
    """Digests weights by the content of the files that are read when they are loaded.

    Where they lie, their name and other files beside them do not count.

    Args:
        path: the file or folder; ``None`` for a stage without weights.

    Returns:
        64 hex digits, or ``None`` for ``None``.
    """
    if path is None:
        return None
    from genre_tasks.weights import list_weights_files

    return digest_value({use: _digest_weights_file(file) for use, file in list_weights_files(path).items()})


def _digest_weights_file(file: Path) -> str:
    if file.suffix == ".json":
        try:
            # The value and not the bytes: a checkout may change the line endings of a text file.
            return digest_value(json.loads(file.read_bytes()))
        except ValueError:
            # Not JSON after all: loading it will be an error that names the file.
            return digest_file(file)
    return digest_file(file)


def find_scene_modules(spec: StageSpec, config: PipelineConfig) -> tuple[str, ...]:
    """Names the code that a stage runs only where it reads a file of Gaussians: the file's format, and its own.

    Args:
        spec: the stage.
        config: the configuration of the whole pipeline.

    Returns:
        Modules; none for a stage that reads no such file.

    Raises:
        InputError: the file's name has no known suffix.
        ConfigError: the format's package is not installed.

    >>> find_scene_modules(STAGE_BY_NAME["initial"], PipelineConfig())
    ()
    """
    file = getattr(config_section(spec, config), "scene", None)
    if file is None:
        return ()
    from genre_tasks.exchange.registry import find_format

    return (_SCENE_MODULES[spec.name], type(find_format(Path(file))).__module__)


def stage_key(
    spec: StageSpec,
    config: PipelineConfig,
    inputs: Mapping[str, str],
    weights: str | None,
    more_modules: tuple[str, ...] = (),
) -> str:
    """Computes the key of a stage's artifact: equal keys mean that a stored artifact can be used again.

    Args:
        spec: the stage.
        config: the configuration of the whole pipeline; only the stage's section counts.
        inputs: name → payload digest of each input, and for ``log`` the log's digest and the chunk.
        weights: digest of the stage's weights, from :func:`digest_stage_weights`.
        more_modules: what reads the log and files of Gaussians. No import of the stage names it, but it is part of the
            stage's code.

    Returns:
        64 hex digits of sha256.
    """
    # A retry with a smaller batch makes the same payload but for rounding, so it must have the same key.
    excluded: dict[str, Any] = dict(_WEIGHTS_SETTINGS)
    if spec.batch_setting:
        excluded[spec.batch_setting] = True
    configuration = config_section(spec, config).model_dump(mode="json", exclude=excluded)
    for key in _FILE_SETTINGS.get(spec.section, ()):
        # A file that a setting names is an input: its bytes count, not its name alone.
        # The name of a network is no file's name, even where a file has it.
        is_network = key == "lpips" and configuration[key] in LPIPS_NETWORKS
        if configuration[key] and not is_network and Path(configuration[key]).is_file():
            configuration[key] = digest_file(Path(configuration[key]))
    code = code_digest(spec.module, lazy_modules=(*spec.lazy_modules, *more_modules))
    return keys.stage_key(spec.name, code, configuration, inputs, weights)
