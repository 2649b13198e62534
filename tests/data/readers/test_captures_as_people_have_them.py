"""Captures with what people's folders hold: read as the plain capture with one line that says so, or refused in words.

A photograph is told by its pixels, so that each is seen to have its own pose whatever it is called.
"""

import json
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image
from support.malformed import edit_frame, edit_json, edit_rows, edit_text
from support.other_formats import SPLIT_AT, write_blender
from support.plain_capture import (
    ALL,
    KNOWN,
    WITHOUT_3,
    assert_plain,
    everything_is_said,  # noqa: F401
    files,
    plain_rays,  # noqa: F401
    read,
    renamed,
    said_once,
    to_utf_16,
)
from support.posed_captures import photograph, ring, write_colmap, write_llff, write_pictures, write_transforms

from nerf_lightning.messages.errors import InputError

FAR = KNOWN.moved(8.0, np.eye(3), np.array([512345.25, 5412345.5, 301.0]))


def each_frame(root, change):
    edit_json(root, lambda content: content | {"frames": [frame | change(frame) for frame in content["frames"]]})


def named(change, folder="images"):
    """Return a change of names in the json, and of the folder's."""

    def apply(root):
        each_frame(root, lambda frame: {"file_path": change(frame["file_path"])})
        (root / "images").rename(root / "moved")
        (root / folder).parent.mkdir(parents=True, exist_ok=True)
        (root / "moved").rename(root / folder)

    return apply


def posed(change):
    return lambda root: each_frame(
        root, lambda frame: {"transform_matrix": change(np.array(frame["transform_matrix"])).tolist()}
    )


def others(root, folder, names=KNOWN.names):
    """Write other pictures of the same names."""
    for view, name in enumerate(names):
        (root / folder).mkdir(parents=True, exist_ok=True)
        Image.fromarray(photograph(50 + view, *KNOWN.size)).save(root / folder / name)


def also(*changes):
    return lambda root: [change(root) for change in changes] and None


def kept(scene):
    return float(scene.pixels.mask.float().mean())


# A name, a change of the plain transforms capture, the views that remain and the line that is said.
LEFT_OUT = r"1 of 9 views are left out: (images/p_3\.png|frames\[3\])\. The first: "
BAD_FRAMES = {
    "absent": lambda root: (root / "images/p_3.png").unlink(),
    "of another shape": lambda root: Image.fromarray(photograph(3, 20, 12)).save(root / "images/p_3.png"),
    "null matrix": lambda root: edit_frame(root, 3, transform_matrix=None),
}


@pytest.mark.parametrize("fault", BAD_FRAMES)
def test_one_bad_frame_is_left_out_and_named(tmp_path, plain, caplog, fault):
    root = write_transforms(tmp_path / "c", KNOWN)
    BAD_FRAMES[fault](root)
    assert_plain(read(root), plain, WITHOUT_3)
    said_once(caplog, LEFT_OUT)


FOUND = r"9 of 9 pictures are found under another name, such as "
NAMES = {
    "case": (named(str.upper), FOUND),
    "absolute": (named(lambda name: "/home/me/scan/" + name), FOUND),
    "a drive": (named(lambda name: "D:\\Scan\\" + name.replace("/", "\\")), FOUND),
    "a url": (named(lambda name: "file:///home/me/" + name), FOUND),
    "a slash": (named(lambda name: "/" + name), FOUND),
    "a parent": (named(lambda name: "../toy/" + name), FOUND),
    "a blank behind": (named(lambda name: name + " "), FOUND),
    "heic": (named(lambda name: name.replace(".png", ".HEIC")), FOUND),
    "no folder": (named(lambda name: name.rpartition("/")[2]), FOUND),
    "nested": (named(str, "images/images"), FOUND),
    "%5F for _": (named(lambda name: name.replace("_", "%5F")), FOUND),
    "another folder": (named(str, "color"), FOUND),
    "dots": (named(lambda name: "././/" + name.replace("/", "//")), None),
    "no ending": (named(lambda name: name.removesuffix(".png")), None),
    "a backup": (also(named(lambda name: "gone/" + name), partial(others, folder="old/images")), FOUND),
    "depths": (also(named(lambda name: "/x/f/" + name[7:]), partial(others, folder="depth")), FOUND),
}


