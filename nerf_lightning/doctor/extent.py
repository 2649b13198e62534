"""Checks of near, far and the box against cameras and content."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.doctor.check import MORE_DETAILS, Analysis, Check, look, not_judged, ok, wrong
from nerf_lightning.doctor.epipolar import distances, parallax, places
from nerf_lightning.nerf.geometry.boxes import distances_in_box
from nerf_lightning.nerf.geometry.cameras import rays_through_pixels, seen_at
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.geometry.world_frame import unit_of
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import Scene

# Rays that meet at a smaller angle (radians) say little about distances.
LEAST_PARALLAX = 0.04
FEWEST = 50
# Share of the content that may be cut off: a few matches and points are mistakes.
FEW, MANY = 0.03, 0.15
# A grid of GRID x GRID pixels is examined in each view.
GRID = 12
# Maximum number of sparse points, and of views, that are examined.
MOST_POINTS, MOST_VIEWS = 5000, 200
UNITS = {"inches": 39.37, "feet": 3.281, "centimeters": 100.0, "millimeters": 1000.0}


def near_and_far(analysis: Analysis) -> Check:
    """Judge whether content is between near and far."""
    scene = analysis.scene
    found = content_distances(analysis)
    if found is None:
        return not_judged("no sparse points, and too few details were found again", MORE_DETAILS)
    view, distance = found
    unit = unit_of(scene.to_user.double())
    if scene.space == "ndc":
        before = float((distance < 1.0).float().mean())
        if before <= FEW:
            return ok(f"{100 * (1 - before):.0f} % of the content lies beyond the near plane (NDC)")
        return (wrong if before > MANY else look)(
            f"{100 * before:.0f} % of the content lies in front of the near plane of the normalized device coordinates",
            f"Set scene.near to about {0.9 * float(distance.quantile(0.01)) * unit:.3g} (it is {unit:.3g}).",
        )
    before = float((distance < scene.near[view]).float().mean())
    beyond = float((distance > scene.far[view]).float().mean())
    low, high = (unit * float(distance.quantile(share)) for share in (0.01, 0.99))
    near, far = unit * float(scene.near.median()), unit * float(scene.far.median())
    message = f"content lies {low:.3g} to {high:.3g} from the cameras; near is {near:.3g} and far {far:.3g}"
    if max(before, beyond) <= FEW:
        return ok(message)
    cut = f"{100 * before:.0f} % of it in front of near and {100 * beyond:.0f} % behind far"
    cure = f"Set scene.near={0.8 * low:.2g} scene.far={1.3 * high:.3g}.{_units(low, high, near, far)}"
    # Values that the user has not typed are this program's guesses, which are never reported as wrong.
    serious = max(before, beyond) > MANY and (scene.space == "bounded" or scene.protocol.keys() & {"near", "far"})
    return (wrong if serious else look)(f"{message}: {cut}", cure)


def content_distances(analysis: Analysis) -> tuple[Tensor, Float[Tensor, "content"]] | None:
    """Return views and distances of the content that they show (scene units; in NDC: depth before warping).

    From matched details, or if these are few, from the known distances or the sparse points.
    """
    scene, matches = analysis.scene, analysis.matches
    good = clear_matches(analysis)
    if int(good.sum()) >= FEWEST and analysis.agreement > 0.3:
        if scene.space == "ndc":
            return matches.view[good, 0], -places(matches, scene.cameras.c2w)[good, 2]
        return matches.view[good].flatten(), distances(matches, scene.cameras.c2w)[good].flatten()
    if scene.space == "ndc":
        few = len(scene.points) < FEWEST
        return None if few else (torch.zeros(len(scene.points), dtype=torch.long), -scene.points[:, 2])
    if scene.depths is not None and len(scene.depths) >= FEWEST:
        return scene.depths.pixels.view, scene.depths.distance
    return _in_pictures(scene)


def _in_pictures(scene: Scene) -> tuple[Tensor, Float[Tensor, "content"]] | None:
    """Return views and the distances of the sparse points in their pictures; None if there are few."""
    points = scene.points[:: 1 + len(scene.points) // MOST_POINTS]
    views, found = [], []
    for view in evenly_spaced_subset(range(len(scene.view_names)), MOST_VIEWS):
        inside, _, _ = seen_at(scene.cameras, view, points)
        found.append((points[inside] - scene.cameras.c2w[view, :, 3]).norm(dim=-1))
        views.append(torch.full((len(found[-1]),), view))
    distance = torch.cat(found)
    return (torch.cat(views), distance) if len(distance) >= FEWEST else None


def clear_matches(analysis: Analysis) -> Bool[Tensor, "matches"]:
    """Return which matches determine their world position."""
    return analysis.agrees & (parallax(analysis.matches, analysis.scene.cameras.c2w) > LEAST_PARALLAX)


def box_in_view(analysis: Analysis) -> Check:
    """Judge whether every view's rays meet the modeled box between near and far."""
    scene = analysis.scene
    if scene.space != "bounded":
        return ok(f"space is {scene.space}: no box bounds the content")
    shares = torch.stack([_share_in_box(scene, view) for view in range(len(scene.view_names))])
    blind = (shares < 0.02).nonzero()[:, 0].tolist()
    message = f"{100 * float(shares.median()):.0f} % of a view's rays pass the box (median)"
    if not blind:
        return ok(message)
    cure = (
        "The cameras do not look at the box, or near and far miss it: check the axes of the poses, center the capture "
        "on its content, or set near, far and the box (scene.aabb_half)."
    )
    message += f"; {len(blind)} views miss it, such as {analysis.named(blind[:3])}"
    return (wrong if len(blind) > 0.3 * len(shares) else look)(message, cure)


