"""Distances of sparse points: closed forms, uncertainty, both files of COLMAP, and what cannot be used."""

import json
import math
import struct

import numpy as np
import pytest
import torch
from PIL import Image
from support.posed_captures import Known, read, write_colmap, write_transforms

from nerf_lightning.data.captures.known_depths import CERTAIN, depths_of_points
from nerf_lightning.nerf.geometry.cameras import pinhole_cameras, rays_through_pixels

POINT = torch.tensor([[0.0, 0.0, -4.0]], dtype=torch.float64)


def two_cameras(apart):
    """Side by side, looking along -z, focal length 100 pixels of 101 x 101."""
    c2w = torch.eye(4, dtype=torch.float64)[:3].repeat(2, 1, 1)
    c2w[:, 0, 3] = torch.tensor([-0.5 * apart, 0.5 * apart], dtype=torch.float64)
    return pinhole_cameras(c2w, 100.0, 101, 101)


def depths(points=POINT, errors=(0.5,), apart=1.0, tracks=((0, 0), (0, 1))):
    return depths_of_points(points, torch.tensor(errors, dtype=torch.float64), torch.tensor(tracks), two_cameras(apart))


def test_distance_and_pixel_of_a_point():
    found = depths()
    assert found.distance.tolist() == pytest.approx([math.hypot(0.5, 4.0)] * 2)
    assert found.pixels.view.tolist() == [0, 1]
    assert found.pixels.x.tolist() == [63, 38]
    assert found.pixels.y.tolist() == [50, 50]


def test_certainty_is_the_angle_between_the_rays_against_the_error():
    angle = 2.0 * math.atan(0.5 / 4.0)
    relative = 0.5 / 100.0 / angle
    expected = 1.0 / (1.0 + (relative / CERTAIN) ** 2)
    assert depths().certainty.tolist() == pytest.approx([expected] * 2, rel=1e-5)
    assert float(depths(errors=(1.0,)).certainty[0]) < expected
    assert len(depths(apart=1e-3)) == 0


@pytest.mark.parametrize("error", [math.nan, -1.0])
def test_an_unknown_error_is_a_pixel(error):
    torch.testing.assert_close(depths(errors=(error,)).certainty, depths(errors=(1.0,)).certainty)


@pytest.mark.parametrize("z", [4.0, -0.1])
def test_a_point_behind_the_camera_or_outside_of_its_picture_is_left_out(z):
    assert len(depths(torch.tensor([[0.0, 0.0, z]], dtype=torch.float64))) == 0


def with_tracks(root, known, kind):
    """A model in which every view has seen every point; image i has the number i + 10."""
    write_colmap(root, known, kind)
    views = range(len(known.names))
    if kind == ".bin":
        content = struct.pack("<Q", len(known.points))
        for number, point in enumerate(known.points):
            track = [value for view in views for value in (view + 10, 0)]
            content += struct.pack(f"<Q3d3BdQ{len(track)}I", number, *point, 9, 9, 9, 0.5, len(views), *track)
        (root / "sparse" / "0" / "points3D.bin").write_bytes(content)
    else:
        track = " ".join(f"{view + 10} 0" for view in views)
        rows = [f"{n} {' '.join(map(repr, map(float, p)))} 9 9 9 0.5 {track}" for n, p in enumerate(known.points)]
        (root / "sparse" / "0" / "points3D.txt").write_text("\n".join(rows) + "\n")
    return root


@pytest.mark.parametrize("kind", [".bin", ".txt"])
def test_points_of_a_colmap_model_lie_on_the_rays_of_their_pixels(tmp_path, kind):
    known = Known(size=(160, 120), focal=(200.0, 200.0), center=(80.0, 60.0))
    scene = read("colmap", with_tracks(tmp_path, known, kind), space="contracted")
    assert len(scene.depths) > 300
    rays = rays_through_pixels(scene.cameras, scene.depths.pixels, scene.near, scene.far)
    ends = rays.origins + scene.depths.distance[:, None] * rays.directions
    nearest = torch.cdist(ends, scene.points).amin(dim=1)
    # Within a pixel, which is a 200th of the distance wide.
    assert float((nearest / scene.depths.distance).max()) < 1.0 / 200


