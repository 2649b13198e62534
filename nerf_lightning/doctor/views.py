"""Checks of the set of views: how many, from where, which are held out, which are missing."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.doctor.check import Check, Evidence, Given, rows_at_once
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.coverage import directions_seen, middle_of
from nerf_lightning.nerf.geometry.frames import gaps_around
from nerf_lightning.nerf.types.scene import Scene

FEW, TOO_FEW = 15, 5
FEW_MATCHES = 30
# Degrees between a held-out view and the nearest one that is learnt from.
FAR_HELD_OUT = 40.0


def number_of_views(evidence: Given) -> Check:
    """Judge whether there are enough views to learn from."""
    splits = evidence.scene.splits
    count = len(splits["train"])
    held = len(set(splits["val"]) | set(splits["test"]))
    message = f"{count} to learn from, {held} held out"
    if count >= FEW:
        return Check("number of views", "ok", message)
    cure = "Take more photographs: 15 or more of a scene seen from the front, 50 to 100 all around."
    return Check("number of views", "wrong" if count < TOO_FEW else "look", message, cure)


def splits(evidence: Evidence) -> Check:
    """Judge whether views are held out, and not learnt from as well."""
    parts = {split: set(views) for split, views in evidence.scene.splits.items()}
    both = sorted(parts["train"] & (parts["val"] | parts["test"]))
    if both:
        cure = "Take them out of one of the two lists; else the scores say nothing of new views."
        return Check("split", "wrong", f"{evidence.named(both)} are learnt from and held out at once", cure)
    held = sorted(parts["val"] | parts["test"])
    angles = _degrees_to_nearest(evidence.scene, held, sorted(parts["train"]))
    lonely = [view for view, angle in zip(held, angles.tolist(), strict=True) if angle > FAR_HELD_OUT]
    if lonely:
        message = f"{evidence.named(lonely)} are seen from over {FAR_HELD_OUT:.0f} degrees away from any training view"
        return Check("split", "look", message, "Expect low scores there; hold out other views, or add photographs.")
    far = f"; the farthest lies {float(angles.max()):.0f} degrees from a training view" if len(held) else ""
    return Check("split", "ok", f"no view is in training and held out at once{far}")


def left_out(evidence: Evidence) -> Check:
    """Report photographs without a pose."""
    missing, name = evidence.scene.left_out, "photographs without pose"
    if not missing:
        return Check(name, "ok", "none")
    total = len(missing) + len(evidence.scene.view_names)
    message = f"{len(missing)} of {total} photographs have no pose: {listed(missing, cap=5)}"
    cure = "Were they needed, take photographs between them and the others and estimate the poses anew (nerf poses)."
    return Check(name, "look" if len(missing) < 0.5 * total else "wrong", message, cure)


def overlap(evidence: Evidence) -> Check:
    """Look for views that share next to nothing with others."""
    matches = evidence.matches
    total = len(evidence.scene.view_names)
    counts = torch.bincount(matches.view.flatten(), minlength=total)[list(matches.views)]
    if not len(matches.view) or int(counts.median()) < 2 * FEW_MATCHES:
        return Check("overlap", "ok", "not judged: too few details could be found again")
    lonely = [matches.views[place] for place in (counts < FEW_MATCHES).nonzero()[:, 0].tolist()]
    if not lonely:
        return Check("overlap", "ok", f"every view shares at least {int(counts.min())} details with others")
    message = f"{evidence.named(lonely)} share next to nothing with other views"
    return Check("overlap", "look", message, "Add photographs between these and the others, or leave these out.")


def coverage(evidence: Evidence) -> Check:
    """Report from where around the middle photographs were taken; a hole in a ring of views is noted."""
    scene = evidence.scene
    if scene.space == "ndc":
        return Check("coverage", "ok", "forward-facing: new views are good between the cameras, not beside them")
    azimuth, elevation = directions_seen(scene)
    around, gaps = gaps_around(azimuth)
    widest = float(gaps.max())
    up = f"heights of {float(elevation.min()):.0f} to {float(elevation.max()):.0f} degrees"
    message = f"seen from {360 - widest:.0f} degrees around, from {up}"
    if len(gaps) > 8 and 50 < widest < 140:
        at = float(around[int(gaps.argmax())] + widest / 2)
        cure = f"Photographs are missing around {(at + 180) % 360 - 180:.0f} degrees (see doctor.png); take some there."
        return Check("coverage", "look", f"{message}, with a gap of {widest:.0f} degrees", cure)
    return Check("coverage", "ok", message)


def _degrees_to_nearest(scene: Scene, held: list[int], train: list[int]) -> Float[Tensor, "held"]:
    towards = functional.normalize(scene.cameras.c2w[:, :, 3] - middle_of(scene), dim=-1)
    if not train or not held:
        return torch.zeros(len(held))
    parts = towards[held].split(rows_at_once(len(train)))
    return torch.cat([(part @ towards[train].T).clamp(-1, 1).amax(dim=1) for part in parts]).acos().rad2deg()


CHECKS = (number_of_views, splits, left_out, overlap, coverage)
