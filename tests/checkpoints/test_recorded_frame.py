"""A capture that is read with other settings is looked at from where the checkpoint's model expects it."""

import pytest
import torch
from support.posed_captures import Known, read, ring, wall, write_colmap, write_llff

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.checkpoints.recorded_frame import in_recorded_frame
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.nerf.geometry.world_frame import unit_of


def rays_of(scene, name):
    return rays_through_pixels(
        scene.cameras, all_pixels(scene.cameras, scene.view_names.index(name)), scene.near, scene.far
    )


@pytest.mark.parametrize("space", ["bounded", "contracted", "ndc"])
def test_some_of_the_views_are_seen_along_the_rays_of_training(tmp_path, space):
    root = write_llff(tmp_path, Known(c2w=wall()))
    whole = read("llff", root, space=space)
    some = read("llff", root, space=space, frames="p_[4-8]*")
    assert not torch.allclose(some.to_user, whole.to_user, atol=1e-3)
    moved = in_recorded_frame(some, scene_record(whole))
    for name in some.view_names:
        ours, theirs = rays_of(moved, name), rays_of(whole, name)
        torch.testing.assert_close(ours.origins, theirs.origins, atol=1e-5, rtol=0)
        torch.testing.assert_close(ours.directions, theirs.directions, atol=1e-5, rtol=0)
    torch.testing.assert_close(moved.aabb, whole.aabb)
    assert torch.equal(moved.to_user, whole.to_user)


def test_distances_and_points_follow_the_unit(tmp_path):
    poses = ring()
    poses[-1, :, 3] *= 1.5  # left out below, and it is the farthest camera that the unit follows
    root = write_colmap(tmp_path, Known(c2w=poses))
    whole = read("colmap", root, space="contracted", near=1.0, far=30.0)
    some = read("colmap", root, space="contracted", near=1.0, far=30.0, frames="p_[0-3]*")
    assert unit_of(whole.to_user) > 1.2 * unit_of(some.to_user)
    moved = in_recorded_frame(some, scene_record(whole))
    torch.testing.assert_close(moved.near, whole.near[:4])
    torch.testing.assert_close(moved.far, whole.far[:4])
    torch.testing.assert_close(moved.points, whole.points, atol=1e-5, rtol=0)


def test_another_size_keeps_the_cube_of_ndc(tmp_path):
    # Shrinking crops: 12 rows shrink to 2 of 5, so half the image's height is another.
    root = write_llff(tmp_path, Known(c2w=wall()))
    whole, small = read("llff", root, space="ndc"), read("llff", root, space="ndc", downscale=5)
    assert not torch.allclose(small.cameras.ndc, whole.cameras.ndc)
    assert torch.equal(in_recorded_frame(small, scene_record(whole)).cameras.ndc, whole.cameras.ndc)


def test_the_same_scene_stays_as_it_is_and_another_space_is_refused_by_name(tmp_path):
    scene = read("colmap", write_colmap(tmp_path / "colmap", Known()))
    assert in_recorded_frame(scene, scene_record(scene)) is scene
    root = write_llff(tmp_path / "llff", Known(c2w=wall()))
    whole, other = read("llff", root, space="ndc"), read("llff", root, space="contracted")
    with pytest.raises(InputError, match=r"read with space=contracted, .* with space=ndc\. Give scene\.space=ndc\."):
        in_recorded_frame(other, scene_record(whole))
