"""Checks of the photographs themselves."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.doctor.check import MORE_DETAILS, Analysis, Check, look, not_judged, ok, rows_at_once, wrong
from nerf_lightning.doctor.features import THUMBNAIL
from nerf_lightning.doctor.matches import Matches, nearest_views
from nerf_lightning.nerf.rendering.background import at_evaluation

# Mean difference of thumbnails, in units of their contrast.
SAME = 0.012
# Number of nearby views to compare with; fewer say nothing.
NEIGHBORS, FEWEST_NEIGHBORS = 6, 4
# A photograph is blurred if it has less than this share of its neighbors' fine detail; within these bounds the share
# depends on the usual variation between photographs, in deviations.
SOFT, SOFTEST, DEVIATIONS = 0.5, 0.27, 4.5
# Number of pixels that show whether colors are premultiplied by alpha, and the share of them that may still be
# brighter.
FAINT, STRAY = 100, 0.005
# Factors of brightness and of red or blue against green.
EXPOSURE, TINT = 1.35, 1.2
# Minimum number of matches of a pair of photographs to compare their brightness.
FEWEST = 20
EVEN = 0.97
COLOURS = {"white": 1.0, "black": 0.0}


def duplicates(analysis: Analysis) -> Check:
    """Find duplicate photographs."""
    flat = analysis.looks.thumbnail.flatten(1)
    flat = flat - flat.mean(dim=1, keepdim=True)
    contrast = flat.std(dim=1)
    parts = torch.arange(len(flat)).split(rows_at_once(len(flat)))
    same = torch.cat([_pairs_alike(flat, contrast, part) for part in parts])
    if not len(same):
        return ok("no duplicate photographs")
    scene = analysis.scene
    held = set(scene.splits["test"]) | set(scene.splits["val"])
    leak = [pair for pair in same.tolist() if (pair[0] in held) != (pair[1] in held)]
    pairs = " and ".join(analysis.named([view]) for view in same[0].tolist())
    message = f"{len(same)} pairs of photographs are all but identical, such as {pairs}"
    if leak:
        message += f"; {len(leak)} of them are both in training and held out, so scores will be too good"
    return look(message, "Remove one of each (scene.frames, or from the file).")


def _pairs_alike(
    flat: Float[Tensor, "views values"], contrast: Float[Tensor, "views"], rows: Int[Tensor, "rows"]
) -> Int[Tensor, "pairs 2"]:
    """Return pairs of a view in `rows` and a later view that equals it, relative to its own contrast."""
    apart = torch.cdist(flat[rows], flat) / THUMBNAIL / contrast[rows, None].clamp(min=1e-3)
    later = torch.arange(len(flat)) > rows[:, None]
    pairs = ((apart < SAME) & (contrast[rows, None] > 1e-3) & later).nonzero()
    return torch.stack([rows[pairs[:, 0]], pairs[:, 1]], dim=1)


def blur(analysis: Analysis) -> Check:
    """Find photographs that are much less sharp, along any direction, than those nearby."""
    fineness = analysis.looks.fineness
    shown = (~fineness.isnan().any(dim=1)).nonzero()[:, 0]
    if len(shown) <= FEWEST_NEIGHBORS or 2 * len(shown) < len(fineness):
        message = f"only {len(shown)} of {len(fineness)} photographs show enough texture"
        return not_judged(message, "It needs photographs in which the content is larger, or more of them.")
    parts = shown.split(rows_at_once(len(shown)))
    near = torch.cat([nearest_views(analysis.scene.cameras.c2w, part, shown, NEIGHBORS) for part in parts])
    off = fineness[shown] - fineness[near].median(dim=1).values
    limit = min(max(math.exp(-DEVIATIONS * 1.48 * float(off.abs().median())), SOFTEST), SOFT)
    share = off.amin(dim=1).exp()
    order = share.argsort()
    bad = shown[order[share[order] < limit]].tolist()
    least = f"{100 * float(share.min()):.0f} % of the fine detail of photographs from nearby"
    if hidden := fineness.isnan().any(dim=1).nonzero()[:, 0].tolist():
        least += f" ({analysis.named(hidden)} show too little texture to tell)"
    if not bad:
        return ok(f"the least sharp of {len(shown)} photographs has {least}")
    message = f"{len(bad)} of {len(shown)} are blurred: {analysis.named(bad)}; the worst has {least}"
    return look(message, "Remove them (scene.frames, or from the file), or photograph again.")


def exposure(analysis: Analysis) -> Check:
    """Compare the colors of the same details in different photographs."""
    matches = analysis.matches
    if analysis.agreement > 0.3:
        matches = matches.where(analysis.agrees)
    gains = gains_of(matches, len(analysis.scene.view_names))
    if gains is None:
        return not_judged("too few details could be found again", MORE_DETAILS)
    bright = gains.mean(dim=1).exp()
    tint = (gains - gains[:, 1:2])[:, [0, 2]].abs().amax(dim=1).exp()
    dark, odd = _jumps(bright, EXPOSURE), _jumps(tint, TINT)
    if not dark and not odd:
        spread = float(torch.maximum(bright, 1 / bright).max())
        return ok(f"brightness of the same details differs by a factor of at most {spread:.2f}")
    words = []
    if dark:
        words.append(f"{analysis.named(dark)} differ in brightness ({float(bright[dark[0]]):.2f} times the usual)")
    if odd:
        words.append(f"{analysis.named(odd)} differ in white balance")
    cure = "correction=exposure learns these differences; photographs with fixed exposure and white balance are better."
    return look("; ".join(words), cure)


def gains_of(matches: Matches, num_views: int) -> Float[Tensor, "views 3"] | None:
    """Return each view's log brightness per channel against the median view, by least squares over pairs."""
    bright = (matches.rgb > 0.06).all(dim=2).all(dim=1) & (matches.rgb < 0.94).all(dim=2).all(dim=1)
    view, rgb = matches.view[bright], matches.rgb[bright]
    keys, number, count = (view[:, 0] * num_views + view[:, 1]).unique(return_inverse=True, return_counts=True)
    strong = (count >= FEWEST).nonzero()[:, 0].tolist()
    if len(strong) < 2:
        return None
    ratio = (rgb[:, 1] / rgb[:, 0]).log()
    system, right = 0.05 * torch.eye(num_views), torch.zeros(num_views, 3)
    for pair in strong:
        first, second = divmod(int(keys[pair]), num_views)
        step = ratio[number == pair].median(dim=0).values
        system[[first, second], [first, second]] += 1.0
        system[[first, second], [second, first]] -= 1.0
        right[first] -= step
        right[second] += step
    gains = torch.linalg.solve(system, right)
    return gains - gains.median(dim=0).values


