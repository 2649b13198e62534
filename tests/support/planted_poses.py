"""Faults planted in captures whose poses are right, one at a time, and whether they were found."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from nerf_lightning.doctor.check import Analysis
from nerf_lightning.doctor.conventions import FLIP_YZ, axes, inverted
from nerf_lightning.doctor.epipolar import agreeing
from nerf_lightning.doctor.poses import CHECKS
from nerf_lightning.nerf.geometry.world_frame import focus_point


@dataclass(frozen=True)
class Found:
    """What became of one planted fault."""

    fault: str
    wrong: bool
    """Some check of the poses says `wrong`."""
    said: bool
    """Some check says `wrong` or `look`."""
    named: bool
    """The views with wrong poses are named, each of them."""
    accused: int
    """Innocent views that are called wrong."""
    text: str


def with_poses(analysis: Analysis, c2w: torch.Tensor) -> Analysis:
    """The same photographs, so the same matches, with other poses."""
    cameras = replace(analysis.scene.cameras, c2w=c2w)
    return replace(analysis, scene=replace(analysis.scene, cameras=cameras), agrees=agreeing(analysis.matches, c2w))


def with_focal(analysis: Analysis, factor: float) -> Analysis:
    """The same photographs with another focal length (lenses aside)."""
    cameras = replace(analysis.scene.cameras, focal=factor * analysis.scene.cameras.focal)
    matches = replace(analysis.matches, plane=analysis.matches.plane / factor, focal=analysis.matches.focal * factor)
    scene = replace(analysis.scene, cameras=cameras)
    return replace(analysis, scene=scene, matches=matches, agrees=agreeing(matches, cameras.c2w))


def rotation_about(axis: torch.Tensor, degrees: float) -> torch.Tensor:
    """Return the rotation about an axis of any length."""
    x, y, z = torch.nn.functional.normalize(axis, dim=0).tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return torch.matrix_exp(cross * torch.deg2rad(torch.tensor(degrees)))


def turned(analysis: Analysis, degrees: float, random: torch.Generator) -> tuple[Analysis, list[int]]:
    """One camera turned on the spot about any axis."""
    c2w, view = analysis.scene.cameras.c2w.clone(), _any_view(analysis, random)
    c2w[view, :, :3] = rotation_about(torch.randn(3, generator=random), degrees) @ c2w[view, :, :3]
    return with_poses(analysis, c2w), [view]


def moved(analysis: Analysis, share: float, random: torch.Generator) -> tuple[Analysis, list[int]]:
    """One camera moved by a share of the usual distance to where cameras look."""
    c2w, view = analysis.scene.cameras.c2w.clone(), _any_view(analysis, random)
    middle = focus_point(c2w.double()).float()
    away = float((c2w[:, :, 3] - middle).norm(dim=-1).median())
    c2w[view, :, 3] += share * away * torch.nn.functional.normalize(torch.randn(3, generator=random), dim=0)
    return with_poses(analysis, c2w), [view]


def swapped(analysis: Analysis, random: torch.Generator) -> tuple[Analysis, list[int]]:
    """Two poses swapped."""
    first = _any_view(analysis, random)
    others = [view for view in analysis.matches.views if view != first]
    second = others[int(torch.randint(len(others), (), generator=random))]
    order = list(range(len(analysis.scene.view_names)))
    order[first], order[second] = second, first
    return with_poses(analysis, analysis.scene.cameras.c2w[order]), [first, second]


def _any_view(analysis: Analysis, random: torch.Generator) -> int:
    views = analysis.matches.views
    return views[int(torch.randint(len(views), (), generator=random))]


Fault = Callable[[Analysis, torch.Generator], tuple[Analysis, list[int]]]


def _whole(change: Callable[[torch.Tensor], torch.Tensor]) -> Fault:
    return lambda analysis, random: (with_poses(analysis, change(analysis.scene.cameras.c2w)), [])


def _focal(factor: float) -> Fault:
    return lambda analysis, random: (with_focal(analysis, factor), [])


FAULTS: dict[str, Fault] = {
    "one camera turned by 3 degrees": lambda analysis, random: turned(analysis, 3.0, random),
    "one camera turned by 5 degrees": lambda analysis, random: turned(analysis, 5.0, random),
    "one camera turned by 10 degrees": lambda analysis, random: turned(analysis, 10.0, random),
    "one camera moved by a fifth of its distance": lambda analysis, random: moved(analysis, 0.2, random),
    "two poses swapped": swapped,
    "OpenCV's axes": _whole(lambda c2w: axes(c2w, FLIP_YZ)),
    "world to camera": _whole(inverted),
    "axes x and y mirrored": _whole(lambda c2w: axes(c2w, (-1.0, -1.0, 1.0))),
    "each with the pose of the next": _whole(lambda c2w: c2w.roll(1, 0)),
    "focal length halved": _focal(0.5),
    "focal length 1.5 times": _focal(1.5),
    "focal length doubled": _focal(2.0),
}


def plant(analysis: Analysis, fault: str, seed: int) -> Found:
    """Plant a fault in a sound capture and examine it again."""
    spoilt, bad = FAULTS[fault](analysis, torch.Generator().manual_seed(seed))
    checks = [replace(check(spoilt), name=name) for name, check in CHECKS.items()]
    wrong = [check for check in checks if check.verdict == "wrong"]
    single = next((check.message for check in checks if check.name == "single poses" and check.verdict == "wrong"), "")
    accused = single.split("the pose of ")[-1].split(" contradict")[0]
    names = [analysis.scene.view_names[view] for view in bad]
    named = all(name in accused for name in names) if bad else bool(wrong)
    total = accused.count(",") + accused.count(" and ") + 1 if accused else 0
    innocent = max(0, total - sum(name in accused for name in names)) if bad or accused else 0
    text = "; ".join(f"{check.name}: {check.message}" for check in wrong)
    return Found(fault, bool(wrong), any(check.verdict in ("look", "wrong") for check in checks), named, innocent, text)