SPLITS = [("cam0", "cam1"), ("train", "test"), ("train/images", "test/images"), ("training", "testing")]


@pytest.mark.parametrize("folders", SPLITS)
@pytest.mark.parametrize("before", ["", "/home/me/"])
def test_pictures_that_are_absent_are_never_those_of_another_folder(tmp_path, plain, caplog, folders, before):
    root = write_transforms(tmp_path / "c", KNOWN)
    names = [f"{folders[view // SPLIT_AT]}/r_{view % SPLIT_AT}.png" for view in ALL]
    write_pictures(root, tuple(names[:SPLIT_AT]), KNOWN.size)
    others(root, folders[0], ("r_6.png",))
    shutil.rmtree(root / "images")
    frames = iter(names)
    each_frame(root, lambda frame: {"file_path": before + next(frames)})
    assert_plain(read(root), plain, ALL[:SPLIT_AT])
    said_once(caplog, r"3 of 9 views are left out")


def test_of_two_folders_that_fit_alike_neither_is_guessed(tmp_path):
    root = write_transforms(tmp_path / "c", KNOWN)
    named(lambda name: "/x/frames/" + name[7:], "a")(root)
    others(root, "b")
    with pytest.raises(
        InputError, match=r"match files of .*a, .*b equally well\. Move all but one of these folders out"
    ):
        read(root)


def many_features(root):
    few = replace(KNOWN, c2w=ring(9, 3.0)[:4], names=KNOWN.names[:4])
    write_colmap(root, few, ".txt", "sparse/0", pictures=False)
    edit_text(root, "images.txt", lambda text: text.replace("3.0 4.0 -1", "3.0 4.0 -1 " * 500))


def few_cameras(root):
    few = replace(KNOWN, c2w=KNOWN.c2w[:3], names=KNOWN.names[:3])
    write_colmap(root, few, where="sparse/0", pictures=False)


def split_json(first, second):
    def change(root):
        content = json.loads((root / "transforms.json").read_text())
        (root / "transforms.json").unlink()
        for name, frames in ((first, content["frames"][:5]), (second, content["frames"][5:])):
            (root / name).write_text(json.dumps(content | {"frames": frames}))

    return change


def model(where, pictures, kind=".bin"):
    def write(root, known):
        write_pictures(root / pictures, known.names, known.size)
        return write_colmap(root, known, kind, where, pictures=False)

    return write


ROOTS = {
    "sparse/1 has more": (
        model("sparse/1", "images"),
        many_features,
        "",
        r"sparse/1 is read, with 9 photo.*, of 2 models",
    ),
    "elsewhere are more": (
        model("colmap/sparse/0", "images"),
        few_cameras,
        "",
        r"colmap/sparse/0 is read, with 9 photographs, of 2 models; .* \(sparse/0: 3\)",
    ),
    "flat": (model("", "", ".txt"), None, "", r"read as scene=colmap"),
    "undistorted": (model("distorted/sparse/0", "input"), None, "", r"read as scene=colmap"),
    "the model given": (write_colmap, None, "c/sparse/0", r"c: read as scene=colmap, because it has sparse/0"),
    "its file given": (write_colmap, None, "c/sparse/0/cameras.bin", r"c: read as scene=colmap"),
    "pictures given": (write_colmap, None, "c/images", r"c: read as scene=colmap"),
    "two above": (write_transforms, renamed("", "../d/a/b"), "d", r"d/a/b: read as scene=transforms"),
    "json given": (write_transforms, None, "c/transforms.json", r"read as scene=transforms"),
    "parts": (write_transforms, split_json("transforms_a.json", "transforms_b.json"), "", r"read as one capture: "),
    "splits": (write_transforms, split_json("transforms_train.json", "transforms_val.json"), "", r"as one capture: "),
}