def transparency(analysis: Analysis) -> Check:
    """Judge alpha, and whether colors are already premultiplied."""
    scene, looks = analysis.scene, analysis.looks
    if not scene.pixels.has_transparency:
        return ok("the photographs are opaque")
    covered = f"{100 * float(looks.covered.mean()):.0f} % of the pixels show the content"
    empty = (looks.covered < 0.003).nonzero()[:, 0].tolist()
    if empty:
        message = f"{analysis.named(empty)} show (almost) nothing: all is transparent"
        return look(message, "See that alpha was exported, or remove these views.")
    up_to, beyond = looks.faint.sum(dim=0).tolist()
    # Cutting out does not change colors.
    if "cut_out" not in scene.protocol and up_to + beyond < FAINT:
        needs = f"It needs {FAINT} pixels that are nearly transparent; of hard outlines there is nothing to multiply."
        return not_judged(f"{covered}; whether colors are multiplied by alpha cannot be seen", needs)
    multiplied = "cut_out" not in scene.protocol and beyond <= STRAY * up_to
    if multiplied and at_evaluation(scene.background) not in ("black", "none"):
        message = f"of {up_to + beyond:.0f} nearly transparent pixels {beyond:.0f} are brighter than alpha"
        return look(f"{message}: colors are multiplied by alpha", "Export straight alpha, or edges get dark seams.")
    return ok(f"{covered}, the rest is transparent")


def baked_background(analysis: Analysis) -> Check:
    """Find a background of one color that opaque photographs have, or had, baked in."""
    scene, looks = analysis.scene, analysis.looks
    if color := scene.protocol.get("cut_out"):
        message = f"plain {color}, which was made transparent (scene.cut_out)"
        if color in COLOURS and at_evaluation(scene.background) != color:
            cure = (
                f"Outlines keep the color that they were photographed before: set scene.background={color}_or_random."
            )
            return look(f"{message}; scene.background is {scene.background}", cure)
        return ok(message)
    even = looks.border_even > EVEN
    if scene.pixels.has_transparency or float(even.float().mean()) < 0.8:
        return ok(f"{at_evaluation(scene.background)} where a ray meets nothing (scene.background)")
    colour = looks.border[even].median(dim=0).values
    usual = [known for known, level in COLOURS.items() if float((colour - level).abs().max()) < 0.03]
    words = usual[0] if usual else "of the color " + ", ".join(f"{255 * float(level):.0f}" for level in colour)
    if usual == [scene.background]:
        return ok(f"the photographs are opaque on {words}, and so is the scene's background")
    cure = (
        f"Set scene.background={usual[0]}." if usual else "Cut the content out (alpha), or set scene.background=none."
    )
    message = f"the photographs are opaque on a background that is {words}, but scene.background is {scene.background}"
    return (wrong if scene.space == "bounded" and scene.background != "none" else look)(message, cure)


def masks(analysis: Analysis) -> Check:
    """Judge how much the masks keep."""
    if analysis.scene.pixels.mask is None:
        return ok("none")
    kept = analysis.looks.unmasked
    message = f"{100 * float(kept.mean()):.0f} % of the pixels are kept"
    empty = (kept < 0.02).nonzero()[:, 0].tolist()
    if float(kept.mean()) < 0.1 or float(kept.min()) < 0.02:
        message += f"; next to nothing is left of {analysis.named(empty)}" if empty else ""
        return look(message, "White is kept: if the masks mean the opposite, invert them.")
    return ok(message)


def _jumps(factor: Tensor, limit: float) -> list[int]:
    off = torch.maximum(factor, 1 / factor)
    order = off.argsort(descending=True)
    return order[off[order] > limit].tolist()


CHECKS = {
    "duplicates": duplicates,
    "sharpness": blur,
    "exposure": exposure,
    "transparency": transparency,
    "background": baked_background,
    "masks": masks,
}
