"""What is said of a capture that is not the one of a checkpoint."""

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import make_record
from nerf_lightning.checkpoints.same_capture import changes, depth_sums, require_same_capture
from nerf_lightning.data.pixels import decoded_photographs as hashes
from nerf_lightning.data.pixels.decoded_photographs import photograph_hashes
from nerf_lightning.nerf.geometry.world_frame import poses_from_user
from nerf_lightning.nerf.types.rays import KnownDepths, PixelIndex

SCENE = ball_scene()


def record(scene):
    return make_record(scene, "", {}) | {"pixels": photograph_hashes(scene.pixels), "depths": depth_sums(scene)}


def told(scene):
    return changes(record(SCENE), record(scene))


def with_cameras(**changed):
    return replace(SCENE, cameras=replace(SCENE.cameras, **changed))


def with_pixels(**changed):
    return replace(SCENE, pixels=replace(SCENE.pixels, **changed))


def changed_at(tensor, *place, by):
    tensor = tensor.clone()
    tensor[place] += by
    return tensor


def reordered(order):
    cameras, store = SCENE.cameras[torch.tensor(order)], SCENE.pixels
    place = {old: new for new, old in enumerate(order)}
    return replace(
        SCENE,
        cameras=cameras,
        pixels=replace(store, offset=store.offset[torch.tensor(order)]),
        view_names=tuple(SCENE.view_names[view] for view in order),
        splits={split: tuple(place[view] for view in views) for split, views in SCENE.splits.items()},
    )


def in_another_frame(scene):
    """The scene in a working frame that is turned, moved and of another unit."""
    frame = torch.tensor([[0.0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    c2w = poses_from_user(scene.cameras.c2w.double(), frame.double()).float()
    return replace(scene, cameras=replace(scene.cameras, c2w=c2w), to_user=scene.to_user @ frame.double())


def test_the_same_capture_is_the_same_to_rounding_and_one_without_hashes_is_compared_by_what_it_has():
    assert told(SCENE) == []
    assert told(with_cameras(c2w=SCENE.cameras.c2w * (1 + 1e-7), focal=SCENE.cameras.focal * (1 + 1e-7))) == []
    old = record(SCENE)
    del old["pixels"]
    assert changes(old, record(with_pixels(rgba=255 - SCENE.pixels.rgba))) == []
    assert changes(old, record(reordered([1, 0, 2, 3, 4, 5]))) == ["the order of the photographs"]


ALL = "6 of 6 photographs (ball_0, ball_1, ball_2 and 3 more)"
CHANGED = {
    "the pose of 1 of 6 photographs (ball_2)": with_cameras(c2w=changed_at(SCENE.cameras.c2w, 2, 0, 3, by=0.01)),
    f"the focal length of {ALL}": with_cameras(focal=SCENE.cameras.focal * 1.01),
    "the principal point of 1 of 6 photographs (ball_1)": with_cameras(
        center=changed_at(SCENE.cameras.center, 1, 0, by=0.5)
    ),
    f"the lens of {ALL}": with_cameras(lens_model="fisheye"),
    "the pixels of 1 of 6 photographs (ball_4)": with_pixels(rgba=changed_at(SCENE.pixels.rgba, 700, 1, by=1)),
    "the order of the photographs": reordered([1, 0, 2, 3, 4, 5]),
    "1 of 6 photographs are gone (ball_0); 1 of 6 photographs are new (new)": replace(
        SCENE, view_names=("new", *SCENE.view_names[1:])
    ),
    "the use (training, validation or test) of 1 of 6 photographs (ball_2)": replace(
        SCENE, splits=SCENE.splits | {"train": (0, 1), "test": (2, 3, 4, 5)}
    ),
    "where the content lies (near, far, the box, or points of the reconstruction)": replace(SCENE, far=SCENE.far + 1),
    "the background (white there, black here)": replace(SCENE, background="black"),
}


@pytest.mark.parametrize("words", CHANGED)
def test_what_has_changed_is_named(words):
    assert "; ".join(told(CHANGED[words])) == words


def test_one_pose_that_moves_the_frame_is_one_pose_and_a_mask_is_part_of_a_photograph():
    moved = with_cameras(c2w=changed_at(SCENE.cameras.c2w, 2, 0, 3, by=0.01))
    assert told(in_another_frame(moved)) == ["the pose of 1 of 6 photographs (ball_2)"]
    mask = torch.ones(len(SCENE.pixels.rgba), dtype=torch.uint8)
    masked = with_pixels(mask=mask)
    other = with_pixels(mask=changed_at(mask, 0, by=255))
    assert changes(record(masked), record(other)) == ["the pixels of 1 of 6 photographs (ball_0)"]


def measured(scene=SCENE, **changed):
    """The scene, with a depth at three pixels of each view."""
    view, at = torch.arange(18) // 3, torch.arange(18) % 7
    depths = KnownDepths(PixelIndex(view, at, at), 1.0 + at, torch.full((18,), 0.5))
    return replace(scene, depths=replace(depths, **changed))


def test_depths_that_are_learned_from_are_part_of_a_capture():
    distance, before = measured().depths.distance, record(measured())
    for by, views in ((1e-8 * distance, ""), (0.01, "3 of 6 photographs (ball_0, ball_1, ball_2)")):
        after = record(measured(distance=distance + by))  # the other three are held out
        assert changes(before, after) == [f"the depths (of sparse points or depth maps) of {views}"] * bool(views)
    at = measured().depths.pixels
    swapped = record(measured(pixels=replace(at, x=at.x.flip(0))))
    assert [each[:10] for each in changes(before, swapped)] == ["the depths"]
    assert changes(before, record(SCENE)) == changes(before, after)
    assert not depth_sums(measured(from_pictures=True)).any()
    in_half_units = measured(in_another_frame(SCENE), distance=distance / 2)
    torch.testing.assert_close(depth_sums(in_half_units), before["depths"])
    moved = with_cameras(c2w=changed_at(SCENE.cameras.c2w, 2, 0, 3, by=0.01))
    assert changes(before, record(moved)) == ["the pose of 1 of 6 photographs (ball_2)"]
    assert changes(make_record(SCENE, "", {}), before) == []


def test_of_more_pixels_than_memory_holds_some_rows_of_each_photograph_count(monkeypatch):
    monkeypatch.setattr(hashes, "CHECKED_WHOLE", 0)
    monkeypatch.setattr(hashes, "THINNED", SCENE.pixels.rgba.nbytes // 4)
    before = photograph_hashes(SCENE.pixels)
    seen, unseen = (photograph_hashes(replace(SCENE.pixels, rgba=changed_at(SCENE.pixels.rgba, at, by=1)))
                    for at in (4 * 12, 5 * 12))  # fmt: skip
    assert (seen != before).tolist() == [True, *[False] * 5]
    assert torch.equal(unseen, before)


def test_going_on_all_the_same_is_said(caplog):
    require_same_capture(record(SCENE), record(reordered([1, 0, 2, 3, 4, 5])), allow_changed=True)
    assert "the order of the photographs. What was learned about each photograph now applies" in caplog.text
