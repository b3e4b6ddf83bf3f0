"""The groups of parameters that one optimisation moves: Gaussians, actors' deformation, spherical harmonics.

The loop knows a group by three things: what it adds to a render, how it takes a step, and how it is written back to
the scene. Another group (camera poses, exposure) would need no change of the loop.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.optimiser.auxiliary import AuxiliaryParameters
from genre_tasks.optimiser.gradients import Gradients
from genre_tasks.optimiser.state import Parameterization, State
from genre_tasks.optimiser.step_rules import StepFunction
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph

if TYPE_CHECKING:
    from genre_tasks.scene.deformation import Deformation


class ParameterGroup(Protocol):
    """Parameters that move together in each iteration."""

    def contribute(self, auxiliary: AuxiliaryParameters) -> AuxiliaryParameters:
        """Adds the group's present values to what is rendered.

        Args:
            auxiliary: what the groups before it contribute.

        Returns:
            AuxiliaryParameters: with this group's values.
        """
        ...

    def apply(self, gradients: Gradients, iteration: int, total: int) -> None:
        """Takes one step; it may shift the Gaussians' colours too.

        Args:
            gradients: of this iteration.
            iteration: from 0.
            total: T, the length of the schedule; iterations may go beyond it.
        """
        ...

    def write_back(self, scene: SceneGraph) -> SceneGraph:
        """Puts the group's present values into a scene.

        Args:
            scene: with the values of the groups before it.

        Returns:
            SceneGraph: with this group's values, detached.
        """
        ...


class GaussianGroup:
    """The 14 attributes of the Gaussians, moved by a step rule.

    Args:
        parameterization: the scene at its start, and the units of the offsets.
        step_function: the step rule, prepared for this scene.

    Attributes:
        parameterization: as given.
        step_function: as given; meta-training replaces it when the network's weights change.
        state: offsets and moments after the steps so far.
    """

    def __init__(self, parameterization: Parameterization, step_function: StepFunction) -> None:
        scene = parameterization.scene
        self.parameterization = parameterization
        self.step_function = step_function
        # Moments start with the scene: a split changes the number of rows, so a second part has new ones.
        self.state = State.zeros(len(scene), scene.gaussians.means)

    def contribute(self, auxiliary: AuxiliaryParameters) -> AuxiliaryParameters:
        """Adds nothing: a render takes the offsets themselves."""
        return auxiliary

    def apply(self, gradients: Gradients, iteration: int, total: int) -> None:
        """Takes the gradient into the moments, asks the step rule, and moves what the views saw.

        Args:
            gradients: of this iteration.
            iteration: not used; the state counts its own steps.
            total: T, the length of the schedule.
        """
        # One assignment per line, so that each state's tensors are freed before the next one's are allocated.
        self.state = self.state.accumulate(gradients.gaussians, gradients.image_residuals)
        delta = self.step_function(self.state, gradients.gaussians, total)
        self.state = self.state.apply_step(self.parameterization, delta)

    def shift_colors(self, shift: Tensor) -> None:
        """Moves the colours by ``shift`` [N, 3]; spherical harmonics ask for it."""
        self.state = self.state.shift_colors(shift)

    def write_back(self, scene: SceneGraph) -> SceneGraph:
        """Puts the present Gaussians into a scene."""
        # One tensor for all attributes: the scene's five are views of it, and detached at once.
        packed = self.parameterization.gaussians_at(self.state.offsets).pack().detach()
        return scene.with_gaussians(Gaussians.unpack(packed))

    def check_finite(self, stage: str) -> None:
        """Stops an optimisation whose step has left the finite numbers.

        Args:
            stage: name of the stage, for the message.

        Raises:
            NonFiniteError: an offset is NaN or infinite.
        """
        check_finite(self.state.offsets, "updated Gaussians", stage)


class FixedDeformation:
    """The deformation of a scene's actors, rendered and not optimised.

    Args:
        deformation: as the scene has it.
    """

    def __init__(self, deformation: Deformation) -> None:
        self._deformation = deformation

    def contribute(self, auxiliary: AuxiliaryParameters) -> AuxiliaryParameters:
        """Adds the deformation to what is rendered."""
        return replace(auxiliary, deformation=self._deformation)

    def apply(self, gradients: Gradients, iteration: int, total: int) -> None:
        """Moves nothing."""

    def write_back(self, scene: SceneGraph) -> SceneGraph:
        """Leaves the scene as it is: it has the deformation already."""
        return scene


def create_auxiliary_groups(gaussians: GaussianGroup, fit_deformation: bool) -> list[ParameterGroup]:
    """Creates the groups for what a scene has beyond its Gaussians.

    Args:
        gaussians: of the scene; spherical harmonics shift their colours.
        fit_deformation: actors' deformation is optimised; otherwise it stays as the scene has it.

    Returns:
        A group for the deformation and one for the spherical harmonics, where the scene has them.
    """
    scene = gaussians.parameterization.scene
    # The order is that of the steps; the Gaussians come before all of these.
    groups: list[ParameterGroup] = []
    # A scene without a feature does not import the feature's code.
    if scene.deformation is not None and fit_deformation:
        from genre_tasks.optimiser.deformation_optimiser import DeformationGroup

        groups.append(DeformationGroup(scene.deformation))
    elif scene.deformation is not None:
        groups.append(FixedDeformation(scene.deformation))
    if scene.spherical_harmonics is not None:
        from genre_tasks.optimiser.sh_optimiser import ShGroup

        groups.append(ShGroup(scene.spherical_harmonics, gaussians.shift_colors))
    return groups
