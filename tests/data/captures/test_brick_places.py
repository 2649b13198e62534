"""From a capture to near, far, space, the doctor's verdict and a film, in places whose distances are known."""

import math

import pytest
import torch
from support.brick_places import Place, corridor, heap, outward_ring

from nerf_lightning.doctor.examine import examine
from nerf_lightning.nerf.geometry.world_frame import unit_of
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.video.paths.auto import AutoPath
from nerf_lightning.video.paths.base import frame_of

PLACES = {
    "outward from a ring": (lambda: outward_ring(1.0, seed=2), "transforms"),
    "outward, close to the bricks": (lambda: outward_ring(2.0, seed=3), "colmap"),
    "through a bent corridor, glancing aside": (lambda: corridor(60.0, 25.0, seed=5), "colmap"),
}
"""The place and the format."""


def assert_reaches_the_bricks(scene: Scene, place: Place, unit: float = 1.0) -> None:
    """All of space is modeled, near and far hold what is seen, and near is not next to nothing."""
    assert scene.space == "contracted"
    distance = torch.from_numpy(place.distance) / (unit * unit_of(scene.to_user))
    seen = distance.isfinite()
    assert bool((scene.near[:, None] < distance)[seen].all())
    assert bool((distance < scene.far[:, None])[seen].all())
    assert float(scene.near.min()) > 0.01 * float(distance.min())


def assert_filmed_as_photographed(scene: Scene) -> torch.Tensor:
    """Every frame looks about where a photograph looks, and its rows are level in the capture's own frame.

    Return how far the frames are from the middle, as multiples of the photographs' median.
    """
    frame = frame_of(scene.cameras, scene.aabb, to_user=scene.to_user, view_names=scene.view_names)
    film = AutoPath(60).cameras(frame).c2w
    turned = (film[:, :, 2] @ frame.poses[:, :, 2].mT).amax(dim=1).clamp(max=1.0).acos().rad2deg()
    assert float(turned.max()) < 25
    to_user = scene.to_user[:3, :3] / unit_of(scene.to_user)
    right, up = (to_user @ film[:, :, column].double().mT for column in (0, 1))
    assert float(right[2].abs().max()) < math.sin(math.radians(15))
    assert float(up[2].min()) > 0
    away = [(poses[:, :, 3] - frame.center).norm(dim=-1) for poses in (film, frame.poses)]
    return away[0] / away[1].median()


def verdicts(scene: Scene) -> dict[str, str]:
    """Return what the doctor says, where it says more than ok."""
    return {check.name: check.verdict for check in examine(scene)[1] if check.verdict in ("look", "wrong")}


@pytest.mark.parametrize("name", PLACES)
def test_a_place_is_modeled_and_filmed_as_it_was_photographed_in_whatever_unit(tmp_path, name):
    make, kind = PLACES[name]
    place = make()
    meters = place.read(kind, tmp_path / "meters")
    scene = place.read(kind, tmp_path / "millimeters", unit=1e-3, origin=(4e5, -7e4, 300.0))
    assert_reaches_the_bricks(meters, place)
    assert_reaches_the_bricks(scene, place, unit=1e-3)
    assert unit_of(scene.to_user) == pytest.approx(1000 * unit_of(meters.to_user), rel=1e-5)
    torch.testing.assert_close(scene.near, meters.near, rtol=1e-3, atol=0)
    torch.testing.assert_close(scene.far, meters.far, rtol=1e-3, atol=0)
    torch.testing.assert_close(scene.cameras.c2w, meters.cameras.c2w, rtol=0, atol=1e-3)
    assert_filmed_as_photographed(scene)
    found = verdicts(scene)
    assert "wrong" not in found.values(), found
    assert found["camera directions"] == "look"


def test_seven_cameras_that_were_moved_away(tmp_path):
    moved = torch.randperm(30, generator=torch.Generator().manual_seed(1))[:7].tolist()
    place = heap(240, 30, 1).with_cameras_moved(moved, 20.0)
    scene = place.read("colmap", tmp_path / "capture")
    assert_reaches_the_bricks(scene, place)
    # The unit is that of the other cameras.
    kept = sorted({*range(30)} - {*moved})
    assert 0.3 < float(scene.cameras.c2w[kept, :, 3].norm(dim=-1).median()) < 1.0
    assert float(assert_filmed_as_photographed(scene).max()) < 1.5
