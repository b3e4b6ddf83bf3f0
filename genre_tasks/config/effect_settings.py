"""The section ``effects``: which parts of the forward model a scene gets."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from genre_tasks.config.section import Section


def _restore_word(value: object) -> object:
    # Readers of YAML 1.1, such as Prefect's of deployments, take the words on and off for true and false.
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else value


# The validator runs before pydantic checks the words.
EffectSetting = Annotated[Literal["auto", "on", "off"], BeforeValidator(_restore_word)]
"""on, off, or auto: as the measured property of the log decides."""

ReportOnlySetting = Annotated[Literal["auto", "off"], BeforeValidator(_restore_word)]
"""Of an effect that is measured and reported but not modelled: it cannot be set on."""


class EffectsConfig(Section):
    """Parts of the forward model that a scene may or may not need: on, off, or auto, as its plan decides.

    ``effects=none`` (or ``auto``, ``on``, ``off``) sets them all; ``on`` sets those that are modelled.
    """

    pose_refinement: EffectSetting = Field(
        "auto", description="Recorded camera poses err; images and LiDAR tell by how much."
    )
    rigid_actors: EffectSetting = Field("auto", description="Moving vehicles get Gaussians that move with their box.")
    nonrigid_actors: EffectSetting = Field("auto", description="Pedestrians and cyclists change their shape.")
    distant_region: EffectSetting = Field(
        "auto", description="Gaussians for what LiDAR does not reach and parallax does not move."
    )
    multi_view_stereo: EffectSetting = Field(
        "auto", description="Surfaces that LiDAR does not reach get points from several images of them."
    )
    rolling_shutter: EffectSetting = Field(
        "auto", description="Rows of an image are read out one after another while the camera moves."
    )
    lens_distortion: EffectSetting = Field("auto", description="Straight lines are curved in the image.")
    exposure: EffectSetting = Field("auto", description="Exposure and white balance differ between images.")
    motion_blur: EffectSetting = Field("auto", description="The camera moves while an image is exposed.")
    view_dependent_colour: EffectSetting = Field(
        "auto", description="Colours change with the direction they are seen from, as spherical harmonics."
    )
    lidar_depth: EffectSetting = Field("auto", description="The loss has a term of LiDAR depth.")
    anti_aliasing: EffectSetting = Field(
        "auto", description="Opacity makes up for the blur of footprints that are smaller than a pixel."
    )
    ego_mask: EffectSetting = Field("auto", description="Pixels that show the recording vehicle itself have no loss.")
    darkness: ReportOnlySetting = Field("auto", description="Images of the night; reported, not modelled.")
