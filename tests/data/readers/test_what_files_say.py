"""What the files of a capture say beside poses and pictures: it is used, or named, and nothing is dropped silently."""

import io
import re
import shutil

import numpy as np
import pytest
from PIL import Image, ImageCms, TiffImagePlugin
from support.malformed import edit_frame, edit_json
from support.other_formats import write_ply
from support.plain_capture import (
    ALL,
    KNOWN,
    assert_plain,
    everything_is_said,  # noqa: F401
    plain_rays,  # noqa: F401
    read,
    renamed,
    said_once,
)
from support.posed_captures import photograph, write_colmap, write_transforms

from nerf_lightning.data.pixels.masks import read_mask
from nerf_lightning.data.pixels.picture_files import read_rgba
from nerf_lightning.files.signatures import other_format
from nerf_lightning.messages.errors import InputError


@pytest.fixture
def root(tmp_path):
    return write_transforms(tmp_path / "c", KNOWN)


def top(root, *without, **keys):
    edit_json(root, lambda content: {key: content[key] for key in content if key not in without} | keys)


def each_frame(root, **keys):
    for view in ALL:
        edit_frame(root, view, **{key: value.format(view) for key, value in keys.items()})


def save(path, pixels, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(pixels)).save(path, **options)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"skew": 0.5}, r"not modeled.* skewed pixels \(skew\)$"),
        ({"rolling_shutter": [0, 0.1, 0], "sharpen": 1}, r"a rolling shutter \(rolling_shutter\), other colors \(sha"),
        ({"s1": 0.1, "colour": "red"}, r"this part of the lens \(s1\)$"),
        ({"colour": "red", "other": {}}, r"keys that are not known are ignored: colour$"),
        ({"skew": 0.0, "rolling_shutter": [0, 0, 0], "s1": None, "sharpness": 3.0}, None),
    ],
)
@pytest.mark.parametrize("of_frames", [False, True])
def test_keys_that_are_not_used_are_named_once(root, caplog, keys, words, of_frames):
    for view in ALL if of_frames else ():
        edit_frame(root, view, **keys)
    top(root, **({} if of_frames else keys))
    read(root)
    if words:
        said_once(caplog, words)
    else:
        assert not re.search("not modeled|not known", caplog.text)


@pytest.mark.parametrize(
    ("without", "keys"),
    [
        (("fl_x", "fl_y"), {"x_fov": np.degrees(2 * np.arctan(8 / 20)), "y_fov": np.degrees(2 * np.arctan(6 / 20))}),
        (("fl_x", "fl_y"), {"y_fov": np.degrees(2 * np.arctan(6 / 20))}),
        ((), {"x_fov": 10.0}),
    ],
)
def test_fields_of_view_in_degrees_are_read_where_no_focal_length_is_given(root, plain, without, keys):
    top(root, *without, **keys)
    assert_plain(read(root), plain)


@pytest.mark.parametrize(("frames", "remaining"), [(ALL, 0), ((4,), 8)])
@pytest.mark.parametrize(
    "keys",
    [
        {"camera_model": " full_opencv ", "k4": 0.1},
        {"k5": 0.1},
        {"k6": -0.01},
        {"camera_model": "FULL_OPENCV", "k4": 0.1},
    ],
)
def test_a_rational_lens_is_never_read_as_another_one(root, caplog, frames, remaining, keys):
    for view in frames:
        edit_frame(root, view, **keys)
    if remaining:
        assert len(read(root).view_names) == remaining
        said_once(caplog, r"divide the distortion \(a rational lens\)")
    else:
        with pytest.raises(InputError, match=r"k[456].* divide the distortion"):
            read(root)


