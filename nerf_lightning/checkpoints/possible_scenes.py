"""Whether the numbers of a scene can be those of any scene: what no value shows on its own."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.schema import Unfit
from nerf_lightning.messages.escaping import require_printable
from nerf_lightning.nerf.geometry.frames import LARGEST_UNIT, LEAST_UNIT, unit_of
from nerf_lightning.nerf.geometry.lenses import with_coefficients
from nerf_lightning.nerf.geometry.poses import is_rigid


def require_possible_scene(scene: Mapping[str, Any], where: str) -> None:
    """Refuse the scene of a checkpoint whose keys are sound one by one, and not together.

    Args:
        scene: as `format.scene` describes it.
        where: the file, for messages.

    Raises:
        Unfit: cameras that are no cameras, content that ends before it begins, a box without inside, a frame that is
            no similarity, or views that are not there.
        InputError: a picture that is larger than a person has agreed to, or a name that cannot be shown.
    """
    cameras, views = scene["cameras"], len(scene["view_names"])
    _require_poses(cameras, "scene.cameras")
    require_within("view_pixels", int((cameras["width"] * cameras["height"]).max()), where, "pixels in one picture")
    if not bool((scene["near"] < scene["far"]).all()):
        raise Unfit("scene.near", "is not everywhere less than far")
    if not bool((scene["aabb"][0] < scene["aabb"][1]).all()):
        raise Unfit("scene.aabb", "has a lower corner that is not below the upper one")
    _require_similarity(scene["to_user"])
    for split, numbers in scene["splits"].items():
        if any(number >= views for number in numbers):
            raise Unfit(f"scene.splits.{split}", f"names views that are not among the {views}")
        if len(set(numbers)) < len(numbers):
            raise Unfit(f"scene.splits.{split}", "names a view twice")
    if len(set(scene["view_names"])) < views:  # files and tables are written by it
        raise Unfit("scene.view_names", "names two views alike")
    for name in (scene["name"], *scene["view_names"]):
        require_printable(name, f"{where}: scene.view_names")
    _require_captures(scene.get("capture_of"), scene.get("captures", ()), views)
    for name in scene.get("captures", ()):
        require_printable(name, f"{where}: scene.captures")


def _require_captures(capture_of: tuple[int, ...] | None, captures: tuple[str, ...], views: int) -> None:
    if capture_of is None:
        return
    if len(capture_of) != views:
        raise Unfit("scene.capture_of", f"has not a number for each of the {views} views")
    if any(number >= len(captures) for number in capture_of):
        raise Unfit("scene.capture_of", f"names captures that are not among the {len(captures)}")


def require_possible_refinement(refined: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    """Refuse cameras that no training can have learnt from those of the scene.

    Raises:
        Unfit: poses that are none, or what no refinement changes.
    """
    _require_poses(refined, "refined")
    for name in ("width", "height"):
        if not torch.equal(refined[name], given[name]):
            raise Unfit(f"refined.{name}", "is not that of the scene's cameras")
    lenses = (given["lens_model"], with_coefficients(given["lens_model"]))
    if refined["lens_model"] not in lenses or refined["ndc"] is not None or given["ndc"] is not None:
        raise Unfit("refined", "has another kind of lens or space than the scene's cameras")


def _require_poses(cameras: Mapping[str, Any], place: str) -> None:
    if not bool(is_rigid(cameras["c2w"]).all()):
        raise Unfit(f"{place}.c2w", "holds a pose that is not a rotation and a centre")


def _require_similarity(to_user: Tensor) -> None:
    to_user = to_user.double()
    unit = unit_of(to_user)
    if not LEAST_UNIT <= unit <= LARGEST_UNIT or to_user[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise Unfit("scene.to_user", "is singular, or its last row is not 0 0 0 1")
    if not bool(is_rigid(torch.cat([to_user[:3, :3] / unit, to_user[:3, 3:]], dim=1))):
        raise Unfit("scene.to_user", "is not a rotation, a scale and a shift")
