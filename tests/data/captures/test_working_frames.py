"""From a capture to a scene: what must not depend on the frame that the user happens to have."""

import json
import logging

import numpy as np
import pytest
import torch
from support.posed_captures import Known, read, ring, user_rays, wall, write_colmap, write_llff, write_transforms

from nerf_lightning.data.readers.transforms import TransformsReader
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.geometry.world_frame import unit_of

AHEAD = np.array([0.0, 5.0, 0.0])
PLACES = [(0.0, 0.0), (0.99, 0.0), (0.5, 0.5), (0.2, 0.9)]


def turned(degrees, axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


@pytest.mark.parametrize("space", ["bounded", "contracted", "ndc"])
@pytest.mark.parametrize(
    ("scale", "rotation", "shift"),
    [
        (0.01, turned(90, [1, 0, 0]), [5.0, -3.0, 1.0]),
        (120.0, turned(200, [1, 2, 3]), [900.0, 20.0, -70.0]),
        (1.0, turned(180, [1, 0, 0]), [0.0, 0.0, 0.0]),
    ],
)
def test_a_capture_in_another_frame_is_the_same_scene_but_for_to_user(tmp_path, space, scale, rotation, shift):
    points = np.random.default_rng(3).normal(0, 0.4, (200, 3))
    known = Known(c2w=wall(), points=points + AHEAD) if space == "ndc" else Known(points=points)
    moved = known.moved(scale, rotation, np.array(shift))
    one = read("colmap", write_colmap(tmp_path / "one", known), space=space)
    other = read("colmap", write_colmap(tmp_path / "other", moved), space=space)
    for mine, theirs in ((one.near, other.near), (one.far, other.far), (one.aabb, other.aabb)):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)
    # The same picture of cameras and points, turned around the vertical axis at most.
    turn = torch.linalg.lstsq(one.points, other.points).solution.T
    if space == "ndc":
        torch.testing.assert_close(turn, torch.eye(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(turn[2], torch.tensor([0.0, 0.0, 1.0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(turn @ one.cameras.c2w[:, :, :3], other.cameras.c2w[:, :, :3], atol=1e-4, rtol=0)
    torch.testing.assert_close(one.cameras.c2w[:, :, 3] @ turn.T, other.cameras.c2w[:, :, 3], atol=1e-4, rtol=0)
    # And the user finds his own frame again.
    assert unit_of(other.to_user) == pytest.approx(scale * unit_of(one.to_user), rel=1e-4)
    for name in known.names[:3]:
        origins, directions = user_rays(one, name, PLACES)
        there = user_rays(other, name, PLACES)
        expected = scale * origins.numpy() @ rotation.T + shift
        np.testing.assert_allclose(there[0], expected, atol=2e-5 * max(1, np.abs(expected).max()))
        np.testing.assert_allclose(there[1], directions.numpy() @ rotation.T, atol=1e-4)


@pytest.mark.parametrize(
    ("known", "kind", "space", "reason"),
    [
        (Known(c2w=wall()), "llff", "ndc", "all cameras look the same way and the capture gives depths"),
        (Known(c2w=wall()), "transforms", "contracted", "show a background"),
        (Known(), "llff", "contracted", "show a background"),
    ],
)
def test_auto_says_why(tmp_path, caplog, known, kind, space, reason):
    writer = {"llff": write_llff, "transforms": write_transforms}[kind]
    with caplog.at_level(logging.INFO):
        scene = read(kind, writer(tmp_path / "c", known))
    assert scene.space == space
    assert f"space={space}" in caplog.text
    assert reason in caplog.text


def test_auto_does_not_bend_rays_that_look_sideways(tmp_path):
    # A lens of 160 degrees on forward-facing cameras: its corners do not look ahead.
    scene = read("llff", write_llff(tmp_path / "c", Known(c2w=wall(), focal=(0.8, 0.8))))
    assert scene.space == "contracted"


def corridor(count=9):
    """Cameras that walk straight ahead, past what the first of them show."""
    eyes = torch.stack(
        [torch.zeros(count), torch.arange(count) * 1.0, 0.02 * torch.arange(count) % 0.1], dim=-1
    ).double()
    ahead = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return look_at(eyes, eyes + ahead, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)).numpy()


def test_auto_says_that_too_few_points_tell_depths(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    few = write_colmap(tmp_path / "c", Known(c2w=wall(), points=np.random.default_rng(1).uniform(4, 6, (9, 3))))
    assert read("colmap", few).space == "contracted"
    assert "but too few sparse points tell depths" in caplog.text


def test_auto_takes_no_space_that_would_be_refused(tmp_path, caplog):
    points = np.random.default_rng(1).uniform([-1, 1, -1], [1, 12, 1], (300, 3))
    root = write_colmap(tmp_path / "c", Known(c2w=corridor(), points=points))
    with caplog.at_level(logging.INFO):
        assert read("colmap", root).space == "contracted"
    assert "some stand behind what others show" in caplog.text
    with pytest.raises(InputError, match=r"stands .* ahead of the cameras' middle"):
        read("colmap", root, space="ndc")


@pytest.mark.parametrize("away", [5.0, 20.0, 200.0])
@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_cameras_that_drifted_away_do_not_shrink_the_scene(tmp_path, away, write):
    poses = ring(20)
    poses[[3, 11], :, 3] *= away
    scene = read(write.__name__.removeprefix("write_"), write(tmp_path / "c", Known(c2w=poses)))
    distance = scene.cameras.c2w[:, :, 3].norm(dim=-1)
    assert 0.3 < float(distance.median()) < 1.0
    usual = read(write.__name__.removeprefix("write_"), write(tmp_path / "usual", Known(c2w=ring(20))))
    assert float(usual.cameras.c2w[:, :, 3].norm(dim=-1).max()) == pytest.approx(1.0, abs=1e-5)


def test_the_box_of_a_bounded_scene_is_around_the_middle_and_no_camera_is_inside(tmp_path):
    scene = read("transforms", write_transforms(tmp_path / "c", Known(focal=(8.0, 8.0))), space="bounded")
    distance = scene.cameras.c2w[:, :, 3].norm(dim=-1)
    half = float(scene.aabb[1, 0])
    assert torch.equal(scene.aabb[0], -scene.aabb[1])
    assert half < float(distance.min())
    # Rays begin before the box and end behind it.
    torch.testing.assert_close(scene.far, distance + 3**0.5 * half)
    assert bool((scene.near <= (distance - 3**0.5 * half).clamp(min=0.051)).all())


def test_the_box_of_a_bounded_scene_holds_the_sparse_points(tmp_path):
    points = np.random.default_rng(3).uniform(-0.6, 0.6, (400, 3)) * [1.0, 1.0, 0.3]
    scene = read("colmap", write_colmap(tmp_path / "c", Known(points=points)), space="bounded")
    inside = ((scene.points > scene.aabb[0]) & (scene.points < scene.aabb[1])).all(dim=-1)
    assert float(inside.float().mean()) > 0.98
    low, high = scene.points[:, 2].min(), scene.points[:, 2].max()
    assert float(scene.aabb[1, 2] - scene.aabb[0, 2]) < 1.3 * float(high - low)


def test_instant_ngps_box_is_kept_where_it_is(tmp_path):
    root = write_transforms(tmp_path / "c", Known())
    content = json.loads((root / "transforms.json").read_text()) | {"aabb_scale": 2}
    (root / "transforms.json").write_text(json.dumps(content))
    scene = read("transforms", root, space="bounded")
    middle = scene.to_user[:3, :3] @ scene.aabb.double().mean(dim=0) + scene.to_user[:3, 3]
    torch.testing.assert_close(middle, torch.zeros(3).double(), atol=1e-4, rtol=0)
    least = 2 / 0.33 / unit_of(scene.to_user)
    assert bool((scene.aabb[1] - scene.aabb[0] > 0.999 * least).all())


def test_instant_ngps_own_scale_and_offset_move_its_box(tmp_path):
    root = write_transforms(tmp_path / "c", Known())
    said = {"aabb_scale": 2, "scale": 0.25, "offset": [0.5, 0.25, 1.0]}
    content = json.loads((root / "transforms.json").read_text()) | said
    (root / "transforms.json").write_text(json.dumps(content))
    # 0.25 x + offset = 0.5 in the middle, and 2 / 0.25 from side to side.
    box = TransformsReader(root=str(root)).capture().box
    assert box is not None
    assert box.tolist() == [[-4.0, -3.0, -6.0], [4.0, 5.0, 2.0]]


def test_the_near_plane_lies_before_all_content(tmp_path):
    points = np.random.default_rng(3).normal(0, 0.4, (400, 3)) + AHEAD
    for kind, root in (
        ("llff", write_llff(tmp_path / "l", Known(c2w=wall()), near=3.0)),
        ("colmap", write_colmap(tmp_path / "c", Known(c2w=wall(), points=points))),
    ):
        scene = read(kind, root)
        assert scene.space == "ndc"
        least = 3.0 if kind == "llff" else points[:, 1].min()
        assert 0.7 * least < unit_of(scene.to_user) < 0.9 * least
        # All that a picture shows lies in the box of the cube.
        assert scene.aabb[:, 2].tolist() == [-1.0, 1.0]


def test_a_damaged_point_does_not_move_the_scene(tmp_path):
    points = np.random.default_rng(3).normal(0, 0.4, (400, 3))
    wild = np.concatenate([points, [[1e6, 0, 0], [0, -1e7, 3e5]]])
    one = read("colmap", write_colmap(tmp_path / "one", Known(points=points)))
    other = read("colmap", write_colmap(tmp_path / "other", Known(points=wild)))
    assert torch.equal(one.to_user, other.to_user)
    torch.testing.assert_close(one.near, other.near, rtol=0.05, atol=0)
    torch.testing.assert_close(one.far, other.far)