SIXTEEN = np.full((12, 16), 4000, np.uint16)
DEPTHS = [
    ("depth_file_path", ".png", SIXTEEN, {}, {}, 4.0),
    ("depth_file_path", ".png", SIXTEEN, {"depth_unit_scale_factor": 1e-4}, {}, 0.4),
    ("depth_file_path", ".png", SIXTEEN, {"depth_unit_scale_factor": 1e-4}, {"scene": {"depth_unit": 0.01}}, 40.0),
    ("depth_path", ".png", SIXTEEN, {"integer_depth_scale": 0.002}, {}, 8.0),
    ("depth_file_path", ".npy", np.full((3, 4), 4.0), {}, {}, 4.0),
    ("depth_file_path", ".npy", np.full((12, 16, 1), 4000.0, np.float32), {"depth_unit_scale_factor": 1e-3}, {}, 4.0),
    ("depth_file_path", ".npy", SIXTEEN, {}, {}, 4.0),
    ("depth_file_path", ".NPY", np.full((3, 4), 4.0), {}, {}, 4.0),
    ("depth_path", ".npy", np.where(np.eye(12, 16) > 0, np.nan, 4.0), {}, {}, 4.0),
]


@pytest.mark.parametrize(("key", "ending", "levels", "keys", "typed", "depth"), DEPTHS)
def test_depth_maps_have_the_unit_that_the_file_or_the_user_says(root, key, ending, levels, keys, typed, depth):
    for view in ALL:
        (root / "depths").mkdir(exist_ok=True)
        path = root / f"depths/{view}{ending}"
        if ending == ".png":
            save(path, levels)
        else:
            with path.open("wb") as file:
                np.save(file, levels)
    each_frame(root, **{key: f"depths/{{}}{ending}"})
    top(root, **keys)
    scene = read(root, "transforms", **typed.get("scene", {}))
    unit = float(np.linalg.det(scene.to_user[:3, :3].numpy()) ** (1 / 3))
    nearest = float(scene.depths.distance.min()) * unit  # in the middle of the picture
    assert nearest == pytest.approx(depth, rel=0.01)


@pytest.mark.parametrize("unit", ["1", [1], 0, -1, True, {}, 1e308, 1e-300])
def test_a_unit_of_depths_that_is_none_costs_the_depths_alone(root, caplog, unit):
    top(root, depth_unit_scale_factor=unit)
    read(root)
    assert "Depth maps" not in caplog.text
    save(root / "depths/0.png", SIXTEEN)
    edit_frame(root, 0, depth_file_path="depths/0.png")
    scene = read(root)
    assert scene.depths is None
    assert len(scene.view_names) == 9
    said_once(caplog, "Depth maps are left out: .*depth_unit_scale_factor")


def test_a_depth_map_that_is_no_picture_and_no_plane_is_named(root, caplog):
    (root / "depths").mkdir()
    np.save(root / "depths/0.npy", np.zeros((2, 3, 4)))
    edit_frame(root, 0, depth_file_path="depths/0.npy")
    assert read(root).depths is None
    said_once(caplog, r"1 depth maps are left out: .*0\.npy is not an array of numbers, height by width")


@pytest.mark.parametrize(("level", "key"), [(255, "white_transparent"), (0, "black_transparent")])
@pytest.mark.parametrize("said", [True, False])
def test_a_color_that_means_transparent_is(root, level, key, said):
    for view in ALL:
        picture = photograph(view, *KNOWN.size)
        picture[:6] = level
        save(root / f"images/p_{view}.png", picture)
    top(root, **{key: said})
    alpha = read(root, cut_out=False).pixels.view(3)[..., 3]
    assert bool((alpha[:6] == (0 if said else 255)).all())
    assert bool((alpha[6:] == 255).all())


@pytest.mark.parametrize("size", [(16, 12), (32, 24)])
def test_only_the_circle_of_a_fisheye_counts(root, size):
    factor = size[0] / 16
    top(root, fisheye_crop_radius=4.0 * factor, w=size[0], h=size[1], camera_model="OPENCV_FISHEYE")
    top(root, **{key: value * factor for key, value in {"fl_x": 20, "fl_y": 20, "cx": 8, "cy": 6}.items()})
    kept = read(root).pixels.view_mask(0)
    y, x = np.mgrid[:12, :16] + 0.5
    np.testing.assert_array_equal(kept.bool().numpy(), (x - 8) ** 2 + (y - 6) ** 2 <= 16)


