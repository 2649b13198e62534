"""Checks of the cameras themselves, and of the set of views: how many, from where, which are held out or missing."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.data.captures.left_out import ALL_CAMERAS
from nerf_lightning.doctor.check import (
    MORE_DETAILS,
    Analysis,
    CaptureData,
    Check,
    look,
    not_judged,
    ok,
    rows_at_once,
    wrong,
)
from nerf_lightning.doctor.conventions import FLIP_YZ, axes
from nerf_lightning.doctor.epipolar import agreeing
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.cameras import image_plane
from nerf_lightning.nerf.geometry.lenses import stretches, unproject
from nerf_lightning.nerf.geometry.poses import is_rigid
from nerf_lightning.nerf.geometry.world_frame import directions_seen, focus_point, gaps_around, middle_of
from nerf_lightning.nerf.types.scene import Scene

# Fields of view (degrees across the longer side) that photographers use.
NARROW, WIDE, WIDEST = 12.0, 100.0, 140.0
OFF_CENTER, FAR_OFF_CENTER = 0.06, 0.2
FEW, TOO_FEW = 15, 5
FEW_MATCHES = 30
STEP = 10.0  # Degrees between neighbors in a good ring of photographs.
# Degrees between a held-out view and the nearest training view.
FAR_HELD_OUT = 40.0
CLEARLY_MORE = 0.05  # Share of the matched details that exceeds chance.
SOUND = 0.5  # Share of matched details that agree with the cameras, from which on the axes are right.


def rigid(data: CaptureData) -> Check:
    """Judge whether poses are rotations (no scale, no mirror), and all cameras are distinct."""
    c2w = data.scene.cameras.c2w
    bad = (~is_rigid(c2w)).nonzero()[:, 0].tolist()
    if bad:
        cure = "Take scale and mirror out of the rotations; the centers keep them."
        return wrong(f"{data.named(bad)} have poses that are not rotations", cure)
    size = float((c2w[:, :, 3].amax(dim=0) - c2w[:, :, 3].amin(dim=0)).norm())
    if len(c2w) > 1 and size < 1e-6:
        cure = "Walk around: depth is seen only from different places. Or the centers were lost in the conversion."
        return wrong("all cameras are at the same position", cure)
    same = (torch.pdist(c2w.flatten(1)) < 1e-6 * size).sum() if len(c2w) <= 2000 else torch.tensor(0)
    if int(same):
        cure = "Look for photographs that are listed twice, or poses that were copied."
        return look(f"{int(same)} pairs of views have one and the same pose", cure)
    return ok(f"all {len(c2w)} poses are right-handed rotations with different centers")


def common_middle(data: CaptureData) -> Check:
    """Judge whether the cameras look at, or away from, the point where their axes meet."""
    c2w = data.scene.cameras.c2w.double()
    if data.scene.cameras.lens_model == "equirectangular":
        return not_judged("panoramas look everywhere", "See the check of axes.")
    if data.scene.space == "ndc" or bool((c2w[:, :, 2].mean(dim=0).norm() > 0.95).item()):
        return not_judged("the cameras all look the same way", "See the check of axes.")
    to_middle = focus_point(c2w) - c2w[:, :, 3]
    ahead = float(((to_middle * -c2w[:, :, 2]).sum(dim=-1) > 0).double().mean())
    if ahead >= 0.8:
        return ok(f"{100 * ahead:.0f} % of the cameras face their common focus point")
    if ahead <= 0.2:
        cure = (
            "If the photographs surround one object, negate the second and third column of every rotation; if they "
            "look outward from one position, the poses are right."
        )
        message = f"{100 * (1 - ahead):.0f} % of the cameras look away from their common focus point"
        if isinstance(data, Analysis) and data.agreement >= SOUND:
            return look(f"{message}, and the photographs agree with the poses", "Nothing, if they look outward.")
        # A box contains what all cameras look at.
        if isinstance(data, Analysis) and data.scene.space != "bounded" and not _fits_opencv(data):
            return look(f"{message}, and the photographs do not tell whether that is right", cure)
        return wrong(message + ": OpenCV's axes rather than OpenGL's, it seems", cure)
    cure = "See doctor.png: the cameras should face what was photographed. If not, see the check of axes."
    return look(f"only {100 * ahead:.0f} % of the cameras face a common focus point", cure)


def _fits_opencv(analysis: Analysis) -> bool:
    """Return whether clearly more of the matched details agree with the cameras if their axes are OpenCV's."""
    flipped = agreeing(analysis.matches, axes(analysis.scene.cameras.c2w, FLIP_YZ))
    return int(flipped.sum()) - int(analysis.agrees.sum()) > CLEARLY_MORE * len(flipped)


