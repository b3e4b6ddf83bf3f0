"""The arguments of a training of FNet, and where its files are found."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

from genre_tasks.errors import ConfigError
from genre_tasks.fixer.network import INPUTS
from genre_tasks.fixer.training_settings import PRESETS, STARTS_FROM, TrainingSettings
from genre_tasks.user_paths import expand_user_path
from storage.local import LocalStore

CURVE_FILE = "curve.parquet"
SCORES_FILE = "validation.parquet"
WEIGHTS_FILE = "fnet.safetensors"


@dataclass(frozen=True)
class FixerJob:
    """The arguments of a training of FNet: plain values.

    Attributes:
        folder: holds the store of scenes and pairs and a folder for each set of inputs.
        real: URI of a log whose chunk 0 is trained on, if any.
        streets: how many synthetic streets.
        inputs: what the fixer is given, joined by "+".
        preset: ``small``; ``further`` and ``last``, each from the weights of the one before or from ``start``;
            ``paper``, from SD-Turbo at ``start``.
        start: weights to start from, in place of the preset's.
        steps: weight updates, in place of the preset's.
        validate: score on validation streets at each checkpoint, with a picture.

    Raises:
        ConfigError: an input or the preset is unknown, or ``paper`` lacks its start.
    """

    folder: str
    real: str | None = None
    streets: int = 28
    inputs: str = "+".join(INPUTS)
    preset: str = "small"
    start: str | None = None
    steps: int | None = None
    validate: bool = False

    def __post_init__(self) -> None:
        # Checked here, because making the pairs takes hours before the network reads its inputs.
        unknown = sorted(set(self.inputs.split("+")) - set(INPUTS))
        if unknown:
            raise ConfigError(f"no input is called {' or '.join(unknown)}", remedy=f"Join by +: {', '.join(INPUTS)}.")
        if self.preset not in PRESETS:
            raise ConfigError(f"no preset is called {self.preset!r}", remedy=f"Known: {', '.join(PRESETS)}.")
        if self.preset == "paper" and self.start is None:
            raise ConfigError(
                "the paper's fixer starts from SD-Turbo",
                remedy="Give a folder with its vae and unet in diffusers' layout, or a hub id, by --start.",
            )
        if self.preset == "paper" and set(self.inputs.split("+")) != set(INPUTS):
            raise ConfigError("the paper's fixer is given all inputs", remedy="Leave out --inputs, or --preset paper.")

    @property
    def store(self) -> LocalStore:
        """Where scenes and pairs are kept."""
        return LocalStore(Path(self.folder) / "store")

    @property
    def run_folder(self) -> Path:
        """The training's own folder: its name tells inputs and preset, unless they are the usual ones."""
        # The usual training has the short name, under which the stages and the model card know it.
        parts = ["fnet"]
        if self.inputs != "+".join(INPUTS):
            parts.append(self.inputs)
        if self.preset != "small":
            parts.append(self.preset)
        return Path(self.folder) / "-".join(parts)

    @property
    def settings(self) -> TrainingSettings:
        """The preset's settings, with the job's length."""
        settings = PRESETS[self.preset]
        return settings if self.steps is None else replace(settings, steps=self.steps)

    @property
    def sd_turbo(self) -> str | None:
        """Where SD-Turbo is, for the preset that trains its adapters; ``None`` for the small network.

        Raises:
            InputError: the start begins with the home folder of somebody unknown.
        """
        if self.preset != "paper" or self.start is None:
            return None
        # A hub id is no path, and stays as it is.
        folder = expand_user_path(self.start)
        return str(folder) if folder.is_dir() else self.start

    @property
    def adapters_base(self) -> str | None:
        """How the adapters name SD-Turbo: its folder, or a hub id; ``None`` without adapters.

        An absolute path stays as it is, so that the adapters may be copied. A relative one becomes relative to them.
        """
        base = self.sd_turbo
        if base is None or not Path(base).is_dir() or Path(base).is_absolute():
            return base
        # A run reads it relative to the weights, whichever folder it is started in. Resolved, because `..` behind a
        # link leads elsewhere.
        return os.path.relpath(Path(base).resolve(), self.run_folder.resolve())

    @property
    def initial_weights(self) -> Path | None:
        """The small network's weights to start from; ``None`` for random weights.

        Raises:
            InputError: the start begins with the home folder of somebody unknown.
        """
        # The paper's network has another shape: it starts from SD-Turbo, not from a file of weights.
        if self.preset == "paper":
            return None
        if self.start is not None:
            return expand_user_path(self.start)
        if self.preset in STARTS_FROM:
            return replace(self, preset=STARTS_FROM[self.preset]).run_folder / WEIGHTS_FILE
        return None
