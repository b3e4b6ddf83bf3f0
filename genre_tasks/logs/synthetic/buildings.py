"""Buildings: façades with recessed windows, shops, doors, sills, balconies, cornices and chimneys.

A building stands in its own frame: x along the façade from 0 to its width, y into the building, z up; the façade is
the plane y = 0 and looks towards −y.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from genre_tasks.logs.synthetic.facades import (
    BayGrid,
    Openings,
    Proportions,
    boxes_along_axes,
    build_panes,
    build_wall_around,
    lay_out_openings,
    stack_corners,
    upright_rectangles,
)
from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import Mesh, Surface, join_meshes, quad_mesh, wall_mesh
from genre_tasks.logs.types import Float64

Colour = tuple[float, float, float]

# In this order the wall is drawn; the shares add up to 1.
_WALL_SHARES = {Material.BRICK: 0.42, Material.PLASTER: 0.38, Material.PANEL: 0.2}
_WALL_COLOURS: dict[Material, tuple[Colour, ...]] = {
    Material.BRICK: (
        (0.62, 0.33, 0.26),
        (0.55, 0.40, 0.32),
        (0.70, 0.52, 0.40),
        (0.45, 0.30, 0.27),
        (0.74, 0.66, 0.55),
    ),
    Material.PLASTER: (
        (0.86, 0.80, 0.66),
        (0.80, 0.60, 0.45),
        (0.66, 0.72, 0.74),
        (0.88, 0.86, 0.82),
        (0.62, 0.70, 0.58),
        (0.85, 0.72, 0.70),
    ),
    Material.PANEL: ((0.66, 0.64, 0.60), (0.52, 0.53, 0.55), (0.76, 0.70, 0.60)),
}
_FRAME_COLOURS: tuple[Colour, ...] = ((0.90, 0.90, 0.88), (0.25, 0.22, 0.20), (0.32, 0.20, 0.13), (0.25, 0.36, 0.30))
# Railings.
_METAL = Surface(Material.METAL, (0.15,) * 3)
# Walls reach so far into the ground, which may slope.
_SINK_M = 1.5
_DOORSTEP_M = 0.1
_GROUND_RECESS_M = 0.2
_MAX_COLOUR = 0.95


@dataclass(frozen=True)
class _Style:
    """Colours and proportions of one building.

    Attributes:
        wall: material of the façade.
        tone: [3] sRGB of the wall.
        trim: [3] sRGB of cornice, sills and lintels.
        frame: sRGB of window frames.
        parameters: of the wall's texture.
        ground_m: height of the ground floor.
        storey_m: height of the other floors.
        floors: how many there are above the ground floor.
        bays: columns of windows.
        bay_m: width of a bay.
    """

    wall: Material
    tone: Float64
    trim: Float64
    frame: Colour
    parameters: tuple[float, ...]
    ground_m: float
    storey_m: float
    floors: int
    bays: int
    bay_m: float

    @property
    def top_m(self) -> float:
        """Height of the eaves."""
        return self.ground_m + self.floors * self.storey_m

    def wall_surface(self, shade: float = 1.0) -> Surface:
        """The wall, its colour multiplied by ``shade``."""
        return Surface(self.wall, self.tone * shade, self.parameters)


def build_building(rng: np.random.Generator, width: float, height: float, depth: float) -> Mesh:
    """Builds one building of a random style.

    Args:
        rng: draws the style.
        width: of the façade, metres.
        height: about how high it becomes, in complete floors, metres.
        depth: metres.

    Returns:
        The building, from x = 0 to its width.
    """
    style = _draw_style(rng, width, height)
    top = style.top_m
    parts = [_build_upper_floors(rng, style)]
    parts.append(_build_ground_floor(rng, style))
    parts.append(_build_shell(width, depth, style))
    eave = rng.uniform(0.15, 0.5)
    cornice = Surface(style.wall, style.trim, style.parameters)
    cornice_top = top + rng.uniform(0.25, 0.8)
    parts.append(wall_mesh((-0.05, -eave, top - 0.1), (width + 0.05, 0.3, cornice_top), cornice))
    belt = Surface(Material.PLASTER, style.trim, style.parameters)
    parts.append(wall_mesh((0, -0.1, style.ground_m - 0.18), (width, 0.05, style.ground_m + 0.05), belt))
    chimneys = int(rng.integers(0, 4))
    x = rng.uniform(1, width - 2, chimneys)
    y = rng.uniform(1, max(1.5, depth - 3), chimneys)
    if chimneys:
        low = np.stack([x, y, np.full(chimneys, top)], 1)
        parts.append(wall_mesh(low, np.add(low, [1.1, 1.1, 1.9]), Surface(Material.BRICK, (0.5, 0.35, 0.3))))
    return join_meshes(parts)


def _draw_style(rng: np.random.Generator, width: float, height: float) -> _Style:
    wall = list(_WALL_SHARES)[rng.choice(len(_WALL_SHARES), p=tuple(_WALL_SHARES.values()))]
    colours = _WALL_COLOURS[wall]
    tone = np.clip(np.array(colours[rng.integers(len(colours))]) * rng.uniform(0.85, 1.1), 0, _MAX_COLOUR)
    frame = _FRAME_COLOURS[rng.integers(len(_FRAME_COLOURS))]
    # Darker or brighter than the wall, never of another hue.
    trim = np.clip(tone * rng.choice([0.72, 1.2]), 0, _MAX_COLOUR)
    parameters = (0.0, 0.0, rng.uniform(0, 100), 0.0)
    ground_m = rng.uniform(3.5, 4.3)
    storey_m = rng.uniform(2.85, 3.3)
    bays = max(2, round(width / rng.uniform(2.3, 3.4)))
    return _Style(
        wall=wall,
        tone=tone,
        trim=trim,
        frame=frame,
        parameters=parameters,
        ground_m=ground_m,
        storey_m=storey_m,
        # Complete floors, so a building is a little higher or lower than asked for.
        floors=max(1, round((height - ground_m) / storey_m)),
        bays=bays,
        bay_m=width / bays,
    )


def _build_shell(width: float, depth: float, style: _Style) -> Mesh:
    """Side walls, back and roof."""
    bottom = -_SINK_M
    top = style.top_m
    walls = []
    texture = []
    for (x0, y0), (x1, y1) in (((0, 0), (0, depth)), ((width, 0), (width, depth)), ((0, depth), (width, depth))):
        # No wall at y = 0: that is the façade.
        walls.append([[x0, y0, bottom], [x1, y1, bottom], [x1, y1, top], [x0, y0, top]])
        length = float(np.hypot(x1 - x0, y1 - y0))
        texture.append([[0, bottom, 0], [length, bottom, 0], [length, top, 0], [0, top, 0]])
    roof = [[[0, 0, top], [width, 0, top], [width, depth, top], [0, depth, top]]]
    return join_meshes(
        [
            quad_mesh(walls, texture, style.wall_surface(0.92)),
            quad_mesh(roof, None, Surface(Material.ROOF, (0.35, 0.33, 0.32))),
        ]
    )


def _build_upper_floors(rng: np.random.Generator, style: _Style) -> Mesh:
    """Walls with windows and sills, and on some buildings lintels and balconies."""
    recess = float(rng.uniform(0.10, 0.30))
    sizes = Proportions(width=rng.uniform(0.38, 0.66), sill=rng.uniform(0.2, 0.32), lintel=rng.uniform(0.76, 0.88))
    grid = BayGrid(style.bays, style.bay_m, floors=style.floors, base_m=style.ground_m, storey_m=style.storey_m)
    openings = lay_out_openings(grid, sizes)
    left = openings.left
    right = openings.right
    trim = Surface(Material.PLASTER, style.trim)
    parts = [
        build_wall_around(openings, style.wall_surface(), recess),
        build_panes(rng, openings, Material.WINDOW, style.frame, recess),
    ]
    sill_z = (openings.bottom - 0.1, openings.bottom)
    parts.append(boxes_along_axes((left - 0.1, right + 0.1), (-0.12, 0.05), sill_z, trim))
    if rng.random() < 0.4:
        lintel_z = (openings.top, openings.top + 0.22)
        parts.append(boxes_along_axes((left - 0.12, right + 0.12), (-0.06, 0.05), lintel_z, trim))
    if rng.random() < 0.4:
        # Balconies lie above each other, in a third of the bays.
        bays = rng.choice(style.bays, max(1, style.bays // 3), replace=False)
        with_balcony = np.isin(np.arange(len(openings)) % style.bays, bays)
        parts.append(_build_balconies(openings.select(with_balcony)))
    return join_meshes(parts)


def _build_balconies(openings: Openings) -> Mesh:
    """A slab and a railing of eight bars before every opening."""
    left = openings.left - 0.25
    right = openings.right + 0.25
    floor = openings.bay_bottom + 0.05
    concrete = Surface(Material.PLASTER, (0.6,) * 3)
    slab = boxes_along_axes((left, right), (-0.95, 0), (floor, floor + 0.14), concrete)
    rail = boxes_along_axes((left, right), (-0.95, -0.90), (floor + 1.0, floor + 1.06), _METAL)
    x = (left[:, None] + (right - left)[:, None] * np.linspace(0, 1, 8)).ravel()
    z = floor.repeat(8)
    bars = boxes_along_axes((x - 0.015, x + 0.015), (-0.94, -0.91), (z, z + 1.0), _METAL)
    return join_meshes([slab, rail, bars])


def _build_ground_floor(rng: np.random.Generator, style: _Style) -> Mesh:
    """Shops or flats, with a door in one of the bays."""
    has_shops = rng.random() < 0.5
    if has_shops:
        sizes = Proportions(width=0.84, sill=0.1, lintel=0.74)
    else:
        sizes = Proportions(width=rng.uniform(0.36, 0.5), sill=0.3, lintel=0.78)
    grid = BayGrid(style.bays, style.bay_m, floors=1, base_m=0.0, storey_m=style.ground_m)
    openings = lay_out_openings(grid, sizes)
    door = int(rng.integers(style.bays))
    # The door takes the place of a window or shop, and reaches down to the step.
    is_door = np.arange(style.bays) == door
    openings = replace(openings, bottom=np.where(is_door, _DOORSTEP_M, openings.bottom))
    doorway = openings.select(is_door)
    windows = openings.select(~is_door)
    recess = _GROUND_RECESS_M
    parts = [build_wall_around(openings, style.wall_surface(0.8 if has_shops else 0.95), recess)]
    glass = Material.SHOP if has_shops else Material.WINDOW
    parts.append(build_panes(rng, windows, glass, style.frame, recess))
    leaf = upright_rectangles(doorway.left, doorway.right, doorway.bottom, doorway.top, recess)
    parts.append(quad_mesh(leaf, None, Surface(Material.WOOD, rng.uniform(0.12, 0.55, 3))))
    plinth = Surface(Material.PANEL, style.tone * 0.6)
    parts.append(wall_mesh((0, -0.04, -_SINK_M), (style.bays * style.bay_m, 0.0, 0.35), plinth))
    stone = Surface(Material.KERB, (0.6, 0.6, 0.6))
    parts.append(boxes_along_axes((doorway.left - 0.1, doorway.right + 0.1), (-0.4, 0), (-0.2, 0.24), stone))
    if has_shops:
        parts += _build_shop_fittings(rng, windows, style.ground_m)
    return join_meshes(parts)


def _build_shop_fittings(rng: np.random.Generator, windows: Openings, height: float) -> list[Mesh]:
    """A lettered band above, and awnings over some bays."""
    band_colour = rng.uniform(0.1, 0.8, 3)
    band_z = (windows.top + 0.08, height - 0.2)
    band = boxes_along_axes((windows.left, windows.right), (-0.08, 0.0), band_z, Surface(Material.PLAIN, band_colour))
    # Nine places for letters over every window, some of them empty.
    window, place = np.nonzero(rng.random((len(windows), 9)) < 0.75)
    pitch = ((windows.right - windows.left) / 11)[window]
    x = windows.left[window] + pitch * (place + 1.2)
    z = (windows.top + 0.08 + height - 0.2)[window] / 2
    half_height = rng.uniform(0.07, 0.14, len(window))
    lettering = Surface(Material.PLAIN, 1.0 - band_colour)
    letters = boxes_along_axes((x, x + pitch * 0.6), (-0.12, -0.08), (z - half_height, z + half_height), lettering)
    parts = [band, letters]
    with_awning = rng.random(len(windows)) < 0.5
    if with_awning.any():
        shaded = windows.select(with_awning)
        wall_y = np.zeros_like(shaded.left)
        edge_y = np.full_like(shaded.left, -1.1)
        upper = shaded.top + 0.1
        lower = shaded.top - 0.5
        corners = stack_corners(
            [
                (shaded.left, wall_y, upper),
                (shaded.right, wall_y, upper),
                (shaded.right, edge_y, lower),
                (shaded.left, edge_y, lower),
            ]
        )
        parts.append(quad_mesh(corners, None, Surface(Material.AWNING, rng.uniform(0.1, 0.7, 3))))
    return parts
