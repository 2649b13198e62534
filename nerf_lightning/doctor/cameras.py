"""Checks of the cameras by themselves, before any pixel is asked."""

import math

import torch

from nerf_lightning.doctor.check import Check, Given
from nerf_lightning.nerf.geometry.cameras import image_plane
from nerf_lightning.nerf.geometry.frames import focus_point
from nerf_lightning.nerf.geometry.lenses import stretches, unproject
from nerf_lightning.nerf.geometry.poses import is_rigid

# Fields of view (degrees across the longer side) that photographers use.
NARROW, WIDE, WIDEST = 12.0, 100.0, 140.0
OFF_CENTER, FAR_OFF_CENTER = 0.06, 0.2


def rigid(evidence: Given) -> Check:
    """Judge whether poses are rotations (no scale, no mirror), and no two cameras are one."""
    c2w = evidence.scene.cameras.c2w
    bad = (~is_rigid(c2w)).nonzero()[:, 0].tolist()
    if bad:
        cure = "Take scale and mirror out of the rotations; the centres keep them."
        return Check("rotations", "wrong", f"{evidence.named(bad)} have poses that are no rotations", cure)
    size = float((c2w[:, :, 3].amax(dim=0) - c2w[:, :, 3].amin(dim=0)).norm())
    if len(c2w) > 1 and size < 1e-6:
        cure = "Walk around: depth is seen only from different places. Or the centres were lost in the conversion."
        return Check("rotations", "wrong", "all cameras stand at one place", cure)
    same = (torch.pdist(c2w.flatten(1)) < 1e-6 * size).sum() if len(c2w) <= 2000 else torch.tensor(0)
    if int(same):
        cure = "Look for photographs that are listed twice, or poses that were copied."
        return Check("rotations", "look", f"{int(same)} pairs of views have one and the same pose", cure)
    return Check("rotations", "ok", f"all {len(c2w)} poses are right-handed rotations with different centres")


def common_middle(evidence: Given) -> Check:
    """Judge whether the cameras look at, or away from, the place where their axes meet."""
    c2w, name = evidence.scene.cameras.c2w.double(), "common middle"
    if evidence.scene.cameras.lens_model == "equirectangular":
        return Check(name, "ok", "not judged: panoramas look everywhere")
    if evidence.scene.space == "ndc" or bool((c2w[:, :, 2].mean(dim=0).norm() > 0.95).item()):
        return Check(name, "ok", "the cameras all look the same way")
    to_middle = focus_point(c2w) - c2w[:, :, 3]
    ahead = float(((to_middle * -c2w[:, :, 2]).sum(dim=-1) > 0).double().mean())
    if ahead >= 0.8:
        return Check(name, "ok", f"{100 * ahead:.0f} % of the cameras have the place where their axes meet in front")
    if ahead <= 0.2:
        cure = (
            "If the photographs show one thing from around, negate the second and third column of every rotation; if "
            "they were taken outwards from one place, all is well."
        )
        message = f"{100 * (1 - ahead):.0f} % of the cameras look away from the place where their axes meet"
        return Check(name, "wrong", message + ": OpenCV's axes rather than OpenGL's, it seems", cure)
    cure = "Look at doctor.png: do the cameras face what was photographed? If not, see the check of axes."
    return Check(name, "look", f"only {100 * ahead:.0f} % of the cameras look at a common middle", cure)


def upright(evidence: Given) -> Check:
    """Judge whether the photographs lie on their side or stand on their head in the working frame."""
    scene, name = evidence.scene, "upright"
    up = torch.tensor([0.0, 1.0, 0.0] if scene.space == "ndc" else [0.0, 0.0, 1.0])
    right_up, up_up = (up @ scene.cameras.c2w[:, :, column].T for column in (0, 1))
    sideways = float((right_up.abs() > 0.7).float().mean())
    if sideways > 0.5:
        cure = "Training does not mind. For upright pictures turn the photographs and estimate the poses anew."
        return Check(name, "look", f"{100 * sideways:.0f} % of the photographs lie on their side", cure)
    if float(up_up.median()) < -0.1:
        cure = "Turn the world so that up is +z (or check the axes); else videos and orbits are upside down."
        return Check(name, "look", "most photographs stand on their head: up is not +z", cure)
    return Check(name, "ok", "the photographs are upright")