@pytest.mark.parametrize("case", ROOTS)
def test_the_capture_is_found_from_the_folder_that_people_give(tmp_path, plain, caplog, case):
    write, change, given, words = ROOTS[case]
    (tmp_path / "d" / "a").mkdir(parents=True)
    root = write(tmp_path / "c", KNOWN)
    if change:
        change(root)
    assert_plain(read(tmp_path / (given or "c")), plain)
    said_once(caplog, words)


def test_a_json_by_another_name_and_two_captures_are_refused_with_what_to_type(tmp_path):
    write_transforms(tmp_path / "c", KNOWN)
    write_colmap(tmp_path / "d", KNOWN)
    with pytest.raises(InputError, match=r"holds 2 captures\. Choose one of them: scene\.root=.*c, scene\.root=.*d\."):
        read(tmp_path)
    renamed("transforms.json", "cameras.json")(tmp_path / "c")
    with pytest.raises(InputError, match=r"read with scene=transforms scene\.file=NAME"):
        read(tmp_path / "c")


@pytest.mark.parametrize(("write", "folder"), [(write_colmap, "images/masks"), (write_transforms, "masks")])
@pytest.mark.parametrize("name", ["{}.png.png", "{}_mask.png", "{}.mask.png", "images/{}.jpg", "{}.PNG"])
def test_masks_are_found_by_their_photographs_names(tmp_path, plain, write, name, folder):
    root = write(tmp_path / "c", KNOWN)
    for view in ALL:
        path = root / folder / name.format(f"p_{view}")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.repeat(np.uint8([[255] * 4 + [0] * 12]), 12, axis=0)).save(path, "PNG")
    scene = read(root, masks=folder)
    assert_plain(scene, plain)
    assert kept(scene) == 0.25


@pytest.mark.parametrize(("there", "words"), [(8, r"1 of 9 photographs have no mask"), (0, r"9 are missing")])
def test_an_absent_mask_is_never_the_photograph_itself(tmp_path, plain, caplog, there, words):
    root = write_transforms(tmp_path / "c", KNOWN)
    each_frame(root, lambda frame: {"mask_path": frame["file_path"].replace("images", "masks")})
    (root / "masks").mkdir()
    for view in ALL[:there]:
        Image.fromarray(np.full((12, 16), 255, np.uint8)).save(root / f"masks/p_{view}.png")
    scene = read(root)
    assert_plain(scene, plain)
    assert scene.pixels.mask is None or kept(scene) == 1.0
    said_once(caplog, words)


def top(**keys):
    return lambda root: edit_json(root, lambda content: content | keys)


TEXT = "sparse/0/*.txt"
ENCODINGS = {
    "lower case in text": (".txt", lambda root: files(root, TEXT, lambda text: text.replace(b"PINHOLE", b"pinhole"))),
    "windows' ends of lines": (".txt", lambda root: files(root, TEXT, lambda text: text.replace(b"\n", b"\r\n"))),
    "utf-16": (".txt", lambda root: files(root, TEXT, to_utf_16)),
    "a byte order mark": (".txt", lambda root: files(root, TEXT, lambda text: b"\xef\xbb\xbf" + text)),
    "a json in utf-16": ("", lambda root: files(root, "*.json", to_utf_16)),
    "opencv": ("", top(camera_model=" OpenCV", k1=None, k2=0)),
    "simple_pinhole": ("", top(camera_model="simple_pinhole")),
    "null": ("", top(camera_model=None, cx=None, cy=None, fl_y=None, applied_scale=None, mask_path=None)),
    "twice the size": ("", top(w=32, h=24, fl_x=40, fl_y=40, cx=16, cy=12)),
    "FULL_OPENCV of zeros": ("", top(camera_model="FULL_OPENCV", k4=0, k5=0.0, k6=0)),
}