HALF = np.zeros((12, 16), np.uint8)
HALF[:, :8] = 255
CUT_OUT = np.concatenate([photograph(1, 16, 12), HALF[..., None]], axis=-1)


@pytest.mark.parametrize(
    "mask",
    [
        *(HALF.astype(np.uint16), HALF.astype(np.uint16) // 255, HALF.astype(np.uint16) * 257),
        *(HALF, HALF // 255, np.minimum(HALF, 100), np.maximum(HALF, 200), CUT_OUT),
        *(HALF.repeat(4, 0).repeat(4, 1), HALF[::2, ::2]),
    ],
)
def test_masks_of_two_values_cut_outs_and_other_sizes_are_understood(root, mask):
    save(root / "masks/0.png", mask)
    each_frame(root, mask_path="masks/0.png")
    np.testing.assert_array_equal(read(root).pixels.view_mask(2).bool().numpy(), HALF > 0)


def test_ones_everywhere_are_white(tmp_path):
    save(tmp_path / "m.png", np.ones((3, 4), np.uint8))
    assert read_mask(tmp_path / "m.png").all()


@pytest.mark.parametrize("radius", [1e308, 1e-9, -3, "wide", [4]])
def test_an_odd_radius_keeps_all_or_leaves_the_views_out_in_words(root, radius):
    top(root, fisheye_crop_radius=radius, camera_model="OPENCV_FISHEYE")
    if radius == 1e308:
        assert bool(read(root).pixels.view_mask(0).all())
    else:
        with pytest.raises(InputError, match=r"fisheye_crop_radius .*9 of the 9 views"):
            read(root)


@pytest.mark.parametrize("size", [(15, 12), (12, 16), (16, 11), (32, 30), (1, 1), (4, 2)])
def test_masks_of_another_shape_are_refused(root, size):
    save(root / "masks/0.png", np.resize(HALF, size[::-1]))
    each_frame(root, mask_path="masks/0.png")
    with pytest.raises(InputError, match=r"another shape\. Make the mask for this photograph"):
        read(root)


@pytest.mark.parametrize("name", ["p_{}.png", "p_{:03}.png", "P_{:02}_mask.PNG"])
def test_names_of_masks_may_differ_in_zeros_case_and_ending(root, name):
    for view in ALL:
        save(root / "m" / name.format(view), np.roll(HALF, view, axis=1))
    scene = read(root, masks="m")
    for view in ALL:
        np.testing.assert_array_equal(scene.pixels.view_mask(view).bool().numpy(), np.roll(HALF, view, axis=1) > 0)


@pytest.mark.parametrize(
    ("views", "masks", "used", "words"),
    [
        (ALL, None, True, r"has a mask for each photograph, which is used \(scene\.masks=none"),
        (ALL[1:], None, False, r"not used, because it has masks for 8 of 9 photographs; scene\.masks=masks uses it"),
        (ALL, "none", False, None),
    ],
)
@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_a_folder_of_masks_that_nothing_names(tmp_path, caplog, write, views, masks, used, words):
    root = write(tmp_path / "c", KNOWN)
    for view in views:
        save(root / f"masks/p_{view}.png", HALF)
    assert (read(root, masks=masks).pixels.mask is not None) == used
    if words:
        said_once(caplog, words)
    else:
        assert "scene.masks" not in caplog.text


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda folder, view: save(folder / f"p_{view}.png", HALF[:, :10]), "another shape than its photograph"),
        (lambda folder, view: save(folder / f"p_{view}.png", 0 * HALF), "keeps nothing"),
        (lambda folder, view: save(folder / f"p_{view}.png", photograph(view, 16, 12)), "has colors"),
        (lambda folder, view: (folder / f"p_{view}.png").write_bytes(b"no picture"), "is not an image"),
        (lambda folder, view: [save(folder / part / f"p_{view}.png", HALF) for part in "ab"], "equally well"),
    ],
)
def test_a_folder_called_masks_that_holds_something_else_costs_nothing(root, caplog, write, words):
    (root / "masks").mkdir()
    for view in ALL:
        write(root / "masks", view)
    scene = read(root)
    assert scene.pixels.mask is None
    assert len(scene.view_names) == 9
    said_once(caplog, rf"masks is not used, because .*{words}.*; scene\.masks=masks uses it")