def upright(data: CaptureData) -> Check:
    """Judge whether the photographs are sideways or upside down in the working frame."""
    scene = data.scene
    up = torch.tensor([0.0, 1.0, 0.0] if scene.space == "ndc" else [0.0, 0.0, 1.0])
    right_up, up_up = (up @ scene.cameras.c2w[:, :, column].T for column in (0, 1))
    sideways = float((right_up.abs() > 0.7).float().mean())
    if sideways > 0.5:
        cure = "Training is not affected. For upright pictures, rotate the photographs and estimate the poses again."
        return look(f"{100 * sideways:.0f} % of the photographs lie on their side", cure)
    if float(up_up.median()) < -0.1:
        cure = "Rotate the world so that up is +z (or check the axes); otherwise videos and orbits are upside down."
        return look("most photographs are upside down: up is not +z", cure)
    return ok("the photographs are upright")


def field_of_view(data: CaptureData) -> Check:
    """Judge the focal lengths by the field of view, and by how much they vary."""
    cameras = data.scene.cameras
    if cameras.lens_model == "equirectangular":
        return ok("panoramas: all directions")
    side = torch.maximum(cameras.width, cameras.height)
    degrees = (2 * (0.5 * side / cameras.focal.mean(dim=-1)).atan()).rad2deg()
    low, high = float(degrees.min()), float(degrees.max())
    span = f"{low:.0f}" if high - low < 0.5 else f"{low:.0f} to {high:.0f}"
    message = f"{span} degrees across the longer side"
    limit = math.inf if cameras.lens_model == "fisheye" else WIDEST
    if low < NARROW / 3 or high > limit:
        cure = "Check the focal length: it must be in pixels, of photographs of this size."
        return wrong(message + ", which no usual lens has", cure)
    uneven = bool((cameras.focal[:, 0] / cameras.focal[:, 1] - 1).abs().max() > 0.1)
    if low < NARROW or (high > WIDE and limit < math.inf) or uneven:
        message += "; pixels are not square" if uneven else ", which is unusual"
        return look(message, "Check the focal length (pixels, for photographs of this size).")
    return ok(message)


def principal_point(data: CaptureData) -> Check:
    """Judge how far the principal point is from the photograph's center; report a halved one."""
    cameras = data.scene.cameras
    size = torch.stack([cameras.width, cameras.height], dim=-1)
    share = cameras.center / size
    off = float((share - 0.5).abs().max())
    message = f"up to {100 * off:.1f} % of the size away from the center"
    if off < OFF_CENTER:
        return ok("centered" if off < 0.0005 else message)
    usual = share.median(dim=0).values
    factor = float((usual / 0.5).mean())
    # Photographs cropped at different places have it anywhere; numbers for another size shift it equally in all.
    is_other_size = float((usual - 0.5).abs().max()) >= FAR_OFF_CENTER
    if is_other_size and float((usual[0] - usual[1]).abs()) < 0.03:
        message += f": it belongs to photographs of {factor:.2g} times the size, it seems"
    cure = "Give cx, cy (and the focal length) in pixels of the given width and height; cropped is fine."
    return (wrong if is_other_size else look)(message, cure)


def lens(data: CaptureData) -> Check:
    """Judge how strongly the lens distorts toward the corners; one that folds is refused when the capture is read."""
    cameras = data.scene.cameras
    if cameras.lens_model == "pinhole" or not bool(cameras.lens.any()):
        return ok("no distortion")
    view = int(cameras.lens.abs().sum(dim=-1).argmax())
    plane = image_plane(cameras, view)
    rays = unproject(plane, cameras.lens[view], cameras.lens_model)
    least = float(stretches(rays, cameras.lens[view], cameras.lens_model)[..., 0].min())
    bare = plane.norm(dim=-1)
    moved = float(((rays[..., :2] / rays[..., 2:]).norm(dim=-1) - bare).abs().max() * cameras.focal[view].mean())
    message = f"{cameras.lens_model}, moves the corners by up to {moved:.0f} pixels"
    if cameras.lens_model == "radial_tangential" and least < 0.25:
        cure = "Undistort the photographs, crop them, or calibrate with a fisheye model."
        return look(message + f"; it is near to folding back (stretch {least:.2f} at the border)", cure)
    return ok(message)


