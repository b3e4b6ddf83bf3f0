"""Pedestrians: people whose legs, and arms if asked for, swing as they walk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import SIDES, Surface, box_mesh, ellipsoid_mesh, join_meshes, tube_mesh
from genre_tasks.logs.synthetic.street_actors import Part, PoseAt
from genre_tasks.logs.types import Float64

# 24°.
_LEG_SWING_RAD = 0.42
# A leg's swing to and fro covers so many times the person's height.
_STEP_LENGTH = 0.85


@dataclass(frozen=True)
class _Walk:
    """How a person moves their limbs.

    Attributes:
        pace: speed in m/s; 0 stands still.
        stride: arms swing against the legs, by so many times the legs' angle; beyond 1 the legs do too. At 0 the arms
            are part of the torso.
        height: of the person, metres.
    """

    pace: float
    stride: float
    height: float


def build_pedestrian(
    rng: np.random.Generator, pace: float, stride: float = 0.0
) -> tuple[tuple[Part, ...], tuple[float, float, float]]:
    """Builds a torso with head and arms, and two legs.

    Args:
        rng: draws height and colours.
        pace: walking speed, m/s; 0 stands still.
        stride: how far arms and legs swing, as a multiple of 24°; 0: arms are still.

    Returns:
        The parts, and length, width and height of the person's box.
    """
    height = rng.uniform(1.55, 1.9)
    # All draws come first and in this order, whatever the person does: a seed keeps its people.
    coat_colour = rng.uniform(0.08, 0.8, 3)
    trousers_colour = rng.uniform(0.05, 0.45, 3)
    skin_colour = np.array([0.80, 0.60, 0.48]) * rng.uniform(0.5, 1.1)
    is_striped = float(rng.random() < 0.4)
    hair_colour = rng.uniform(0.02, 0.4, 3)
    coat = Surface(Material.CLOTH, coat_colour, (is_striped, 0.0, 0.0, 0.0))
    trousers = Surface(Material.CLOTH, trousers_colour)
    walk = _Walk(pace, stride, height)
    hip = height * 0.5
    shoulder = height * 0.84
    spine = [[0.0, 0.0, hip - 0.06], [0.0, 0.0, shoulder - 0.16], [0.0, 0.0, shoulder]]
    head = Surface(Material.PLAIN, skin_colour)
    hair = Surface(Material.PLAIN, hair_colour)
    body = [
        tube_mesh(spine, [0.16, 0.21, 0.1], 10, coat),
        ellipsoid_mesh((0.01, 0, height - 0.12), (0.1, 0.085, 0.12), head),
        ellipsoid_mesh((-0.02, 0, height - 0.075), (0.105, 0.095, 0.09), hair),
    ]
    limbs = []
    for side in SIDES:
        if stride:
            limbs.append(_build_arm(walk, side, coat))
        else:
            path = [[0.02, side * 0.22, shoulder - 0.05], [0.1 * side, side * 0.28, hip]]
            body.append(tube_mesh(path, [0.06, 0.045], 6, coat))
    for side in SIDES:
        limbs.append(_build_leg(walk, side, trousers))
    return (Part(join_meshes(body)), *limbs), (0.75, 0.68, height)


def _build_arm(walk: _Walk, side: int, coat: Surface) -> Part:
    """An arm that swings against the leg of its side; its frame's origin is the shoulder."""
    hip = walk.height * 0.5
    top = walk.height * 0.84
    path = [[0.0, 0.0, 0.0], [0.0, side * 0.06, hip - top + 0.05]]
    swing = _swing_about((0.02, side * 0.22, top - 0.05), -side * walk.stride, walk)
    return Part(tube_mesh(path, [0.06, 0.045], 6, coat), swing)


def _build_leg(walk: _Walk, side: int, trousers: Surface) -> Part:
    """A leg with its shoe; its frame's origin is the hip."""
    hip = walk.height * 0.5
    path = [[0.0, 0.0, 0.02], [0.0, 0.0, -hip * 0.5], [0.0, 0.0, -hip + 0.06]]
    shoe = Surface(Material.PLAIN, (0.1, 0.08, 0.07))
    leg = join_meshes(
        [
            tube_mesh(path, [0.09, 0.07, 0.05], 8, trousers),
            box_mesh((-0.07, -0.045, -hip), (0.17, 0.045, -hip + 0.09), shoe),
        ]
    )
    return Part(leg, _swing_about((0.0, side * 0.09, hip), side * max(1.0, walk.stride), walk))


def _swing_about(joint: tuple[float, float, float], amplitude: float, walk: _Walk) -> PoseAt:
    """Poses of a limb that swings about the axis to the left through a joint, ``amplitude`` times a leg's 24°."""

    def pose(times: Float64) -> Float64:
        # Without a pace there is no period to divide by.
        if walk.pace:
            rate_rad_s = 2 * np.pi * walk.pace / (_STEP_LENGTH * walk.height)
            angle = amplitude * _LEG_SWING_RAD * np.sin(rate_rad_s * times)
        else:
            angle = np.zeros_like(times)
        # A turn about y, the axis to the left.
        out = np.zeros((len(times), 4, 4))
        out[:, 0, 0] = np.cos(angle)
        out[:, 0, 2] = np.sin(angle)
        out[:, 1, 1] = 1
        out[:, 2, 0] = -np.sin(angle)
        out[:, 2, 2] = np.cos(angle)
        out[:, :3, 3] = joint
        out[:, 3, 3] = 1
        return out

    return pose
