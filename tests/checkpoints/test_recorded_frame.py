"""A capture that is read with other settings is looked at from where the checkpoint's model expects it."""

from dataclasses import replace

import pytest
import torch
from support.posed_captures import Known, read, ring, wall, write_colmap, write_llff
from support.scenes import ball_scene
from support.wrong_cameras import with_noise

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.checkpoints.record import make_record, scene_record
from nerf_lightning.checkpoints.recorded_frame import as_trained, in_recorded_frame
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.nerf.geometry.poses import rotation_from_vector
from nerf_lightning.nerf.geometry.world_frame import poses_from_user, similarity, unit_of
from nerf_lightning.nerf.refinements.displacements import align_untrained_cameras


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


SCENE = ball_scene()
LEARNT = align_untrained_cameras(
    SCENE.cameras, with_noise(SCENE, 1.0, 0.01, views=(0, 1, 2)).cameras, SCENE.splits["train"]
)
LENS = torch.tensor([[0.05, -0.01, 0.0, 0.0, 0.0, 0.0]] * 6)
LEARNT = replace(LEARNT, focal=1.05 * SCENE.cameras.focal, lens=LENS, lens_model="radial_tangential")


def saved(path, refined=LEARNT, **changed):
    record = make_record(SCENE, config="", choices={}) | {"precision": "32-true", "tile_points": None}
    if refined is not None:
        record["refined"] = dict(vars(refined)) | changed
    torch.save({"state_dict": {}, "global_step": 0, "nerf_lightning": record}, path / "last.ckpt")
    return path / "last.ckpt"


def test_what_is_read_has_the_refined_cameras_and_knows_the_given_ones(tmp_path):
    checkpoint = read_checkpoint(saved(tmp_path))
    assert torch.equal(checkpoint.scene.cameras.c2w, LEARNT.c2w)
    assert torch.equal(checkpoint.given_cameras.c2w, SCENE.cameras.c2w)
    plain = read_checkpoint(saved(tmp_path, refined=None))
    assert plain.given_cameras is None
    assert torch.equal(plain.scene.cameras.c2w, SCENE.cameras.c2w)
    assert as_trained(SCENE, plain) is SCENE


def test_what_no_training_refines_is_refused(tmp_path):
    wrong = {
        r"refined\.c2w": {"c2w": 2.0 * LEARNT.c2w},
        r"refined\.focal": {"focal": LEARNT.focal[:4]},
        r"refined\.lens_model": {"lens_model": "squinting"},
    }
    for said, changed in wrong.items():
        with pytest.raises(InputError, match=f"is damaged, or was made by somebody else: .*{said}"):
            read_checkpoint(saved(tmp_path, **changed))


def test_a_scene_that_is_read_again_gets_them_in_whatever_frame_and_size(tmp_path):
    checkpoint = read_checkpoint(saved(tmp_path))
    rotation = rotation_from_vector(torch.tensor([0.2, 0.5, -0.4]))
    to_user = similarity(rotation, torch.tensor([1.0, 0.0, 2.0]), 2.0)
    cameras = SCENE.cameras
    again = replace(
        SCENE,
        cameras=replace(cameras, c2w=poses_from_user(cameras.c2w.double(), to_user).float(), focal=0.5 * cameras.focal),
        to_user=to_user,
    )
    found = as_trained(again, checkpoint)
    assert found.refined
    torch.testing.assert_close(found.cameras.c2w, LEARNT.c2w, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.cameras.focal, 0.5 * LEARNT.focal)
    assert found.cameras.lens_model == "radial_tangential"
    assert torch.equal(found.cameras.lens, LENS)


def test_photographs_of_another_capture_go_where_the_cameras_went_as_a_whole(tmp_path):
    checkpoint = read_checkpoint(saved(tmp_path))
    other = with_noise(SCENE, 20.0, 0.1)  # of the same names
    expected = align_untrained_cameras(replace(SCENE.cameras, c2w=SCENE.cameras.c2w), LEARNT, SCENE.splits["train"])
    found = as_trained(other, checkpoint)
    assert torch.equal(found.cameras.focal, other.cameras.focal)
    assert float((found.cameras.c2w - other.cameras.c2w).abs().max()) < 0.1
    assert not torch.allclose(found.cameras.c2w[:3], expected.c2w[:3], atol=1e-2)
