"""Point clouds: on known surfaces, with normals; what only one view sees is left out."""

from dataclasses import replace

import numpy as np
import psutil
import pytest
import torch
import trimesh
from support.known_fields import ball, solid
from support.peak_bytes import peak_bytes
from support.posed_captures import Known, read, wall, write_llff
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.export.base import RunContext
from nerf_lightning.export.visibility import num_agreeing, see
from nerf_lightning.extensions.geometry_exports.points import (
    BYTES_PER_PIXEL,
    BYTES_PER_POINT,
    PointsExport,
    save_las,
    scale_and_offset,
)
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.nerf.geometry.world_frame import similarity, upright_rotation

TILE = 1 << 15


def record(**changes):
    return replace(scene_record(ball_scene(num_views=12, size=24)), **changes)


def exported(folder, model, scene, crop=None, **settings):
    (path,) = PointsExport(**settings).export(model, scene, folder, TILE, RunContext(crop=crop))
    return trimesh.load(path), path


def test_only_the_points_in_a_crop_box_are_written(tmp_path):
    to_user = similarity(torch.eye(3), torch.tensor([5.0, 6.0, 7.0]), 100.0)
    upper = CropBox.from_user((-1e3, -1e3, 7.0), (1e3, 1e3, 1e3), to_user)
    cloud, _ = exported(tmp_path, solid(ball()), record(to_user=to_user), upper)
    assert len(cloud.vertices) > 100
    assert cloud.vertices[:, 2].min() > 7.0
    with pytest.raises(InputError, match="there are no points in this box"):
        exported(tmp_path, solid(ball()), record(), CropBox.from_user((8.0, 8.0, 8.0), (9.0, 9.0, 9.0), torch.eye(4)))


def normals_of(path):
    content = path.read_bytes()
    names = [line.split()[-1] for line in content.split(b"end_header\n")[0].decode().splitlines() if "property" in line]
    layout = [(name, "u1" if name in ("red", "green", "blue") else "<f4") for name in names]
    rows = np.frombuffer(content.split(b"end_header\n", 1)[1], layout)
    return np.stack([rows[name] for name in ("nx", "ny", "nz")], axis=-1)


def test_points_lie_on_the_ball_with_its_normals_and_colours_in_the_users_frame(tmp_path):
    to_user = similarity(upright_rotation(torch.tensor([1.0, 0.0, 0.0])), torch.tensor([5.0, 6.0, 7.0]), 100.0)
    cloud, path = exported(tmp_path, solid(ball()), record(to_user=to_user))
    local = (cloud.vertices - [5.0, 6.0, 7.0]) @ (to_user[:3, :3].numpy() / 100.0) / 100.0
    radius = np.linalg.norm(local, axis=1)
    assert len(local) > 200
    assert np.abs(radius - 0.8).max() < 0.06
    turned = normals_of(path) @ (to_user[:3, :3].numpy() / 100.0)
    assert np.median((turned * local).sum(axis=1) / radius) > 0.95
    clear = np.abs(local[:, 0]) > 0.3
    expected = np.where(local[:, :1] > 0, [[255, 0, 0]], [[0, 255, 0]])
    assert np.abs(np.asarray(cloud.colors)[:, :3].astype(int) - expected)[clear].mean() < 15


def test_what_one_view_alone_sees_is_left_out(tmp_path):
    scene = scene_record(ball_scene(num_views=6, size=24))  # 60 degrees apart
    eye = scene.cameras.c2w[scene.splits["train"][0], :, 3]

    def with_speck(positions):  # close to one camera, outside the others' view
        return torch.minimum(ball(0.7)(positions), ball(0.12, (0.48 * eye).tolist())(positions))

    everything, _ = exported(tmp_path, solid(with_speck), scene, agreement=0)
    confirmed, _ = exported(tmp_path, solid(with_speck), scene, agreement=1, tolerance=0.02)
    speck = (0.48 * eye).numpy()
    assert (np.linalg.norm(everything.vertices - speck, axis=1) < 0.2).any()
    assert not (np.linalg.norm(confirmed.vertices - speck, axis=1) < 0.2).any()
    assert len(confirmed.vertices) > 100


def test_views_agree_about_what_both_see_and_not_about_what_is_hidden():
    scene, model = record(), solid(ball())
    depth = {view: see(model, scene, scene.cameras, view, TILE).depth for view in (0, 1)}
    facing = scene.cameras.c2w[0, :, 3] / scene.cameras.c2w[0, :, 3].norm() * 0.8
    points = torch.stack([facing, -facing, 3 * facing, 100 * facing])  # seen, hidden, in the air, behind the camera
    assert num_agreeing(points, scene.cameras, depth, [0], 0.02).tolist() == [1, 0, 0, 0]
    assert num_agreeing(points, scene.cameras, depth, [0, 1], 0.02).tolist()[0] == 2