def test_instant_ngps_dynamic_masks_leave_out_what_is_white(root):
    save(root / "images/dynamic_mask_p_3.png", HALF)
    pixels = read(root).pixels
    np.testing.assert_array_equal(pixels.view_mask(3).bool().numpy(), HALF == 0)
    assert bool(pixels.view_mask(2).all())


def exchanged():
    """Return the profile of a screen whose red is sRGB's blue."""
    plain = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    return plain.replace(b"rXYZ", b"????").replace(b"bXYZ", b"rXYZ").replace(b"????", b"bXYZ")


def test_colors_are_converted_from_their_profile(tmp_path, caplog):
    rgba = np.concatenate([photograph(0, 16, 12), photograph(1, 16, 12)[..., :1]], axis=-1)
    plain = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for name, profile in {"none": None, "plain": plain, "damaged": b"x" * 200, "exchanged": exchanged()}.items():
        save(tmp_path / f"{name}.png", rgba, icc_profile=profile)
    for name in ("none", "plain", "damaged"):
        np.testing.assert_array_equal(read_rgba(tmp_path / f"{name}.png"), rgba)
    assert "profile" not in caplog.text
    found = read_rgba(tmp_path / "exchanged.png")
    np.testing.assert_allclose(found[..., :3].astype(int), rgba[..., 2::-1], atol=2)
    np.testing.assert_array_equal(found[..., 3], rgba[..., 3])
    said_once(caplog, r"colors are converted from the profile .* to sRGB")


@pytest.mark.parametrize(("kind", "value"), [(2, "text"), (3, 7), (4, 7), (12, 0.5), (7, bytes(5_000_000))])
def test_a_profile_that_is_none_is_ignored(tmp_path, kind, value):
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags.tagtype[34675] = kind
    tags[34675] = value
    Image.fromarray(photograph(0, 16, 12)).save(tmp_path / "a.tif", tiffinfo=tags)
    np.testing.assert_array_equal(read_rgba(tmp_path / "a.tif")[..., :3], photograph(0, 16, 12))


@pytest.mark.parametrize("color", [(255, 255, 255), (255, 0, 0), (0, 0, 0), (128, 128, 128)])
def test_cmyk_is_read_as_rgb(tmp_path, color):
    Image.new("RGB", (16, 16), color).convert("CMYK").save(tmp_path / "a.jpg", quality=100)
    found = read_rgba(tmp_path / "a.jpg")
    np.testing.assert_allclose(found[8, 8].astype(int), (*color, 255), atol=4)


@pytest.mark.parametrize(("kind", "other"), [(".bin", ".txt"), (".txt", ".bin")])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_each_file_of_a_model_may_be_binary_or_text(tmp_path, plain, kind, other, name):
    root = write_colmap(tmp_path / "c", KNOWN, kind)
    write_colmap(tmp_path / "other", KNOWN, other)
    (root / f"sparse/0/{name}{kind}").unlink()
    shutil.move(tmp_path / f"other/sparse/0/{name}{other}", root / f"sparse/0/{name}{other}")
    scene = read(root)
    assert_plain(scene, plain)
    assert len(scene.points) == 60


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / "points3D.bin").write_bytes(b""),
        lambda folder: (folder / "points3D.bin").write_bytes((folder / "points3D.bin").read_bytes()[:500]),
        lambda folder: (folder / "points3D.bin").write_text("<html>no</html>"),
        lambda folder: (folder / "points3D.bin").rename(folder / "points3D.ply"),
    ],
)
def test_points_that_cannot_be_read_cost_no_view(tmp_path, plain, caplog, damage):
    root = write_colmap(tmp_path / "c", KNOWN)
    damage(root / "sparse/0")
    scene = read(root)
    assert_plain(scene, plain)
    assert len(scene.points) == 0
    said_once(caplog, r"The sparse points are left out: .*points3D")


