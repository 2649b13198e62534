"""One capture in every format: the readers must agree with what was written."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.posed_captures import (
    Known,
    frames_of,
    intrinsics_of,
    photograph,
    read,
    ring,
    user_rays,
    wall,
    write_colmap,
    write_instant_ngp,
    write_json,
    write_llff,
    write_pictures,
    write_transforms,
)

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.world_frame import unit_of

PLACES = [(0.0, 0.0), (0.99, 0.0), (0.5, 0.5), (0.2, 0.9)]


def true_rays(known, view, at=PLACES):
    """Return the rays through pixel centers, by numpy alone."""
    pixels = np.floor(np.array(at) * known.size) + 0.5
    plane = (pixels - known.center) / known.focal
    local = np.stack([plane[:, 0], -plane[:, 1], -np.ones(len(at))], axis=1)
    directions = local @ known.c2w[view, :, :3].T
    origins = np.broadcast_to(known.c2w[view, :, 3], directions.shape)
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def assert_true(scene, known, names=None):
    for view, name in enumerate(names or known.names):
        for found, true in zip(user_rays(scene, name, PLACES), true_rays(known, view), strict=True):
            np.testing.assert_allclose(found.numpy(), true, atol=3e-5)


def write(kind, root, known):
    if kind == "llff":
        return "llff", write_llff(root, known), [*known.names]
    if kind.startswith("colmap"):
        return "colmap", write_colmap(root, known, f".{kind[-3:]}"), [*known.names]
    writer = write_transforms if kind == "nerfstudio" else write_instant_ngp
    return "transforms", writer(root, known), [f"images/{name}" for name in known.names]


@pytest.mark.parametrize("kind", ["llff", "colmap_bin", "colmap_txt", "nerfstudio", "instant_ngp"])
@pytest.mark.parametrize(("poses", "space"), [(ring(), "bounded"), (ring(), "auto"), (wall(), "auto")])
def test_all_formats_give_the_same_rays_in_the_users_frame(tmp_path, kind, poses, space):
    known = Known(c2w=poses, points=Known().points + np.array([0.0, 5.0, 0.0]))
    reader, root, names = write(kind, tmp_path / "capture", known)
    scene = read(reader, root, space=space)
    assert_true(scene, known, names)
    forward = np.array_equal(poses, wall())
    if space == "auto" and reader != "transforms":
        assert scene.space == ("ndc" if forward else "contracted")
    # The pictures are those of the names, in their order.
    view = scene.view_names.index(names[4])
    assert np.array_equal(scene.pixels.view(view)[..., :3].numpy(), photograph(4, *known.size))
    assert scene.splits["test"] == (0, 8)
    assert scene.splits["train"] == tuple(range(1, 8))


@pytest.mark.parametrize("downscale", [1, 2, 3])
def test_intrinsics_follow_the_folder_and_the_downscale(tmp_path, downscale):
    known = Known(size=(17, 12), focal=(20.0, 21.0), center=(7.5, 6.5))
    full = Known(size=(68, 48), focal=(80.0, 84.0), center=(30.0, 26.0))
    write_colmap(tmp_path / "c", full, pictures=False)
    write_pictures(tmp_path / "c" / "images_4", known.names, known.size)
    cameras = read("colmap", tmp_path / "c", images="images_4", downscale=downscale).cameras
    assert cameras.width[0] == 17 // downscale
    assert cameras.height[0] == 12 // downscale
    np.testing.assert_allclose(cameras.focal[0] * downscale, known.focal, rtol=1e-6)
    np.testing.assert_allclose(cameras.center[0] * downscale, known.center, rtol=1e-6)


def test_llffs_hwf_of_the_full_size_goes_with_images_8(tmp_path):
    known = Known()
    scene = read("llff", write_llff(tmp_path / "c", known, folder="images_8", hwf_times=8.0))
    assert_true(scene, known)


def test_llff_takes_the_least_shrunk_folder_unless_told(tmp_path):
    known = Known()
    root = write_llff(tmp_path / "c", known, folder="images_4")
    write_pictures(root / "images_2", known.names, (32, 24))
    assert int(read("llff", root).cameras.width[0]) == 32
    assert int(read("llff", root, images="images_4").cameras.width[0]) == 16


def test_each_image_may_have_a_camera_and_a_size_of_its_own(tmp_path):
    known = Known()
    write_pictures(tmp_path / "images", known.names, known.size)
    frames = frames_of(known)
    Image.fromarray(photograph(2, 10, 20)).save(tmp_path / "images" / known.names[2])
    frames[2] |= {"fl_x": 31.0, "fl_y": 32.0, "cx": 4.0, "cy": 11.0, "w": 10, "h": 20}
    frames[3] |= {"fl_x": 44.0}
    scene = read("transforms", write_json(tmp_path, intrinsics_of(known) | {"frames": frames}))
    assert scene.cameras.focal[1:4].tolist() == [[20.0, 20.0], [31.0, 32.0], [44.0, 20.0]]
    assert scene.cameras.center[2].tolist() == [4.0, 11.0]
    assert (scene.pixels.width[2], scene.pixels.height[2]) == (10, 20)
    assert np.array_equal(scene.pixels.view(2)[..., :3].numpy(), photograph(2, 10, 20))


@pytest.mark.parametrize(
    ("camera", "params", "model", "focal", "lens"),
    [
        ("SIMPLE_PINHOLE", (21, 8, 6), "pinhole", (21, 21), (0, 0, 0, 0, 0, 0)),
        ("PINHOLE", (21, 22, 8, 6), "pinhole", (21, 22), (0, 0, 0, 0, 0, 0)),
        ("SIMPLE_RADIAL", (21, 8, 6, 0.1), "radial_tangential", (21, 21), (0.1, 0, 0, 0, 0, 0)),
        ("RADIAL", (21, 8, 6, 0.1, 0.02), "radial_tangential", (21, 21), (0.1, 0.02, 0, 0, 0, 0)),
        ("OPENCV", (21, 22, 8, 6, 0.1, 0.2, 0.03, 0.04), "radial_tangential", (21, 22), (0.1, 0.2, 0, 0, 0.03, 0.04)),
        ("OPENCV_FISHEYE", (21, 22, 8, 6, 0.1, 0.2, 0.3, 0.4), "fisheye", (21, 22), (0.1, 0.2, 0.3, 0.4, 0, 0)),
    ],
)
@pytest.mark.parametrize("kind", [".bin", ".txt"])
def test_colmaps_lenses(tmp_path, kind, camera, params, model, focal, lens):
    cameras = read("colmap", write_colmap(tmp_path / "c", Known(camera=camera, params=params), kind)).cameras
    assert cameras.lens_model == model
    assert cameras.focal[3].tolist() == list(focal)
    assert cameras.center[3].tolist() == [8, 6]
    np.testing.assert_allclose(cameras.lens[3], lens, rtol=1e-6)


@pytest.mark.parametrize(
    ("top", "model", "lens"),
    [
        ({}, "pinhole", (0, 0, 0, 0, 0, 0)),
        ({"camera_model": "PINHOLE", "k1": 0.0}, "pinhole", (0, 0, 0, 0, 0, 0)),
        ({"k1": 0.1, "k2": 0.2, "p1": 0.03, "p2": 0.04}, "radial_tangential", (0.1, 0.2, 0, 0, 0.03, 0.04)),
        ({"camera_model": "OPENCV", "k1": 0.1, "k3": 0.01, "k4": 0.2}, "radial_tangential", (0.1, 0, 0.01, 0.2, 0, 0)),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.1}, "fisheye", (0, 0, 0, 0.1, 0, 0)),
        ({"is_fisheye": True, "k1": 0.1}, "fisheye", (0.1, 0, 0, 0, 0, 0)),
    ],
)
def test_the_lenses_of_a_transforms_json(tmp_path, top, model, lens):
    cameras = read("transforms", write_transforms(tmp_path / "c", Known(), **top)).cameras
    assert cameras.lens_model == model
    np.testing.assert_allclose(cameras.lens[0], lens, rtol=1e-6)


def test_masks_may_keep_black(tmp_path):
    root = write_transforms(tmp_path / "c", Known())
    (root / "masks" / "images").mkdir(parents=True)
    for view, name in enumerate(Known().names):
        mask = np.zeros((12, 16), np.uint8)
        mask[view] = 255
        Image.fromarray(mask).save(root / "masks" / "images" / name)
    for _ in range(2):  # once from the cache
        scene = read("transforms", root, masks="masks", masks_keep="black")
        for view in range(9):
            assert not bool(scene.pixels.view_mask(view)[view].any())
            assert int(scene.pixels.view_mask(view).sum()) == 11 * 16
    assert int(read("transforms", root, masks="masks").pixels.view_mask(0).sum()) == 16


def test_three_photographs_with_poses_make_a_scene(tmp_path):
    scene = read("colmap", write_colmap(tmp_path / "c", Known(c2w=ring(3))))
    assert scene.splits == {"train": (1, 2), "val": (0,), "test": (0,)}


def test_without_sparse_points_the_depth_that_ndc_needs_is_asked_for(tmp_path):
    root = write_colmap(tmp_path / "c", Known(c2w=wall(), points=np.zeros((0, 3))))
    assert read("colmap", root).space == "contracted"
    with pytest.raises(InputError, match=r"space=ndc needs the depth .* neither bounds nor enough sparse points.*near"):
        read("colmap", root, space="ndc")
    assert read("colmap", root, space="ndc", near=2.0).space == "ndc"


def test_a_frames_own_mask_and_a_folder_that_overrules_it(tmp_path):
    known = Known()
    write_pictures(tmp_path / "images", known.names, known.size)
    for folder, column in (("own", 0), ("other", 5)):
        (tmp_path / folder / "images").mkdir(parents=True)
        mask = np.full((12, 16), 255, np.uint8)
        mask[:, column] = 0
        for name in known.names:
            Image.fromarray(mask).save(tmp_path / folder / "images" / name)
    frames = frames_of(known)
    frames[1]["mask_path"] = f"own\\images\\{known.names[1]}"
    write_json(tmp_path, intrinsics_of(known) | {"frames": frames})
    scene = read("transforms", tmp_path)
    assert bool(scene.pixels.view_mask(0).all())
    assert not bool(scene.pixels.view_mask(1)[:, 0].any())
    scene = read("transforms", tmp_path, masks="other")
    assert not bool(scene.pixels.view_mask(1)[:, 5].any())
    assert bool(scene.pixels.view_mask(1)[:, 0].all())


def test_the_frames_filter(tmp_path):
    known = Known(c2w=ring(12), names=tuple(f"{'ab'[view % 2]}_{view:02d}.png" for view in range(12)))
    for kind, root in (("llff", write_llff(tmp_path / "l", known)), ("colmap", write_colmap(tmp_path / "c", known))):
        scene = read(kind, root, frames="b_*", hold_every=3)
        assert scene.view_names == tuple(f"b_{view:02d}.png" for view in range(1, 12, 2))
        assert scene.splits["test"] == (0, 3)
        assert scene.protocol["frames"] == "b_*"
        for view in range(1, 12, 2):
            found = user_rays(scene, known.names[view], PLACES)[1]
            np.testing.assert_allclose(found, true_rays(known, view)[1], atol=3e-5)


@pytest.mark.parametrize("naming", [lambda n: f"images/{n}", lambda n: f"./images/{n}", lambda n: f"images\\{n}"])
def test_splits_by_lists_of_names(tmp_path, naming):
    known = Known()
    names = [naming(name) for name in known.names]
    root = write_transforms(
        tmp_path / "c", known, train_filenames=names[3:], val_filenames=names[:1], test_filenames=names[1:3]
    )
    assert read("transforms", root).splits == {"train": (3, 4, 5, 6, 7, 8), "val": (0,), "test": (1, 2)}
    # Numbers follow the filter.
    assert read("transforms", root, frames="*_[0245].png").splits == {"train": (2, 3), "val": (0,), "test": (1,)}


def test_splits_by_lists_without_endings(tmp_path):
    known = Known()
    root = write_instant_ngp(tmp_path / "c", known)
    content = json.loads((root / "transforms.json").read_text())
    content |= {"train_filenames": [f"images/p_{view}" for view in range(6)], "test_filenames": ["./images/p_7"]}
    splits = read("transforms", write_json(root, content)).splits
    assert splits == {"train": tuple(range(6)), "val": (7,), "test": (7,)}


def test_splits_by_folders(tmp_path):
    known = Known(names=tuple(f"{'test' if view % 4 == 1 else 'train'}/{view}.png" for view in range(9)))
    root = write_transforms(tmp_path / "c", known)
    assert read("transforms", root).splits == {"train": (0, 2, 3, 4, 6, 7, 8), "val": (1, 5), "test": (1, 5)}


def test_applied_transform_and_scale_are_undone(tmp_path):
    known = Known()
    applied = np.array([[0.0, 1, 0, 3], [1, 0, 0, -2], [0, 0, -1, 1]])
    moved = known.moved(2.5, applied[:, :3], 2.5 * applied[:, 3])
    root = write_transforms(tmp_path / "c", moved, applied_transform=applied.tolist(), applied_scale=2.5)
    assert_true(read("transforms", root), known, [f"images/{name}" for name in known.names])
    # Without the two, the user's frame is the file's.
    root = write_transforms(tmp_path / "d", moved)
    assert_true(read("transforms", root), moved, [f"images/{name}" for name in known.names])


@pytest.mark.parametrize("kind", ["llff", "colmap_bin", "colmap_txt", "nerfstudio", "instant_ngp"])
def test_names_with_spaces_and_letters_of_all_languages(tmp_path, kind):
    names = tuple(sorted(f"IMG {view}  Füße 写真 é{view}.png" for view in range(9)))
    known = Known(names=names)
    reader, root, read_as = write(kind, tmp_path / "ein Ordner 写真", known)
    assert_true(read(reader, root), known, read_as)


def test_photographs_without_pose_are_named(tmp_path, caplog):
    write_colmap(tmp_path / "c", Known())
    write_transforms(tmp_path / "d", Known())
    for name in ("lost.jpg", "sub/lost.png"):
        write_pictures(tmp_path / "c" / "images", (name,), (16, 12))
    write_pictures(tmp_path / "d" / "images", ("zzz.png",), (16, 12))
    (tmp_path / "c" / "images" / "notes.txt").write_text("no picture")
    assert len(read("colmap", tmp_path / "c").view_names) == len(read("transforms", tmp_path / "d").view_names) == 9
    assert "2 photographs have no pose and are left out: lost.jpg, sub/lost.png" in caplog.text
    assert "1 photographs have no pose and are left out: images/zzz.png" in caplog.text
    assert "scene=photos" not in caplog.text
    many = tuple(f"lost_{number}.png" for number in range(10))
    write_pictures(tmp_path / "d" / "images", many, (16, 12))
    read("transforms", tmp_path / "d")
    assert "let their cameras be found: scene=photos scene.root=FOLDER" in caplog.text


def test_of_a_model_in_binary_and_in_text_the_binary_is_read(tmp_path, caplog):
    known = Known()
    write_colmap(tmp_path / "c", replace(known, focal=(21.0, 20.0)), ".txt")
    with caplog.at_level("INFO"):
        assert_true(read("colmap", write_colmap(tmp_path / "c", known, ".bin")), known)
    assert "in binary and in text: the binary one is read" in caplog.text


def test_blank_lines_of_a_text_model_and_photographs_without_features(tmp_path):
    known = Known()
    root = write_colmap(tmp_path / "c", known, ".txt")
    path = root / "sparse" / "0" / "images.txt"
    path.write_text("\n" + path.read_text().replace("3.0 4.0 -1", "").rstrip() + "\n\n\n")
    assert_true(read("colmap", root), known)


def test_sparse_points_come_along_in_scene_units(tmp_path):
    known = Known()
    scene = read("colmap", write_colmap(tmp_path / "c", known))
    back = scene.points.double() @ scene.to_user[:3, :3].T + scene.to_user[:3, 3]
    np.testing.assert_allclose(back, known.points, atol=1e-5)
    # Near is half the first percentile of the depths, whatever the unit.
    depths = np.sort(-((known.points - known.c2w[0, :, 3]) @ known.c2w[0, :, :3])[:, 2])
    assert 0.4 * depths[0] < float(scene.near[0]) * unit_of(scene.to_user) < 0.5 * depths[4]


def test_far_reaches_behind_the_farthest_points(tmp_path):
    far_away = np.random.default_rng(0).normal(0, 200.0, (2000, 3))
    assert float(read("colmap", write_colmap(tmp_path / "a", Known())).far.max()) == 16.0
    assert float(read("colmap", write_colmap(tmp_path / "b", Known(points=far_away))).far.max()) > 100.0


@pytest.mark.parametrize("space", ["bounded", "contracted"])
def test_near_and_far_are_the_users_word_in_his_units(tmp_path, space):
    scene = read("colmap", write_colmap(tmp_path / "c", Known()), space=space, near=3.0, far=3.5)
    unit = unit_of(scene.to_user)
    assert unit == pytest.approx(4.2, abs=0.6)
    np.testing.assert_allclose(scene.near * unit, 3.0, rtol=1e-5)
    np.testing.assert_allclose(scene.far * unit, 3.5, rtol=1e-5)


def test_the_near_plane_of_a_forward_facing_capture_is_the_users_word(tmp_path):
    known = Known(c2w=wall())
    scene = read("llff", write_llff(tmp_path / "c", known), near=1.25)
    assert scene.space == "ndc"
    assert unit_of(scene.to_user) == pytest.approx(1.25)
