"""Exposures from the points that photographs share, in closed form.

Two photographs that show one point of a surface show the same light, but for their gains: log2 of the ratio of what
they show is the difference of their stops. A learnt scene tells which pixels show one point. Each pair of pixels has an
error of its own (a highlight, an edge, a point a little off), so there are many, and those that most others contradict
hardly count.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import cosine_similarity

from nerf_lightning.nerf.geometry.cameras import seen_at
from nerf_lightning.nerf.products import own_precision
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.nerf.rendering.linear_light import to_linear
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import Cameras, Scene
from nerf_lightning.nerf.types.tensor_struct import TensorStruct

Look = Callable[[PixelIndex], tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels"]]]
"""Tells where the light of pixels comes from in the world, as the scene has been learnt, and their opacity."""

POINTS = 131_072
"""Pixels of all photographs together, whose points are looked for in others."""
OTHERS = 32
"""Photographs in which each point is looked for, about."""
OPAQUE = 0.95
LEAST_COSINE = 0.75
"""Of the angle at a point between two cameras: from farther aside surfaces shine differently."""
TOLERANCE = 0.02
"""How far what a pixel shows may lie from the point, as a share of its distance."""
CLIPPED = 0.97
"""Encoded colour from which on a photograph may have been brighter than it shows."""
DARK = 2.0**-12
"""Linear light that any channel is taken to have at least."""
LEAST_LIGHT = -5.0
"""Stops below white, once the gains are undone: a channel that is darker mostly shows what the surface mirrors."""
NARROW = 0.1
"""In the end a pair counts half whose error is this share of the median error,"""
LEAST_ERROR = 0.02
"""or, in stops, what eight bits leave open."""
ROUNDS, NARROWING = 30, 0.8
"""That share begins with 1 and falls by this factor a round, so that a poor beginning is left behind."""
PRIOR = 1e-2
"""Weight of the stops as they were, against 1 of a pair: it holds photographs that share nothing."""


@dataclass(frozen=True)
class Pairs(TensorStruct):
    """Pixels of two photographs that show one point."""

    view: Int[Tensor, "pairs 2"]
    """Numbers of the photographs."""
    light: Float[Tensor, "pairs 2 3"]
    """log2 of the linear light that they show."""
    whole: Bool[Tensor, "pairs 3"]
    """Whether neither is clipped."""


@own_precision
def shared_points(scene: Scene, cameras: Cameras, look: Look, key: int) -> Pairs:
    """Return pixels of training views that show one point of the scene as it has been learnt.

    Args:
        scene: whose photographs are compared.
        cameras: from where they were taken, as learnt.
        look: asks the scene that has been learnt.
        key: of the random numbers that choose the pixels.
    """
    trained = torch.tensor(scene.splits["train"])
    view = trained.repeat_interleave(-(-POINTS // len(trained)))
    across, down = batch_random(fold(key, "shared"), len(view)).uniform("pixel", 2).unbind(dim=1)
    size = scene.pixels.width[view], scene.pixels.height[view]
    pixels = PixelIndex(view, (across * size[0]).long(), (down * size[1]).long())
    pixels = pixels[_is_solid(scene, pixels)]
    points, opacity = look(pixels)
    solid = opacity > OPAQUE
    pixels, points = pixels[solid], points[solid]
    found = [_seen_by(scene, cameras, int(other), pixels, points, key) for other in trained]
    row = torch.cat([rows for rows, _ in found])
    others = PixelIndex(*(torch.cat([getattr(each, name) for _, each in found]) for name in ("view", "x", "y")))
    seen, opacity = look(others)
    distance = (points[row] - cameras.c2w[others.view][:, :, 3]).norm(dim=1)
    agree = (opacity > OPAQUE) & ((seen - points[row]).norm(dim=1) < TOLERANCE * distance)
    one, other = pixels[row[agree]], others[agree]
    rgb = torch.stack([_rgba(scene, one)[:, :3], _rgba(scene, other)[:, :3]], dim=1).float() / 255.0
    light = to_linear(rgb).clamp(min=DARK).log2()
    return Pairs(torch.stack([one.view, other.view], dim=1), light, (rgb < CLIPPED).all(dim=1))


def _seen_by(
    scene: Scene, cameras: Cameras, other: int, pixels: PixelIndex, points: Tensor, key: int
) -> tuple[Int[Tensor, "seen"], PixelIndex]:
    """Return some of the points that another view looks at, by their rows, and its pixels in which they lie."""
    chance = batch_random(fold(key, "other", other), len(points)).uniform("chosen", 1)[:, 0]
    chosen = (chance * len(scene.splits["train"]) < OTHERS) & (pixels.view != other)
    if scene.capture_of is not None:
        capture = torch.tensor(scene.capture_of)
        chosen &= capture[pixels.view] == capture[other]
    row = chosen.nonzero()[:, 0]
    one, two = (cameras.c2w[view][..., 3] - points[row] for view in (pixels.view[row], other))
    inside, x, y = seen_at(cameras, other, points[row])
    near = inside & (cosine_similarity(one, two, dim=1) > LEAST_COSINE)
    places = PixelIndex(torch.full_like(row, other), x, y)[near]
    solid = _is_solid(scene, places)
    return row[near][solid], places[solid]


def _rgba(scene: Scene, pixels: PixelIndex) -> Tensor:
    return scene.pixels.rgba[scene.pixels.index_of(pixels.view, pixels.x, pixels.y)]


def _is_solid(scene: Scene, pixels: PixelIndex) -> Bool[Tensor, "pixels"]:
    """Tell which pixels show the scene and nothing else."""
    place = scene.pixels.index_of(pixels.view, pixels.x, pixels.y)
    solid = scene.pixels.rgba[place][:, 3] == 255
    return solid if scene.pixels.mask is None else solid & (scene.pixels.mask[place] > 0)


@own_precision
def solved_stops(pairs: Pairs, stops: Float[Tensor, "views 3"]) -> Float[Tensor, "views 3"]:
    """Return the stops of red, green and blue that explain what pairs of photographs show.

    They minimise, for each channel, the sum over pairs of w (s_i - s_j - (l_i - l_j))^2 by iteratively reweighted least
    squares, where w = 1 / (1 + (error / scale)^2) falls with the error of a pair (Cauchy), and the scale from round to
    round. A channel counts where the mean of both lights, its gains undone, is not dark: a bound on what each
    photograph shows by itself would keep the noise that brightens the darker one. The mean of the stops stays as it is.

    Args:
        pairs: of photographs.
        stops: where to begin; photographs without pairs keep theirs.
    """
    one, other = pairs.view.unbind(dim=1)
    light, found = pairs.light.double(), stops.double()
    ratio = light[:, 0] - light[:, 1]
    for number in range(ROUNDS):
        error = (found[one] - found[other] - ratio).abs()
        neutral = (light.sum(dim=1) - found[one] - found[other]) / 2.0
        counts = pairs.whole & (neutral > LEAST_LIGHT)
        if not bool(counts.any()):
            return stops
        share = max(NARROW, NARROWING**number)
        scale = (share * error[counts].median()).clamp(min=LEAST_ERROR)
        weight = counts / (1.0 + (error / scale).square())
        found = torch.stack(
            [_least_squares(one, other, ratio[:, c], weight[:, c], found[:, c]) for c in range(3)], dim=1
        )
    return found.to(stops)


def _least_squares(one: Tensor, other: Tensor, ratio: Tensor, weight: Tensor, prior: Tensor) -> Float[Tensor, "views"]:
    normal = PRIOR * torch.eye(len(prior), dtype=prior.dtype)
    goal = PRIOR * prior
    for here, there, sign in ((one, other, 1.0), (other, one, -1.0)):
        normal.index_put_((here, here), weight, accumulate=True)
        normal.index_put_((here, there), -weight, accumulate=True)
        goal.index_add_(0, here, sign * weight * ratio)
    return torch.linalg.solve(normal, goal)
