"""Colour that depends on where it is seen from: real spherical harmonics (Kerbl et al. 2023, Sec. 4).

A Gaussian's colour, seen along the unit direction d from the camera's centre to its mean, is max(c + Σ h_k Y_k(d), 0).
Signs and order are those of 3DGS and gsplat, without the constant term, which is the colour c itself. Harmonics of an
actor's Gaussians are in its box frame, as its means are: seen from the camera's place in that frame they turn with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from genre_tasks.logs.types import Float64
from genre_tasks.scene.graph import COUNTS, DEGREE, FIRST_ACTOR, SceneGraph

NEAREST_M = 0.01
"""Nothing nearer is drawn; down to zero distance the direction's length falls below 1, and all stays finite."""

_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def starting(scene: SceneGraph, degree: int = DEGREE) -> SceneGraph:
    """The scene with harmonics of that degree, all zero, if it has none yet."""
    if scene.harmonics is not None:
        return scene
    return scene.with_harmonics(scene.gaussians.means.new_zeros(len(scene), COUNTS[degree], 3))


def basis(d: Tensor, count: int) -> list[Tensor]:
    """The first ``count`` (3, 8 or 15) harmonics Y_k of directions [..., 3], each [...]; polynomials in d.

    Raises ``ValueError`` for another count.
    """
    if count not in COUNTS.values():
        raise ValueError(f"expected {', '.join(map(str, COUNTS.values()))} harmonics, got {count}")
    x, y, z = d.unbind(-1)
    out = [-_C1 * y, _C1 * z, -_C1 * x]
    if count > 3:
        a, b, c = _C2
        xx, yy, zz = x * x, y * y, z * z
        out += [a * (x * y), -a * (y * z), b * (2 * zz - xx - yy), -a * (x * z), c * (xx - yy)]
    if count > 8:
        a, b, c, e, f = _C3
        out += [-a * (y * (3 * xx - yy)), b * (x * y * z), -c * (y * (4 * zz - xx - yy))]
        out += [e * (z * (2 * zz - 3 * xx - 3 * yy)), -c * (x * (4 * zz - xx - yy))]
        out += [f * (z * (xx - yy)), -a * (x * (xx - 3 * yy))]
    return out


def shown_colors(
    eyes: Tensor,  # [N, 3] or [3] metres: the camera's centre
    means: Tensor,  # [N, 3] metres, in the eyes' frame
    colors: Tensor,  # [N, 3]
    harmonics: Tensor,  # [N, K, 3]
) -> Tensor:
    """Colours [N, 3] as a camera at ``eyes`` sees them, at least 0; differentiable in the Gaussians.

    Those that are not finite get NaN, which no renderer draws, and pass no gradient.
    """
    sound = torch.isfinite(means).all(1) & torch.isfinite(harmonics).flatten(1).all(1)
    means = torch.where(sound[:, None], means, torch.zeros_like(means))
    harmonics = torch.where(sound[:, None, None], harmonics, torch.zeros_like(harmonics))
    away = means - eyes
    x, y, z = away.unbind(1)
    distance = (x * x + y * y + z * z).clamp_min(NEAREST_M**2).sqrt()
    out = colors
    for k, value in enumerate(basis(away / distance[:, None], harmonics.shape[1])):
        out = out + value[:, None] * harmonics[:, k]
    return torch.where(sound[:, None], out.clamp_min(0), torch.full_like(out, torch.nan))


def colors_by_view(scene: SceneGraph, frames: Sequence[float], centres: Float64) -> Tensor:
    """[V, S + F · M, 3] of views at log frames with cameras at ``centres`` [V, 3], laid out as ``SceneGraph.posed``.

    A view's colours of actors at other views' frames are 0: it does not show them. Raises ``ValueError`` for a scene
    without harmonics.
    """
    g, harmonics = scene.gaussians, scene.harmonics
    if harmonics is None:
        raise ValueError("expected a scene with harmonics, got one without")
    distinct = list(dict.fromkeys(frames))
    moves = scene.nodes >= FIRST_ACTOR if scene.actors else torch.zeros_like(scene.nodes, dtype=torch.bool)
    order = torch.argsort(moves.to(torch.uint8), stable=True)
    moving = int(moves.sum())
    still = len(scene) - moving
    owner = (scene.nodes[order][still:] - FIRST_ACTOR).clamp_min(0)
    parts = [t.index_select(0, order) if moving else t for t in (g.means, g.colors, harmonics)]
    rotation, translation, _ = scene.actor_poses(frames)
    out = []
    for v, frame in enumerate(frames):
        centre = torch.as_tensor(centres[v]).to(g.means)
        in_boxes = ((centres[v] - translation[v])[:, None] @ rotation[v])[:, 0]  # Rᵀ (centre − t)
        eyes = torch.cat([centre.expand(still, 3), torch.as_tensor(in_boxes).to(g.means)[owner].view(-1, 3)])
        seen = shown_colors(eyes, *parts)
        before = distinct.index(frame) * moving
        after = (len(distinct) - 1) * moving - before if moving else 0
        pad = [seen.new_zeros(n, 3) for n in (before, after)]
        out.append(torch.cat([seen[:still], pad[0], seen[still:], pad[1]]) if moving else seen)
    return torch.stack(out)
