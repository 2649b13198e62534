"""Check that a run resumes with the capture that it has learned from: cameras, names, splits, pixels, depths."""

import logging
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.world_frame import poses_from_user, unit_of
from nerf_lightning.nerf.types.scene import Scene

CLOSE = 1e-5
"""Two readings of one capture, on machines that round differently, differ by less: in the entries of a rotation, and as
a share of a focal length or of the farthest camera's distance."""
PIXEL = 1e-3
DEPTH = 1e-6
"""As a share of a sum over the depths of a photograph."""
INTRINSICS = {"focal": "focal length", "center": "principal point", "lens": "lens", "width": "size", "height": "size"}

log = logging.getLogger(__name__)


def depth_sums(scene: Scene) -> Float[Tensor, "views 4"]:
    """Return sums that identify the depths that a view is trained on, up to rounding; zeros where it has none.

    Depths come from sparse points or a sensor; those computed from the photographs (`doctor.triangulation`) change with
    these, and with the machine. The sums are of their certainties, alone and times depth, depth * x
    and depth * y, where depths are in the user's units and x and y in pixels.
    """
    sums = torch.zeros(len(scene.view_names), 4, dtype=torch.float64)
    if scene.depths is None or scene.depths.from_pictures:
        return sums
    depths = scene.depths[torch.isin(scene.depths.pixels.view, torch.tensor(scene.splits["train"]))]
    depth = depths.distance.double() * unit_of(scene.to_user.double())
    terms = torch.stack([torch.ones_like(depth), depth, depth * depths.pixels.x, depth * depths.pixels.y], dim=1)
    return sums.index_add_(0, depths.pixels.view, depths.certainty.double()[:, None] * terms)


def require_same_capture(there: Mapping[str, Any], here: Mapping[str, Any], allow_changed: bool) -> None:
    """Refuse a capture that is not a checkpoint's, or warn about it.

    Args:
        there: the checkpoint's record; without hashes of pixels or sums of depths if an earlier version wrote it.
        here: the run's.
        allow_changed: continue anyway, with a warning.

    Raises:
        InputError: says what has changed.
    """
    changed = changes(there, here)
    if not changed:
        return
    found = f"the capture {here['scene']['name']} is not the one that this run was trained on: {'; '.join(changed)}"
    if not allow_changed:
        raise InputError(
            f"Training cannot resume: {found}. Restore the capture, or start a new run (without resume); "
            "resume_changed_capture=true resumes anyway."
        )
    log.warning("%s. What was learned about each photograph now applies to the one with the same number.", found)


def changes(there: Mapping[str, Any], here: Mapping[str, Any]) -> list[str]:
    """Return what differs between two records of a capture, in words; photographs are matched by name."""
    old, new = there["scene"], here["scene"]
    number = {name: view for view, name in enumerate(old["view_names"])}
    both = [(number[name], view) for view, name in enumerate(new["view_names"]) if name in number]
    # Their numbers in both records, in the present order.
    a, b = (torch.tensor(views, dtype=torch.int64) for views in (zip(*both, strict=True) if both else ((), ())))
    found = _names(old["view_names"], new["view_names"], in_order=a.tolist() == sorted(a.tolist()))

    def say(what: str, differs: Bool[Tensor, "views"]) -> None:
        names = [new["view_names"][view] for view in b[differs].tolist()]
        if names:
            found.append(f"the {what} of {len(names)} of {len(b)} photographs ({listed(names, 3)})")

    say("pose", _moved(old, new, a, b))
    for key, what in _intrinsics(old["cameras"], new["cameras"], a, b).items():
        say(key, what)
    same_cameras = not found  # on which depths depend
    if "pixels" in there and "pixels" in here:
        say("pixels", there["pixels"][a] != here["pixels"][b])
    say("use (training, validation or test)", _used_otherwise(old["splits"], new["splits"], a, b))
    if "depths" in there and "depths" in here and same_cameras:
        was, now = there["depths"][a], here["depths"][b]
        say("depths (of sparse points or depth maps)", ((was - now).abs() > DEPTH * was.abs()).any(dim=1))
    # What follows from views and settings changes with them, and is reported only if nothing else differs.
    return found or _extent(old, new)


def _names(old: tuple[str, ...], new: tuple[str, ...], in_order: bool) -> list[str]:
    gone, come = set(old) - set(new), set(new) - set(old)
    found = [
        f"{len(some)} of {len(all_)} photographs {are} ({listed(sorted(some), 3)})"
        for some, all_, are in ((gone, old, "are gone"), (come, new, "are new"))
        if some
    ]
    return found if in_order else [*found, "the order of the photographs"]


def _moved(
    old: Mapping[str, Any], new: Mapping[str, Any], a: Int[Tensor, "views"], b: Int[Tensor, "views"]
) -> Bool[Tensor, "views"]:
    """Return which poses differ in the user's frame; a changed pose moves the working frame, and all others in it."""
    was = old["cameras"]["c2w"].double()
    apart = torch.linalg.inv(new["to_user"].double()) @ old["to_user"].double()
    now = poses_from_user(new["cameras"]["c2w"].double(), apart)
    farthest = was[:, :, 3].abs().max().clamp(min=1.0)
    off: Float[Tensor, "views 3 4"] = (was[a] - now[b]).abs()
    off[:, :, 3] /= farthest
    return off.flatten(1).amax(dim=1) > CLOSE


def _intrinsics(
    old: Mapping[str, Any], new: Mapping[str, Any], a: Int[Tensor, "views"], b: Int[Tensor, "views"]
) -> dict[str, Bool[Tensor, "views"]]:
    found: dict[str, Bool[Tensor, "views"]] = {}
    for key, what in INTRINSICS.items():
        was, now = (each.double().reshape(len(a), -1) for each in (old[key][a], new[key][b]))
        bound = {"focal": CLOSE * was, "center": torch.full_like(was, PIXEL)}.get(key, CLOSE * was.abs().clamp(max=1.0))
        differs = ((was - now).abs() > bound).any(dim=1)
        found[what] = found.get(what, torch.zeros_like(differs)) | differs
    found["lens"] |= old["lens_model"] != new["lens_model"]
    return found


def _used_otherwise(
    old: Mapping[str, Iterable[int]],
    new: Mapping[str, Iterable[int]],
    a: Int[Tensor, "views"],
    b: Int[Tensor, "views"],
) -> Bool[Tensor, "views"]:
    differs = torch.zeros(len(a), dtype=torch.bool)
    for split in old.keys() & new.keys():
        was, now = (torch.tensor(tuple(splits[split]), dtype=torch.int64) for splits in (old, new))
        differs |= torch.isin(a, was) != torch.isin(b, now)
    return differs


def _extent(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    same = all(torch.allclose(old[key], new[key], rtol=1e-4, atol=CLOSE) for key in ("near", "far", "aabb", "to_user"))
    words = {"space": "the space", "background": "the background"}
    found = [f"{word} ({old[key]} there, {new[key]} here)" for key, word in words.items() if old[key] != new[key]]
    return found if same else [*found, "where the content lies (near, far, the box, or points of the reconstruction)"]
