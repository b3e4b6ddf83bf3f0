"""The arguments of a training of GNet or ENet, and where its stages and their weights are found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from flows.training import checkpoint
from flows.training.device import choose_device
from flows.training.optimiser_training import CHECKPOINT_FILE, WEIGHTS_FILE
from flows.training.recipes import get_recipe
from flows.training.stage_recipe import SHIPPED, Stage
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.learned.weight_files import check_optimiser_files
from genre_tasks.weights import resolve_weights
from storage.local import LocalStore


@dataclass(frozen=True)
class TrainJob:
    """The arguments of a training: plain values.

    Attributes:
        folder: holds the store of scenes and a folder for each stage.
        recipe: name of the recipe.
        real: URI of a log whose chunk 0 is trained on, if any.
        novel: λ_novel of GNet; ``None`` for the recipe's.
        fnet: FNet's weights: a path, or ``builtin``.
        device: ``auto``, ``cpu`` or ``cuda``.
        save_every: weight updates between checkpoints.
        validate_every: weight updates between validations, each at the next checkpoint; 0 for none.
    """

    folder: str
    recipe: str = "shipped"
    real: str | None = None
    novel: float | None = None
    fnet: str = "builtin"
    device: str = "auto"
    save_every: int = 50
    validate_every: int = 0

    @property
    def store(self) -> LocalStore:
        """Where chunks, initial scenes, true views, scene starts and fixed images are kept."""
        return LocalStore(Path(self.folder) / "store")

    def stages(self) -> tuple[Stage, ...]:
        """Lists the recipe's stages.

        Returns:
            The stages in the order of training.
        """
        return get_recipe(self.recipe, self.novel)

    def choose_device(self) -> torch.device:
        """Chooses the device of all the recipe's stages.

        Returns:
            The device.

        Raises:
            ConfigError: the device is unknown or lacks something, or cannot render what a stage is trained on.
        """
        # One for all stages: those of a recipe are compared, and should differ in nothing else.
        return choose_device(self.device, any(stage.scenes.planned for stage in self.stages()))

    def weights_name(self, network: str) -> str:
        """Names the weights that a training makes.

        Args:
            network: ``gnet`` or ``enet``.

        Returns:
            The network; without λ_novel that is G3R, whose weights must not overwrite GNet's.

        >>> TrainJob("training", novel=0.0).weights_name("gnet")
        'g3r'
        """
        return "g3r" if network == "gnet" and self.novel == 0 else network

    def get_stage(self, name: str) -> Stage:
        """Finds a stage by its name.

        Args:
            name: for instance ``gnet/fine``.

        Returns:
            The stage.

        Raises:
            ConfigError: the recipe has no such stage.
        """
        # Looked up in the recipe as λ_novel changes it: G3R's stages have names of their own.
        found = {stage.name: stage for stage in self.stages()}
        if name not in found:
            raise ConfigError(f"the recipe {self.recipe} has no stage {name!r}", remedy=f"Known: {', '.join(found)}.")
        return found[name]

    def stage_weights(self, name: str) -> Path:
        """Finds the weights of a stage.

        Args:
            name: a stage of the recipe, or weights that ship, such as ``builtin:gnet``.

        Returns:
            The weights' path.

        Raises:
            InputError: the stage is not trained to its end, or its weights were deleted or damaged.
        """
        # Weights that ship were trained to their end, and have no checkpoint.
        if name.startswith(SHIPPED):
            return resolve_weights("gnet", name)
        folder = Path(self.folder) / name
        path = folder / CHECKPOINT_FILE
        network = name.split("/", maxsplit=1)[0]
        # G3R is GNet's training without λ_novel, and has no command of its own.
        command = "gnet --novel 0" if network == "g3r" else network
        remedy = f"Run `genre train {command} --stage {name}` with the same folder and recipe first."
        # Weights are written at every checkpoint, so that the file alone does not tell whether training is done.
        if not path.is_file():
            raise InputError(f"the stage {name} is not trained yet", remedy=remedy, file=path)
        described = checkpoint.describe(path)
        done = described["done"]
        steps = described["config"]["steps"]
        if done < steps:
            raise InputError(f"the stage {name} has made {done} of {steps} weight updates", remedy=remedy, file=path)
        weights = folder / WEIGHTS_FILE
        try:
            check_optimiser_files(weights)
        except (InputError, ConfigError) as error:
            # The command of the remedy takes them from the checkpoint.
            problem = f"weights of the stage {name} are missing or damaged"
            raise InputError(problem, remedy=remedy, file=error.file or weights) from error
        return weights