def test_frames_that_are_left_out_take_their_depths_with_them(tmp_path):
    root = with_tracks(tmp_path, Known(size=(160, 120), focal=(200.0, 200.0), center=(80.0, 60.0)), ".bin")
    everything, some = read("colmap", root).depths, read("colmap", root, frames="p_[2-8].png").depths
    of_view = [int((each.pixels.view == view).sum()) for each, view in ((everything, 2), (some, 0))]
    assert of_view[0] == of_view[1] > 0
    assert sorted(some.pixels.view.unique().tolist()) == list(range(7))


def test_a_model_that_says_not_where_points_were_seen_has_no_depths(tmp_path):
    root = write_colmap(tmp_path, Known(), ".txt")
    points = root / "sparse" / "0" / "points3D.txt"
    points.write_text("\n".join(" ".join(line.split()[:4]) for line in points.read_text().splitlines()) + "\n")
    scene = read("colmap", root)
    assert scene.depths is None
    assert len(scene.points) == 60


def test_tracks_that_name_no_photograph_are_left_out(tmp_path):
    root = with_tracks(tmp_path, Known(size=(160, 120), focal=(200.0, 200.0), center=(80.0, 60.0)), ".bin")
    path = root / "sparse" / "0" / "points3D.bin"
    before = len(read("colmap", root).depths)
    content = bytearray(path.read_bytes())
    at = content.index(struct.pack("<2I", 10, 0))
    content[at : at + 4] = struct.pack("<I", 4_000_000)
    path.write_bytes(content)
    assert before - 1 <= len(read("colmap", root).depths) <= before
    assert np.isfinite(read("colmap", root).depths.distance.numpy()).all()


def with_sensor(root, maps):
    """A capture of walls at depth 3, square to each camera, measured in millimeters by some of its views."""
    write_transforms(root, Known(size=(64, 48), focal=(60.0, 60.0), center=(32.0, 24.0)))
    content = json.loads((root / "transforms.json").read_text())
    (root / "depth").mkdir()
    for number, picture in enumerate(maps):
        if picture is not None:
            picture.save(root / "depth" / f"{number}.png")
        content["frames"][number]["depth_file_path"] = f"depth/{number}.png"
    (root / "transforms.json").write_text(json.dumps(content))
    return root


def a_map(width=32, height=24, level=3000):
    levels = np.full((height, width), level, np.uint16)
    levels[: height // 2, : width // 2] = 0
    return Image.fromarray(levels)


def test_depth_maps_of_a_sensor_are_distances_along_rays(tmp_path, caplog):
    scene = read("transforms", with_sensor(tmp_path, [a_map(), a_map(64, 48)]), space="contracted")
    depths, unit = scene.depths, float(scene.to_user[:3, 0].norm())
    assert depths.pixels.view.unique().tolist() == [0, 1]
    assert not bool(((depths.pixels.x < 31) & (depths.pixels.y < 23)).any())
    rays = rays_through_pixels(scene.cameras, depths.pixels, scene.near, scene.far)
    ahead = -(rays.directions * scene.cameras.c2w[depths.pixels.view, :, 2]).sum(dim=-1) * depths.distance * unit
    assert ahead.tolist() == pytest.approx([3.0] * len(depths), rel=1e-4)
    assert "left out" not in caplog.text


def test_depth_maps_that_cannot_be_used_are_left_out_and_named_once(tmp_path, caplog):
    colours = Image.new("RGB", (32, 24))
    root = with_sensor(tmp_path, [a_map(), a_map(24, 24), colours, None, a_map(level=0)])
    scene = read("transforms", root)
    assert scene.depths.pixels.view.unique().tolist() == [0]
    lines = [record.message for record in caplog.records if "depth maps" in record.message]
    assert len(lines) == 1
    assert lines[0].startswith("2 depth maps are left out: 1.png has another shape than its photograph")
    assert "2.png is not a 16-bit grayscale picture" in lines[0]


def test_a_map_of_many_pixels_is_thinned(tmp_path):
    scene = read("transforms", with_sensor(tmp_path, [a_map(640, 480)]))
    assert 1500 < len(scene.depths) <= 4096