def field_of_view(evidence: Given) -> Check:
    """Judge the focal lengths by the field of view, and by how much they vary."""
    cameras, name = evidence.scene.cameras, "field of view"
    if cameras.lens_model == "equirectangular":
        return Check(name, "ok", "panoramas: all directions")
    side = torch.maximum(cameras.width, cameras.height)
    degrees = (2 * (0.5 * side / cameras.focal.mean(dim=-1)).atan()).rad2deg()
    low, high = float(degrees.min()), float(degrees.max())
    span = f"{low:.0f}" if high - low < 0.5 else f"{low:.0f} to {high:.0f}"
    message = f"{span} degrees across the longer side"
    limit = math.inf if cameras.lens_model == "fisheye" else WIDEST
    if low < NARROW / 3 or high > limit:
        cure = "Check the focal length: it must be in pixels, of photographs of this size."
        return Check(name, "wrong", message + ", which no usual lens has", cure)
    uneven = bool((cameras.focal[:, 0] / cameras.focal[:, 1] - 1).abs().max() > 0.1)
    if low < NARROW or (high > WIDE and limit < math.inf) or uneven:
        message += "; pixels are not square" if uneven else ", which is unusual"
        return Check(name, "look", message, "Check the focal length (pixels, for photographs of this size).")
    return Check(name, "ok", message)


def principal_point(evidence: Given) -> Check:
    """Judge how far the principal point lies from the photograph's centre; a halved one is named."""
    cameras, name = evidence.scene.cameras, "principal point"
    size = torch.stack([cameras.width, cameras.height], dim=-1)
    share = cameras.center / size
    off = float((share - 0.5).abs().max())
    message = f"at most {100 * off:.1f} % of the size from the centre"
    if off < OFF_CENTER:
        return Check(name, "ok", message)
    usual = share.median(dim=0).values
    factor = float((usual / 0.5).mean())
    # Photographs that were cropped, each elsewhere, have it anywhere; numbers for another size have it so in all.
    wrong = float((usual - 0.5).abs().max()) >= FAR_OFF_CENTER
    if wrong and float((usual[0] - usual[1]).abs()) < 0.03:
        message += f": it belongs to photographs of {factor:.2g} times the size, it seems"
    cure = "Give cx, cy (and the focal length) in pixels of the width and height beside them; cropped is fine."
    return Check(name, "wrong" if wrong else "look", message, cure)


def lens(evidence: Given) -> Check:
    """Judge how strongly the lens bends towards the corners; one that folds is refused when the capture is read."""
    cameras, name = evidence.scene.cameras, "lens"
    if cameras.lens_model == "pinhole" or not bool(cameras.lens.any()):
        return Check(name, "ok", "no distortion")
    view = int(cameras.lens.abs().sum(dim=-1).argmax())
    plane = image_plane(cameras, view)
    rays = unproject(plane, cameras.lens[view], cameras.lens_model)
    least = float(stretches(rays, cameras.lens[view], cameras.lens_model)[..., 0].min())
    bare = plane.norm(dim=-1)
    moved = float(((rays[..., :2] / rays[..., 2:]).norm(dim=-1) - bare).abs().max() * cameras.focal[view].mean())
    message = f"{cameras.lens_model}, moves the corners by up to {moved:.0f} pixels"
    if cameras.lens_model == "radial_tangential" and least < 0.25:
        cure = "Undistort the photographs, crop them, or calibrate with a fisheye model."
        return Check(name, "look", message + f"; it is near to folding back (stretch {least:.2f} at the border)", cure)
    return Check(name, "ok", message)


CHECKS = (rigid, common_middle, upright, field_of_view, principal_point, lens)