def number_of_views(data: CaptureData) -> Check:
    """Judge whether there are enough views to learn from."""
    splits = data.scene.splits
    count = len(splits["train"])
    held = len(set(splits["val"]) | set(splits["test"]))
    message = f"{count} for training, {held} held out"
    if count >= FEW:
        return ok(message)
    if (missing := len(data.scene.left_out)) > count + held:
        message = f"{message}, and {missing} that are left out"
        return (wrong if count < TOO_FEW else look)(message, ALL_CAMERAS)
    cure = "Take more photographs: 15 or more of a scene seen from the front, 50 to 100 all around."
    return (wrong if count < TOO_FEW else look)(message, cure)


def splits(analysis: Analysis) -> Check:
    """Judge whether views are held out, and not trained on as well."""
    parts = {split: set(views) for split, views in analysis.scene.splits.items()}
    both = sorted(parts["train"] & (parts["val"] | parts["test"]))
    if both:
        cure = "Remove them from one of the two lists; otherwise scores say nothing about new views."
        return wrong(f"{analysis.named(both)} are both trained on and held out", cure)
    held = sorted(parts["val"] | parts["test"])
    angles = _degrees_to_nearest(analysis.scene, held, sorted(parts["train"]))
    lonely = [view for view, angle in zip(held, angles.tolist(), strict=True) if angle > FAR_HELD_OUT]
    if lonely:
        message = f"{analysis.named(lonely)} are more than {FAR_HELD_OUT:.0f} degrees away from any training view"
        return look(message, "Expect low scores there; hold out other views, or add photographs.")
    far = f"; the farthest lies {float(angles.max()):.0f} degrees from a training view" if len(held) else ""
    return ok(f"no view is both in training and held out{far}")


def left_out(analysis: Analysis) -> Check:
    """Report photographs without a pose."""
    missing = analysis.scene.left_out
    if not missing:
        return ok("none")
    total = len(missing) + len(analysis.scene.view_names)
    message = f"{len(missing)} of {total} photographs have no pose: {listed(missing, cap=5)}"
    cure = "If they are needed, take photographs between them and the others and estimate the poses again (nerf poses)."
    return look(message, cure)


def overlap(analysis: Analysis) -> Check:
    """Find views that share almost nothing with others."""
    matches = analysis.matches
    total = len(analysis.scene.view_names)
    counts = torch.bincount(matches.view.flatten(), minlength=total)[list(matches.views)]
    if not len(matches.view) or int(counts.median()) < 2 * FEW_MATCHES:
        return not_judged("too few details could be found again", MORE_DETAILS)
    lonely = [matches.views[place] for place in (counts < FEW_MATCHES).nonzero()[:, 0].tolist()]
    if not lonely:
        return ok(f"every view shares at least {int(counts.min())} details with others")
    message = f"{analysis.named(lonely)} share next to nothing with other views"
    return look(message, "Add photographs between these and the others, or leave these out.")


def coverage(analysis: Analysis) -> Check:
    """Report from where around the center photographs were taken, and any gap in a ring of views."""
    scene = analysis.scene
    if scene.space == "ndc":
        return ok("forward-facing: new views are good between the cameras, not outside them")
    azimuth, elevation = directions_seen(scene)
    around, gaps = gaps_around(azimuth)
    widest = float(gaps.max())
    up = f"heights of {float(elevation.min()):.0f} to {float(elevation.max()):.0f} degrees"
    message = f"seen from {360 - widest:.0f} degrees around, from {up}"
    if len(gaps) > 8 and 50 < widest < 140:
        place = int(gaps.argmax())
        at = (float(around[place]) + widest / 2 + 180) % 360 - 180
        before, after = (scene.view_names[view] for view in azimuth.argsort().roll(-place)[:2].tolist())
        cure = (
            f"Take {math.ceil(widest / STEP)} more photographs between {before} and {after} "
            f"({at:.0f} degrees on the coverage map of the report or of doctor.png)."
        )
        return look(f"{message}, with a gap of {widest:.0f} degrees", cure)
    return ok(message)


def _degrees_to_nearest(scene: Scene, held: list[int], train: list[int]) -> Float[Tensor, "held"]:
    towards = functional.normalize(scene.cameras.c2w[:, :, 3] - middle_of(scene), dim=-1)
    if not train or not held:
        return torch.zeros(len(held))
    parts = towards[held].split(rows_at_once(len(train)))
    return torch.cat([(part @ towards[train].T).clamp(-1, 1).amax(dim=1) for part in parts]).acos().rad2deg()


CHECKS = {
    "rotations": rigid,
    "camera directions": common_middle,
    "upright": upright,
    "field of view": field_of_view,
    "principal point": principal_point,
    "lens": lens,
}
OF_VIEWS = {
    "number of views": number_of_views,
    "split": splits,
    "photographs without pose": left_out,
    "overlap": overlap,
    "coverage": coverage,
}