def test_points_of_3dgs_take_the_place_of_absent_ones(tmp_path):
    root = write_colmap(tmp_path / "c", KNOWN)
    (root / "sparse/0/points3D.bin").unlink()
    write_ply(root / "sparse/0/points3D.ply", KNOWN.points, "binary_little_endian")
    assert len(read(root).points) == 60


@pytest.mark.parametrize("kind", [".bin", ".txt"])
def test_names_in_the_encoding_of_windows_are_read_and_said(tmp_path, plain, caplog, kind):
    root = write_colmap(tmp_path / "c", KNOWN, kind)
    path = root / f"sparse/0/images{kind}"
    path.write_bytes(path.read_bytes().replace(b"p_4.png", b"\xe9t\xe9.png"))
    (root / "images/p_4.png").rename(root / "images/été.png")
    assert_plain(read(root), plain)
    said_once(caplog, r"is not UTF-8: its names are read in the encoding of Windows \(cp1252\)")


OTHERS = [
    (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3\n", "Git LFS pointer"),
    (b"\n <!DOCTYPE html><html>", r"web page \(HTML\)"),
    (b"\xef\xbb\xbf<HTML>", r"web page \(HTML\)"),
    (b"PK\x03\x04" + bytes(30), "zip archive: unpack"),
    (b"\x1f\x8b" + bytes(30), "gzip archive"),
    (bytes(257) + b"ustar" + bytes(30), "tar archive"),
    (b"\0\0\0\x20ftypisom" + bytes(30), "film"),
    (b"RIFF\0\0\0\0AVI " + bytes(30), "film"),
]


@pytest.mark.parametrize(("content", "words"), OTHERS)
@pytest.mark.parametrize("name", ["transforms.json", "images/p_3.png"])
def test_files_that_are_not_what_they_are_called_are_named(root, caplog, content, words, name):
    (root / name).write_bytes(content)
    if name.endswith("json"):
        with pytest.raises(InputError, match=rf"{name} is a {words}"):
            read(root)
    else:
        assert len(read(root).view_names) == 8
        said_once(caplog, rf"{name} is a {words}")


def test_an_archive_as_root_is_to_be_unpacked_and_one_of_numpy_is_none(tmp_path):
    np.savez(tmp_path / "a.npz", a=1)
    assert other_format(tmp_path / "a.npz") is None
    shutil.make_archive(str(tmp_path / "in"), "zip", write_transforms(tmp_path / "c", KNOWN))
    with pytest.raises(InputError, match=r"in\.zip is a zip archive: unpack it"):
        read(tmp_path / "in.zip")


@pytest.mark.parametrize(
    ("ending", "words"),
    [
        (".gif", r"p_\d\.gif does\. Files of this format are not read"),
        (".exr", r"p_\d\.exr does\. OpenEXR holds linear light"),
        (".nef", r"p_\d\.nef does\. RAW is not read"),
        (".tga", r"p_\d\.tga does\. Files"),
    ],
)
@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_a_picture_of_a_format_that_is_not_read_is_found_and_named(tmp_path, write, ending, words):
    root = write(tmp_path / "c", KNOWN)
    for view in ALL:
        (root / f"images/p_{view}.png").rename(root / f"images/p_{view}{ending}")
    with pytest.raises(InputError, match=words):
        read(root)


def test_a_name_that_leads_out_tells_nothing_of_what_lies_there(tmp_path, root, caplog):
    (tmp_path / "secret.gif").touch()
    edit_frame(root, 0, file_path="../secret.jpg")
    edit_frame(root, 1, file_path="a" * 249 + ".jpg", w=0)
    edit_frame(root, 2, w=0)
    assert len(read(root).view_names) == 6
    assert "secret.gif" not in caplog.text


@pytest.mark.parametrize("ending", [".jfif", ".jpe", ".JFIF"])
def test_jpegs_by_other_endings_are_read(tmp_path, ending):
    root = write_colmap(tmp_path / "c", KNOWN, ".txt")
    for view in ALL:
        buffer = io.BytesIO()
        Image.fromarray(photograph(view, *KNOWN.size)).save(buffer, "JPEG")
        (root / f"images/p_{view}.png").rename(root / f"images/p_{view}{ending}")
        (root / f"images/p_{view}{ending}").write_bytes(buffer.getvalue())
    path = root / "sparse/0/images.txt"
    path.write_text(path.read_text().replace(".png", ending))
    assert len(read(root).view_names) == 9


@pytest.mark.parametrize(
    ("lists", "splits"),
    [
        ({"test_filenames": ["images/p_2.png", "images/p_5.png"]}, (7, 2, 2)),
        ({"val_filenames": ["images/p_0.png"]}, (8, 1, 1)),
        ({"val_filenames": ["images/p_0.png"], "test_filenames": ["images/p_1.png", "images/p_2.png"]}, (6, 1, 2)),
    ],
)
def test_what_is_in_no_list_is_learned_from_where_no_list_says_so(root, lists, splits):
    top(root, **lists)
    assert tuple(map(len, read(root).splits.values())) == splits


@pytest.mark.parametrize(("off", "views"), [(1e-6, 9), (-3e-5, 9), (0.1, 8)])
def test_a_view_that_is_listed_twice_counts_once_but_for_another_pose(root, caplog, off, views):
    def twice(content):
        matrix = (
            np.array(content["frames"][4]["transform_matrix"]) + off * np.eye(4)[0][:, None] * np.eye(4)[3]
        ).tolist()
        return content | {"frames": [*content["frames"], content["frames"][4] | {"transform_matrix": matrix}]}

    edit_json(root, twice)
    assert len(read(root).view_names) == views
    assert ("more than once, with different poses" in caplog.text) == (views == 8)


@pytest.mark.parametrize(
    ("settings", "change"),
    [
        ({"axes": "opencv"}, lambda pose: pose @ np.diag([1.0, -1, -1, 1])),
        ({"poses": "w2c"}, np.linalg.inv),
        ({"axes": "opencv", "poses": "w2c"}, lambda pose: np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1]))),
    ],
)
def test_poses_of_another_convention_are_read_by_a_setting(root, plain, settings, change):
    def changed(frame):
        return frame | {"transform_matrix": change(np.array(frame["transform_matrix"])).tolist()}

    edit_json(root, lambda content: content | {"frames": list(map(changed, content["frames"]))})
    assert_plain(read(root, **settings), plain)


def test_pictures_lie_anywhere_in_the_folder_that_the_user_named(tmp_path, plain):
    """As in ETH3D: a model beside the pictures' folder; and a json in a folder of its own."""
    root = write_colmap(tmp_path / "eth", KNOWN, where="calibration")
    renamed("images", "pictures")(root)
    (root / "images").mkdir()
    (root / "pictures").rename(root / "images/undistorted")
    assert_plain(read(root), plain)
    assert_plain(read(root, "colmap", model="calibration", images="images/undistorted"), plain)
    root = write_transforms(tmp_path / "one" / "nerf", KNOWN)
    each_frame(root, file_path="../images/p_{}.png")
    (root / "images").rename(tmp_path / "one/images")
    assert_plain(read(tmp_path / "one"), plain)
    with pytest.raises(InputError, match="leads out of the capture's folder"):
        read(root)
