"""The background, decided in one place: what is behind a ray, and what a photograph shows in front of it.

A rendered ray is composited over it where its sums become a `Rendering` (`from_sums`, `from_light`).

Which background a scene has, its reader decides: `default_background`, or `data/pixels/plain_background.py`.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.row_chunks import row_chunks
from nerf_lightning.nerf.types.scene import DRAWN, UNSURE, Background, Scene

LEAST_OPACITY = 1e-2
"""Minimum opacity at which a ray's color is distinguishable from the background's: below it, the color is divided by
this, and counts for less."""


def background_colors(
    background: Background,
    num_rays: int,
    device: torch.device,
    random: RayRandom | None,
    rgba: Float[Tensor, "rays 4"] | None = None,
) -> Float[Tensor, "rays 3"] | None:
    """Return the color behind each ray, or None if rays are closed.

    Args:
        background: the kind; random ones are drawn only in training.
        num_rays: number of rays.
        device: device of the colors.
        random: the step's random numbers; None (evaluation, rendering) selects the color of evaluation.
        rgba: the training pixels, of which `UNSURE` ones keep the color of evaluation behind them.
    """
    if background == "none":
        return None
    shown = 0.0 if at_evaluation(background) == "black" else 1.0
    if background not in DRAWN or random is None:
        return torch.full((num_rays, 3), shown, device=device)
    drawn = random.uniform("background", 3)
    if background == "random" or rgba is None:
        return drawn
    return torch.where((255.0 * rgba[:, 3:]).round() == UNSURE, shown, drawn)


def at_evaluation(background: Background) -> Background:
    """Return the background of evaluation, where nothing is drawn at random.

    >>> at_evaluation("random"), at_evaluation("black_or_random")
    ('white', 'black')
    """
    if background not in DRAWN:
        return background
    return "black" if background == "black_or_random" else "white"


def blend(rgba: Float[Tensor, "*rays 4"], background: Float[Tensor, "*#rays 3"] | None) -> Float[Tensor, "*rays 3"]:
    """Return straight-alpha colors over a background: rgb * a + background * (1 - a).

    Without a background the colors are unchanged.

    >>> blend(torch.tensor([1.0, 0.0, 0.0, 0.25]), torch.ones(3))
    tensor([1.0000, 0.7500, 0.7500])
    """
    if background is None:
        return rgba[..., :3]
    return torch.lerp(background, rgba[..., :3], rgba[..., 3:])


def in_other_light(
    change: Callable[[Tensor], Tensor],
    rgb: Float[Tensor, "*rays 3"],
    foreground: Float[Tensor, "*rays 3"],
    opacity: Float[Tensor, "*rays"],
) -> Float[Tensor, "*rays 3"]:
    """Return rendered colors after a change of the scene's own light; the background behind it keeps its color.

    Args:
        change: maps straight colors, as of opaque pixels, to changed ones.
        rgb: colors over the background.
        foreground: the scene's own light in them, sum of weights times color.
        opacity: sum of weights.
    """
    opacity = opacity[..., None]
    straight = foreground / opacity.clamp(min=LEAST_OPACITY)
    return rgb + opacity * (change(straight) - straight)


def photograph(scene: Scene, view: int, background: Background) -> Float[Tensor, "height width 3"]:
    """Return what a view's photograph shows over the background of evaluation."""
    behind = background_colors(background, 1, torch.device("cpu"), random=None)
    rgba = scene.pixels.view(view)
    shown = torch.empty(*rgba.shape[:2], 3)
    for rows in row_chunks(*rgba.shape[:2]):
        shown[rows] = blend(rgba[rows].float() / 255.0, behind)
    return shown
