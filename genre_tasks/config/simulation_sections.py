"""Section of re-simulation: how other behaviours may drive, and how their scenes are put together."""

from __future__ import annotations

from pydantic import Field

from genre_tasks.config.section import Section


class KinematicBounds(Section):
    """What a passenger car can do on a dry road; a path beyond any of these is no plausible one."""

    max_speed_m_s: float = Field(40.0, gt=0, le=200, description="Largest speed, m/s.")
    max_acceleration_m_s2: float = Field(4.0, gt=0, le=100, description="Largest forward acceleration, m/s².")
    max_deceleration_m_s2: float = Field(9.0, gt=0, le=100, description="Largest deceleration, m/s².")
    # Measured in emergency lane changes; comfortable driving stays below a third of it.
    max_jerk_m_s3: float = Field(30.0, gt=0, le=1000, description="Largest jerk along and across the path, m/s³.")
    max_lateral_acceleration_m_s2: float = Field(
        6.0, gt=0, le=100, description="Largest acceleration across the path, m/s²."
    )
    max_curvature_1_m: float = Field(
        0.2, gt=0, le=10, description="Largest curvature of the path, 1/m; a turning radius of 5 m by default."
    )


class SimulateConfig(Section):
    """Re-simulation: behaviours, hand-over between chunks, and what an edited actor gets (paper Sec. IV-C)."""

    bounds: KinematicBounds = Field(KinematicBounds(), description="What a path has to stay within.")
    start_offset_m: float = Field(
        3.0,
        ge=0,
        le=20,
        description="Metres to the left of the recorded path at which a behaviour starts; `--start-offset -3` is to "
        "the right.",
    )
    lane_m: float = Field(
        3.5, gt=0, le=20, description="Metres to the side of a lane change or a swerve at strength 1."
    )
    braking_m_s2: float = Field(4.0, gt=0, le=100, description="Deceleration of the behaviour brake at strength 1.")
    accelerating_m_s2: float = Field(
        2.5, gt=0, le=100, description="Acceleration of the behaviour accelerate at strength 1."
    )
    center_ahead_m: float | None = Field(
        None,
        ge=-10,
        le=10,
        description="Metres from the origin of the log's vehicle ahead to the middle of the car; null: as the log's "
        "dataset has it, and 0 for logs of your own.",
    )
    collision_margin_m: float = Field(
        0.0, ge=0, le=10, description="Boxes that come nearer than this count as overlapping, metres."
    )
    handover_frames: int = Field(
        5, ge=0, le=100, description="Frames over which the scene of a chunk fades into that of the next; 0: a cut."
    )
    contact_shadow: float = Field(
        0.5, ge=0, le=1, description="Darkness of the soft shadow under inserted and moved actors; 0: none."
    )
