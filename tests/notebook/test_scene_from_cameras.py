"""Scenes of images and cameras in memory: what a reader makes of the same capture on the disk."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.orbit import MATRIX, SIZE, orbit_cameras, orbit_images, orbit_masks, orbit_poses
from support.posed_captures import Known, read, wall, write_colmap
from support.running import refused

import nerf_lightning as nl


@pytest.mark.parametrize(("poses", "shift"), [(Known().c2w, 0.0), (wall(), 5.0)], ids=["contracted", "ndc"])
def test_frame_extent_and_space_are_those_of_the_reader(poses, shift, tmp_path):
    known = Known(c2w=poses, camera="OPENCV", params=(20.0, 20.0, 8.0, 6.0, 0.1, 0.02, 0.001, 0.002))
    known = replace(known, points=known.points + np.array([0.0, shift, 0.0]))
    write_colmap(tmp_path, known)
    there = read("colmap", tmp_path)
    given = [each.numpy() for each in map(there.pixels.view, range(len(poses)))]
    here = nl.scene_from_cameras(
        given, there.user_cameras, points=known.points, names=there.view_names, held_out=there.splits["test"]
    )
    for name in ("near", "far", "aabb", "to_user", "points"):
        torch.testing.assert_close(getattr(here, name), getattr(there, name), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(here.cameras.c2w, there.cameras.c2w, rtol=1e-5, atol=1e-5)
    assert (here.cameras.ndc is None) == (there.cameras.ndc is None)
    assert torch.equal(here.pixels.rgba, there.pixels.rgba)
    same = ("space", "splits", "view_names", "background")
    assert [getattr(here, name) for name in same] == [getattr(there, name) for name in same]


def test_images_are_bytes_or_shares_with_or_without_alpha_and_masks_keep_what_is_above_0():
    masks, images = orbit_masks(6, SIZE), orbit_images(6, SIZE)
    scene = nl.scene_from_cameras(images, orbit_cameras(), masks=masks)
    assert scene.pixels.view(2)[..., :3].numpy().tolist() == images[2].tolist()
    assert scene.pixels.view_mask(2).numpy().tolist() == masks[2].tolist()
    assert not scene.pixels.has_transparency
    shares = nl.scene_from_cameras(torch.from_numpy(images).float() / 255, orbit_cameras())
    assert torch.equal(shares.pixels.rgba, scene.pixels.rgba)
    clear = np.concatenate([images, np.where(masks, 255, 9).astype(np.uint8)[..., None]], axis=-1)
    seen = nl.scene_from_cameras(clear, orbit_cameras(), background="white")
    assert (seen.space, seen.background, seen.pixels.has_transparency) == ("bounded", "white", True)


@pytest.mark.parametrize(
    ("images", "changed", "parts"),
    [
        (5, {}, ("5 images", "as many cameras")),
        (6, {"masks": np.ones((6, 4, 4))}, ("image 0", "mask (4, 4)")),
        (6, {"names": ["a"] * 6}, ("lists a more than once",)),
        (6, {"held_out": [6]}, ("held_out", "[6]")),
        (6, {"points": np.zeros((3, 2))}, ("points", "(3, 2)")),
        (6, {"background": "blue"}, ("blue",)),
        (6, {"near": 3.0, "far": 2.0}, ("near=3.0", "far=2.0")),
    ],
)
def test_what_makes_no_scene_is_told_in_words(images, changed, parts):
    given = orbit_images(6, SIZE)[:images]
    refused(lambda: nl.scene_from_cameras(given, orbit_cameras(), **changed), parts=parts)


def test_a_bad_camera_or_image_and_what_opencv_cannot_say_or_no_lens_here_has_is_refused():
    given, bad = orbit_images(6, SIZE), orbit_cameras()
    bad.c2w[3, 0, 0] = float("nan")
    refused(lambda: nl.scene_from_cameras(given, bad), parts=("view_0003", "NaN"))
    refused(lambda: nl.scene_from_cameras(given.astype(np.int32), orbit_cameras()), parts=("image 0", "int32", "uint8"))
    skewed = MATRIX.clone()
    skewed[0, 1] = 0.5
    refused(lambda: nl.Cameras.from_opencv(orbit_poses(2), skewed, SIZE), parts=("skewed",))
    refused(lambda: orbit_cameras(distortion=torch.full((8,), 0.01)), parts=("more than 5", "Undistort"))
    ours = orbit_cameras(distortion=torch.zeros(4))
    ours.lens[0, 3] = 0.1
    refused(ours.to_opencv, parts=("k4",))


@pytest.mark.parametrize("distortion", [None, [0.1, 0.02, 0.003, 0.004], [0.1, 0.02, 0.003, 0.004, 0.005]])
@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize("pixel_center", [0.5, 0.0])
def test_cameras_go_to_opencv_and_back(distortion, fisheye, pixel_center):
    if fisheye and distortion is not None:
        distortion = distortion[:4]
    given = None if distortion is None else torch.tensor(distortion)
    ours = orbit_cameras(distortion=given, fisheye=fisheye, pixel_center=pixel_center)
    c2w, matrix, coefficients = ours.to_opencv(pixel_center)
    assert torch.equal(c2w, orbit_poses(6))
    assert torch.equal(matrix[3], MATRIX)
    assert torch.equal(ours.center[0], MATRIX[:2, 2] + 0.5 - pixel_center)
    again = nl.Cameras.from_opencv(c2w, matrix, SIZE, coefficients, fisheye, pixel_center)
    assert all(map(torch.equal, again.tensors(), ours.tensors()))


def test_a_point_is_seen_where_the_formulas_of_opencv_put_it():
    from nerf_lightning.nerf.geometry.cameras import project

    k1, k2, p1, p2, k3 = 0.1, -0.02, 0.001, -0.002, 0.003
    ours = orbit_cameras(distortion=torch.tensor([k1, k2, p1, p2, k3]))
    point, pose = torch.tensor([0.4, -0.3, 0.5]), orbit_poses(6)[2]
    x, y, z = (pose[:, :3].mT @ (point - pose[:, 3])).tolist()
    u, v = x / z, y / z
    r2 = u * u + v * v
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    across = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    down = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    expected = torch.tensor([14.0 * across + 6.0, 14.0 * down + 5.0])
    torch.testing.assert_close(project(ours, 2, point), expected, rtol=1e-5, atol=1e-5)