@pytest.mark.parametrize("case", ENCODINGS)
def test_lenses_and_encodings_are_read_as_people_write_them(tmp_path, plain, case):
    kind, change = ENCODINGS[case]
    root = write_colmap(tmp_path / "c", KNOWN, kind) if kind else write_transforms(tmp_path / "c", KNOWN)
    change(root)
    assert_plain(read(root), plain)


MATRICES = {
    "flat": (posed(np.ravel), None),
    "three rows": (posed(lambda pose: pose[:3]), None),
    "by columns": (posed(np.transpose), None),
    "flat by columns": (posed(lambda pose: pose.T.ravel()), None),
    "scaled": (posed(lambda pose: pose * [2.5, 2.5, 2.5, 1.0]), r"rotations of 9 of 9 poses are scaled \(by 2\.5"),
    "rounded": (posed(lambda pose: pose * [1.0007, 1.0007, 1.0007, 1.0]), r"poses are scaled \(by 1\.001,"),
    "times": (lambda root: [edit_frame(root, view, time=view / 8) for view in ALL], r"time differs between frames"),
}


@pytest.mark.parametrize("case", NAMES | MATRICES)
def test_names_and_matrices_are_read_as_people_write_them(tmp_path, plain, caplog, case):
    change, words = (NAMES | MATRICES)[case]
    root = write_transforms(tmp_path / "c", KNOWN)
    change(root)
    assert_plain(read(root), plain)
    if words:
        said_once(caplog, words)
    else:
        assert "found by another name" not in caplog.text
        assert "WARNING" not in caplog.text


@pytest.mark.parametrize("change", [np.diag([1.0, 1, -1, 1]), np.diag([-1.0, 1, 1, 1]), np.diag([1.0, 1, 1.5, 1])])
def test_mirrored_and_sheared_poses_are_refused(tmp_path, change):
    root = write_transforms(tmp_path / "c", KNOWN)
    posed(lambda pose: pose @ change)(root)
    with pytest.raises(InputError, match=r"mirrors or shears.* 9 of the 9 views"):
        read(root)


@pytest.mark.parametrize("write", [write_colmap, write_transforms, partial(write_llff, near=8.0)])
def test_coordinates_of_a_map_keep_their_digits(tmp_path, write):
    scene = read(write(tmp_path / "c", FAR))
    centers = scene.cameras.c2w[:, :, 3].double() @ scene.to_user[:3, :3].mT + scene.to_user[:3, 3]
    np.testing.assert_allclose(centers, FAR.c2w[:, :, 3], rtol=0, atol=2e-4)


@pytest.mark.parametrize("folder", ["", "rgb"])
@pytest.mark.parametrize(("opaque", "top"), [(False, {}), (True, {}), (False, {"w": 32, "h": 24, "cx": 16, "cy": 12})])
@pytest.mark.parametrize("absent", [False, True])
def test_frames_for_training_and_test_are_read_in_both_flavours(tmp_path, plain, caplog, folder, opaque, top, absent):
    root = write_blender(tmp_path / "c", KNOWN, opaque, folder, top)
    if absent:
        shutil.rmtree(root / "test")
    scene = read(root)
    assert_plain(scene, plain, ALL[:SPLIT_AT] if absent else ALL)
    assert (scene.space == "bounded") == (not opaque)
    assert len(scene.splits["test"]) == (1 if absent else 3)
    said_once(caplog, r"time differs between frames")
    assert ("3 of 9 views are left out" in caplog.text) == absent