def scale(analysis: Analysis) -> Check:
    """Judge the size of the capture against what is modeled."""
    scene = analysis.scene
    centers = scene.cameras.c2w[:, :, 3]
    middle = scene.aabb.mean(dim=0)
    away = float((centers - middle).norm(dim=-1).median())
    half = float((scene.aabb[1] - scene.aabb[0]).max()) / 2
    if scene.space != "bounded":
        return ok(f"rescaled internally: one unit is {unit_of(scene.to_user.double()):.3g} capture units")
    inside = ((centers > scene.aabb[0]) & (centers < scene.aabb[1])).all(dim=-1)
    message = f"cameras stand {away:.3g} from the middle of a box that reaches {half:.3g}"
    if bool(inside.float().mean() > 0.3):
        cure = "Make the scene larger than the box or the box smaller (scene.aabb_half), or use scene.space=contracted."
        return wrong(message + ": they are inside it", cure)
    if away > 30 * half:
        cure = "Scale the camera centers down, or make the box larger (scene.aabb_half), with near and far to match."
        return wrong(message + ": the content would be a dot in their pictures", cure)
    return _content_in_box(analysis, message)


def _content_in_box(analysis: Analysis, message: str) -> Check:
    scene = analysis.scene
    good = clear_matches(analysis)
    if int(good.sum()) < FEWEST:
        return ok(message)
    found = places(analysis.matches, scene.cameras.c2w)[good]
    inside = float(((found > scene.aabb[0]) & (found < scene.aabb[1])).all(dim=-1).float().mean())
    message += f"; {100 * inside:.0f} % of the matched details lie in it"
    if inside > 1 - MANY:
        return ok(message)
    reach = float(found.abs().quantile(0.98))
    cure = f"Content reaches {reach:.2g} from the origin: enlarge the box (scene.aabb_half), or scene.space=contracted."
    return (wrong if inside < 0.5 else look)(message, cure)


def _share_in_box(scene: Scene, view: int) -> Float[Tensor, ""]:
    steps = (torch.arange(GRID) + 0.5) / GRID
    y, x = torch.meshgrid(
        (steps * scene.cameras.height[view]).long(), (steps * scene.cameras.width[view]).long(), indexing="ij"
    )
    rays = rays_through_pixels(scene.cameras, PixelIndex(torch.full_like(x, view), x, y), scene.near, scene.far)
    enter, leave = distances_in_box(rays, scene.aabb)
    return (leave > enter).float().mean()


def _units(low: float, high: float, near: float, far: float) -> str:
    # near and far have another unit than the poses.
    if min(far, high) <= 0 or (near > 0 and low <= 0):
        return ""  # a ratio needs distances
    factor = ((near * far) / (low * high)) ** 0.5 if near > 0 else far / high
    off = f"they are {max(factor, 1 / factor):.3g} times too {'large' if factor > 1 else 'small'}."
    for name, size in UNITS.items():
        if abs(factor / size - 1) < 0.35:
            return f" Near and far may be in {name} and the poses in meters: {off}"
        if abs(factor * size - 1) < 0.35:
            return f" Near and far may be in meters and the poses in {name}: {off}"
    return ""


CHECKS = {"near and far": near_and_far, "scene box": box_in_view, "scale": scale}