def test_forward_facing_captures_have_their_points_in_the_world(tmp_path):
    scene = read("llff", write_llff(tmp_path / "c", Known(c2w=wall(), focal=(14.0, 14.0)), near=2.0), space="ndc")
    user = scene.to_user.float()

    def plane(positions):  # in the cube, where the user's wall y = 5 is a plane of constant z
        forward = torch.linalg.inv(user) @ torch.tensor([0.0, 5.0, 0.0, 1.0])
        return 1.0 + 2.0 / forward[2] - positions[..., 2]

    cloud, _ = exported(tmp_path, solid(plane, samples=512), scene_record(scene), agreement=1)
    normal = user[:3, 2].numpy() / np.linalg.norm(user[:3, 2])
    height = (np.asarray(cloud.vertices) - [0.0, 5.0, 0.0]) @ normal
    assert len(height) > 300
    assert np.abs(height).max() < 0.25


def test_an_empty_field_is_refused_with_the_opacities_seen(tmp_path):
    with pytest.raises(
        InputError, match=r"opacities of ball's training views go from \S+ to 0\.0\d+, and min_opacity=0\.5"
    ):
        exported(tmp_path, solid(ball(), inside=0.01), record())
    with pytest.raises(InputError, match=r"no point is confirmed by 5 other views"):
        exported(tmp_path, solid(ball()), record(), agreement=5, tolerance=1e-7)
    assert not list(tmp_path.iterdir())


def test_a_cloud_takes_no_more_memory_than_is_asked_for(tmp_path):
    scene = scene_record(ball_scene(num_views=12, size=64))
    wall = solid(lambda positions: -torch.ones_like(positions[..., 0]), samples=4)  # all pixels are opaque
    num_pixels = len(scene.splits["train"]) * 64**2

    def each(num_points):
        export = PointsExport(num_points, agreement=0)
        return peak_bytes(lambda: export.export(wall, scene, tmp_path, 1 << 10), torch.device("cpu")) / num_pixels

    assert 0.7 * BYTES_PER_PIXEL < each(10) < BYTES_PER_PIXEL
    # The rows of the file are numpy's, and not counted here: 54 bytes.
    assert 0.5 * (BYTES_PER_PIXEL + BYTES_PER_POINT) < each(num_pixels) < BYTES_PER_PIXEL + BYTES_PER_POINT - 54


def test_a_cloud_beyond_memory_is_refused_with_what_would_fit(tmp_path, monkeypatch):
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 10**6}))
    scene = scene_record(ball_scene(num_views=12, size=64))
    with pytest.raises(
        InputError, match=r"what\.longest=400 makes 24,576 points of 6 views, .* are available"
    ) as error:
        PointsExport().export(solid(ball()), scene, tmp_path, TILE)
    longest = int(str(error.value).split("what.longest=")[2].split(" ")[0])
    assert 6 * longest**2 * (BYTES_PER_PIXEL + BYTES_PER_POINT) <= 8e5
    assert 6 * (longest + 1) ** 2 * (BYTES_PER_PIXEL + BYTES_PER_POINT) > 8e5
    assert not list(tmp_path.iterdir())
    PointsExport(longest=longest, agreement=0).export(solid(ball()), scene, tmp_path, TILE)


def test_las_holds_the_points_of_the_ply_with_their_colours(tmp_path):
    laspy = pytest.importorskip("laspy", reason="laspy is not installed (the extra las)")
    far_away = torch.tensor([690_000.0, 5_330_000.0, 520.0])  # as in UTM: places that float32 does not tell apart
    scene = record(to_user=similarity(torch.eye(3), far_away, 100.0))
    expected, _ = exported(tmp_path, solid(ball()), scene, num_points=150)
    assert len(expected.vertices) == 150
    (path,) = PointsExport(150, format="las").export(solid(ball()), scene, tmp_path, TILE)
    assert path.name == "points.las"
    las = laspy.read(path)
    assert (str(las.header.version), las.header.point_format.id) == ("1.2", 2)
    assert len(set(las.header.scales)) == 1
    np.testing.assert_allclose(np.asarray(las.xyz), expected.vertices, atol=0.5)  # float32 is as coarse, in the PLY
    radius = np.linalg.norm(np.asarray(las.xyz) - far_away.numpy(), axis=1) / 100.0
    assert np.abs(radius - 0.8).max() < 0.06
    colors = np.stack([las.red, las.green, las.blue], axis=1)
    np.testing.assert_array_equal(colors, 257 * np.asarray(expected.colors)[:, :3].astype(int))


@pytest.mark.parametrize("extent", [0.0, 1e-6, 8e5])
@pytest.mark.parametrize("place", [0.0, -1e7])
def test_the_steps_of_a_las_file_suit_the_extent(tmp_path, extent, place):
    laspy = pytest.importorskip("laspy", reason="laspy is not installed (the extra las)")
    points = place + extent * np.random.default_rng(0).random((50, 3))
    scale, _ = scale_and_offset(points)
    assert np.log10(scale) == pytest.approx(np.round(np.log10(scale)))
    save_las(tmp_path / "points.las", points, np.zeros((50, 3), np.uint8))
    read_back = np.asarray(laspy.read(tmp_path / "points.las").xyz)
    assert np.abs(read_back - points).max() <= 0.51 * scale[0] + np.spacing(abs(place))
    assert scale[0] <= max(1e-8 * extent, 10 * np.spacing(np.abs(points).max()), 1e-29)