def test_instant_ngps_lens_counts_in_files_for_training_and_test(tmp_path):
    keys = {"fl_x": 21.0, "fl_y": 22.0, "cx": 9.0, "cy": 5.0, "w": 16, "h": 12, "k1": -0.11}
    cameras = read(write_blender(tmp_path / "c", KNOWN, opaque=True, top=keys)).cameras
    np.testing.assert_allclose(cameras.lens[4], [-0.11, 0, 0, 0, 0, 0], rtol=1e-6)
    assert cameras.focal[4].tolist() == [21.0, 22.0]
    assert cameras.center[4].tolist() == [9.0, 5.0]


@pytest.mark.parametrize(
    ("write", "orientation", "turned"),
    [
        *((write_transforms, orientation, turned) for orientation in (1, 3, 6, 8) for turned in (False, True)),
        *((write, 6, turned) for write in (write_colmap, write_llff) for turned in (False, True)),
    ],
)
def test_the_cameras_size_tells_how_a_photograph_lies(tmp_path, plain, caplog, orientation, write, turned):
    quarter = {6: 1, 8: -1}.get(orientation, 0) if turned else 0
    root = write(tmp_path / "c", KNOWN)
    mask = np.repeat(np.uint8([[255] * 4 + [0] * 12]), 12, axis=0)
    (root / "masks").mkdir()
    for view in ALL:
        exif = Image.Exif()
        exif[0x0112] = orientation
        stored = np.ascontiguousarray(np.rot90(photograph(view, *KNOWN.size), quarter))
        Image.fromarray(stored).save(root / "images" / f"p_{view}.png", exif=exif)
        Image.fromarray(np.ascontiguousarray(np.rot90(mask, quarter))).save(root / "masks" / f"p_{view}.png")
    scene = read(root, masks="masks")
    assert_plain(scene, plain)
    assert torch.equal(scene.pixels.view_mask(4), torch.from_numpy(mask == 255))
    if orientation in (3, 6, 8):
        said_once(caplog, rf"{9 if quarter else 0}, whose sizes match their cameras only then")


def named_in(text):
    return lambda root: (others(root, "images", ("zz.png",)), (root / "view_imgs.txt").write_text(text))


def without_row_3(rows):
    return np.where(np.arange(9)[:, None] == 3, np.nan, rows)


LINES = "\r\n".join(f"images/{name}" for name in KNOWN.names)
LLFF = {
    "near 0": (lambda root: edit_rows(root, lambda rows: rows * (np.arange(17) != 15)), ALL, r"bounds\) are not used"),
    "no pose": (lambda root: edit_rows(root, without_row_3), WITHOUT_3, r"1 of 9 views are left out"),
    "view_imgs": (named_in(LINES), ALL, r"1 photographs have no pose and are left out: zz\.png"),
    "in the root": (
        lambda root: [path.rename(root / path.name) for path in (root / "images").iterdir()],
        ALL,
        r"scene=llff",
    ),
}


@pytest.mark.parametrize("case", LLFF)
def test_llffs_captures_are_read_as_people_have_them(tmp_path, plain, caplog, case):
    change, views, words = LLFF[case]
    root = write_llff(tmp_path / "c", KNOWN)
    change(root)
    assert_plain(read(root), plain, views)
    said_once(caplog, words)


@pytest.mark.parametrize(("name", "order"), [("my pic {}.png", "text"), ("{}.png", "numbers"), ("{}.png", "text")])
def test_the_order_of_llffs_poses_is_doubted_where_text_and_numbers_differ(tmp_path, plain, caplog, name, order):
    names = tuple(name.format(view + 5) for view in ALL)
    root = write_llff(tmp_path / "c", replace(KNOWN, names=names))
    named_in("\n".join(names))(root)
    if order == "numbers":
        edit_rows(root, lambda rows: rows[np.argsort(sorted(range(9), key=lambda view: names[view]))])
    assert_plain(read(root, "llff", order=order), plain)
    said_once(caplog, r"in text order \(.*10\.png, .* differ.*; if renderings are blurred, try scene\.order=")
