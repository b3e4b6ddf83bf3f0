"""Parameters of a scene that may be optimised together with the 14 attributes of its Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

# For types only: a scene without deforming actors must not import their code.
if TYPE_CHECKING:
    from genre_tasks.scene.deformation import Deformation
    from genre_tasks.scene.graph import SceneGraph


@dataclass(frozen=True)
class AuxiliaryParameters:
    """Present values of a scene's parameters beyond its Gaussians, as a render takes them.

    Attributes:
        deformation: how actors deform; ``None``: they are rigid.
        spherical_harmonics: [N, K, 3] coefficients of colours that depend on the view; ``None``: there are none.
    """

    deformation: Deformation | None = None
    spherical_harmonics: Tensor | None = None

    @staticmethod
    def from_scene(scene: SceneGraph) -> AuxiliaryParameters:
        """Takes the values that the scene has.

        Returns:
            AuxiliaryParameters: the scene's own deformation and coefficients, without copies.
        """
        return AuxiliaryParameters(scene.deformation, scene.spherical_harmonics)


NO_AUXILIARY = AuxiliaryParameters()
"""Rigid actors, and one colour for all views."""
