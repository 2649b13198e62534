"""Broken captures, format by format: one paragraph that says where, what, and the cure; never another exception."""

import os
import re
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.malformed import (
    MODEL,
    WRITERS,
    edit_bytes,
    edit_frame,
    edit_json,
    edit_rows,
    edit_text,
    one_picture,
    refused,
)
from support.posed_captures import (
    Known,
    frames_of,
    photograph,
    read,
    ring,
    wall,
    write_colmap,
    write_llff,
    write_pictures,
    write_transforms,
)
from support.waiting import fifo, within

from nerf_lightning.data.readers.auto import AutoReader
from nerf_lightning.messages.errors import InputError


def top(**changed):
    """Change what stands at the file's top; None removes it."""
    kept = {key: value for key, value in changed.items() if value is not None}
    gone = changed.keys() - kept.keys()
    return lambda root: edit_json(root, lambda old: {k: v for k, v in old.items() if k not in gone} | kept)


def frame(view, **changed):
    return lambda root: edit_frame(root, view, **changed)


def content(change):
    return lambda root: edit_json(root, change)


def text(name, change):
    return lambda root: (root / name).write_bytes(change((root / name).read_bytes()))


def mask(size):
    def write(root):
        Image.new("L", size, 255).save(root / "m.png")
        edit_frame(root, 1, mask_path="m.png")

    return write


ROWS = [*frames_of(Known())[2]["transform_matrix"][:3], [0, 0, 1, 1]]
AT_THE_END = [[1, 0, 0, 9e30], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
SHEARED = [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
PATH = {"camera_type": "perspective", "render_height": 9, "camera_path": [], "fps": 24}
TWO = ["images/p_0.png", "images/p_1.png"]
PANORAMA = {"camera_model": "EQUIRECTANGULAR"}
JSON = "transforms.json"

TRANSFORMS = {
    "no json": (lambda root: (root / JSON).unlink(), r"json does not exist; the folder holds images. Put the file"),
    "cut short": (text(JSON, lambda old: old[:-20]), r"json is not valid json: .* at line 1, column \d+. Export it"),
    "ten thousand digits": (text(JSON, lambda _: b'{"fl_x": 1' + b"0" * 10_000 + b"}"), r"not usable json: .*digits"),
    "a picture": (text(JSON, lambda _: b"\x89PNG"), r"json is not a text file \(byte 0 is not UTF-8\)"),
    "deep": (text(JSON, lambda _: b"[" * 10**6), r"nests its brackets too deeply"),
    "a key twice": (text(JSON, lambda old: b'{"fl_x": 9.0, ' + old.lstrip(b"{")), r"key 'fl_x' appears twice"),
    "a thousand digits": (top(fl_x=10**1000), r"transforms.json: frames\[0\] .*: fl_x has too many digits"),
    "a camera path": (content(lambda _: PATH), r"lacks frames; it has camera_type, .* A transforms.json of"),
    "a list": (content(lambda old: old["frames"]), r"must be a json object with the keys frames, but it is list"),
    "frames by name": (top(frames={"a": 1}), r"frames must be a list of views, but it is dict"),
    "no frames": (top(frames=[]), r"transforms.json lists no views"),
    "other frames": (top(frames=[{"file_path": "a.png", "pose": 1}]), r"\[0\] lacks transform_matrix; it has"),
    "a path of Windows": (frame(2, file_path="C:\\Users\\a.jpg"), r"\[2\]: C:.*an absolute path of", 8),
    "an absolute path": (frame(2, file_path="/home/a.jpg"), r"\[2\]: /home/a.jpg is an absolute path", 8),
    "an absent image": (frame(2, file_path="images/no.png"), r"\[2\]: the image \S+images/no.png does not exist", 8),
    "a long name": (frame(2, file_path="images/" + "x" * 5000), r"frames\[2\].* more than 1024 characters", 8),
    "an image by number": (frame(2, file_path=7), r"frames\[2\]: file_path is 7, but it must be a path as text", 8),
    "no last row": (frame(2, transform_matrix=ROWS), r"frames\[2\].* does not end in the row 0 0 0 1", 8),
    "a pose of words": (frame(2, transform_matrix=[["a"] * 4] * 4), r"is not a 4 x 4 matrix of numbers", 8),
    "a pose with NaN": (frame(2, transform_matrix=[[float("nan")] * 4] * 3), r"holds NaN or infinity: this view", 8),
    "a camera far away": (frame(0, transform_matrix=AT_THE_END), r"p_0.png has .*a center beyond 1e\+09, where", 8),
    "twice": (frame(2, file_path="./images/p_1.png"), r"lists images/p_1.png more than once, with different p", 7),
    "fl_x of zero": (top(fl_x=0.0), r"the view images/p_0.png has the focal length 0, 20"),
    "intrinsics with NaN": (top(cx=float("nan")), r"the view images/p_0.png has a pose or intrinsics with NaN"),
    "numbers as text": (top(fl_x="20"), r"frames\[0\] .*: fl_x is '20', but it must be a number"),
    "no focal length": (top(fl_x=None, fl_y=None), r"has no focal length: neither fl_x \(pixels\) nor camera_angle_x"),
    "degrees": (top(fl_x=None, camera_angle_x=45.0), r"camera_angle_x is 45.0, but it must lie between 0 and pi"),
    "half a panorama": (top(camera_model="VR180_L"), r"camera_model 'VR180_L'; supported are PINHOLE, .* export"),
    "a panorama of more than a turn": (top(**PANORAMA, fl_x=5.0, fl_y=12.0), r"with fl_x=5 and fl_y=12 for 16 x 12"),
    "a bent pinhole": (top(camera_model="PINHOLE", k1=0.1), r"has the camera_model PINHOLE and distortion"),
    "a panorama among others": (frame(1, **PANORAMA, fl_x=8.0, fl_y=12.0), r"has another kind of lens \(equirect", 8),
    "a fisheye": (frame(1, camera_model="OPENCV_FISHEYE", k1=0.1), r"another kind of lens \(fisheye", 8),
    "a tangential fisheye": (top(camera_model="OPENCV_FISHEYE", p1=0.1), r"The lens of images/p_0.png .*tangential"),
    "a mask by number": (frame(1, mask_path=3), r"of 1 files \(mask_path\) 1 are missing or are not pictures: 3", 9),
    "no mask": (frame(1, mask_path="a.png"), r"1 files \(mask_path\) 1 are missing or are not pictures: a.png", 9),
    "a mask's size": (mask((4, 4)), r"The mask \S+m.png has 4 x 4 pixels, but its photograph \S+p_1.png has", 8),
    "a split of absent views": (top(train_filenames=["a\nb"]), r"lists no training view that exists"),
    "a split that is text": (top(train_filenames="p_0.png"), r"train_filenames must be a list of file names. Fix it"),
    "nothing held out": (top(train_filenames=TWO), r"lists no held-out view that exists: every 8th", 9),
    "a shear": (top(applied_transform=SHEARED), r"must be a rotation, a shift and the same scale along all axes"),
    "words": (top(applied_transform="none"), r"applied_transform is not a 4 x 4 matrix of numbers"),
    "a scale of zero": (top(applied_scale=0.0), r"applied_scale is 0, but it must be above 0"),
    "tiny units": (top(applied_scale=1e18), r"applied_scale is 1e\+18, which is no scale"),
    "ngp's offset of two": (top(aabb_scale=2, offset=[0.5, 0.5]), r"offset is \[0.5, 0.5\], but must be three numbers"),
}


def rows(change):
    return lambda root: edit_rows(root, change)


def cell(row, column, value):
    def change(old):
        old[row, column] = value
        return old

    return rows(change)


def archived(root):
    with (root / "poses_bounds.npy").open("wb") as file:
        np.savez(file, poses=np.zeros((9, 17)))


def first_alone(root):
    edit_rows(root, lambda old: old[:1])
    for path in sorted((root / "images").iterdir())[1:]:
        path.unlink()


EVERY = slice(None)
NPY = "poses_bounds.npy"
NO_ARRAY = r"poses_bounds.npy cannot be read \(ValueError"
LLFF = {
    "no folder": (lambda root: root.rename(root.parent / "b"), r"The folder .*capture does not exist. Set scene.root"),
    "no poses": (lambda root: (root / NPY).unlink(), r"npy does not exist; the folder holds images\. Put the file"),
    "cut short": (text(NPY, lambda old: old[:-9]), NO_ARRAY + ".*imgs2poses.*scene=colmap"),
    "an archive": (archived, NO_ARRAY),
    "no bounds": (rows(lambda old: old[:, :15]), r"is 9 x 15 of float64, but each view needs one row of 17 numbers"),
    "a photograph missing": (lambda root: one_picture(root).unlink(), r"has 9 poses, but \S+images has 8 photographs"),
    "a photograph too many": (lambda root: write_pictures(root / "images", ("x.png",), (16, 12)), r"10 photographs"),
    "NaN in a pose": (cell(2, 3, np.nan), r"the view p_2.png has a pose or intrinsics with NaN or infinity", 8),
    "infinite depth": (cell(5, 16, np.inf), r"bounds.* are not used, since .* 1 of 9 .*p_5.png", 9),
    "bounds exchanged": (cell(4, 15, 100.0), r"bounds.* are not used, since .* 1 of 9 .*p_4.png", 9),
    "a bound far away": (cell(EVERY, 16, 1e12), r"the content .* would reach .* the cameras' distance from the middle"),
    "a focal length of zero": (cell(EVERY, 14, 0.0), r"the view p_0.png has the focal length 0, 0 for 16 x 12 pixels"),
    "mirrored poses": (rows(lambda old: np.where(np.isin(np.arange(17), [0, 5, 10]), -old, old)), r"not a rotation"),
    "sides exchanged": (cell(EVERY, [4, 9], [16, 12]), r"16 x 12 pixels, but .* for 12 x 16: .*rotated or stretched"),
    "no photographs": (
        lambda root: (root / "images").rename(root / "pictures"),
        r"has no photographs in images, .* the folder itself",
    ),
    "one place": (cell(EVERY, [3, 8, 13], [1.0, 2.0, 3.0]), r"All 9 cameras of \S+npy are at the same position"),
    "one view": (first_alone, r"Holding out views from 1 leaves 0 for training and 1 for evaluation"),
}


def cameras(model, *params, views=range(1, 10), size=(16, 12)):
    """Write cameras of a model, by its number."""

    def write(root):
        records = [struct.pack(f"<IiQQ{len(params)}d", view, model, *size, *params) for view in views]
        (root / MODEL / "cameras.bin").write_bytes(struct.pack("<Q", len(records)) + b"".join(records))

    return write


def mixed(root):
    fisheye = struct.pack("<IiQQ8d", 1, 5, 16, 12, 20, 20, 8, 6, 0.1, 0, 0, 0)
    pinholes = [struct.pack("<IiQQ4d", number, 1, 16, 12, 20, 20, 8, 6) for number in range(2, 10)]
    (root / MODEL / "cameras.bin").write_bytes(struct.pack("<Q", 9) + fisheye + b"".join(pinholes))


def emptied(root):
    for name in ("cameras", "images", "points3D"):
        (root / MODEL / f"{name}.bin").write_bytes(struct.pack("<Q", 0))


def exchanged(root):
    a, b = root / MODEL / "cameras.bin", root / MODEL / "images.bin"
    old = a.read_bytes()
    a.write_bytes(b.read_bytes())
    b.write_bytes(old)


def point(x):
    record = struct.pack("<Q3d3BdQ", 1, x, 0, 0, 1, 1, 1, 0.1, 0)
    return lambda root: (root / MODEL / "points3D.bin").write_bytes(struct.pack("<Q", 1) + record)


def swap(old, new):
    return lambda root: edit_bytes(root, "images.bin", old, new)


IMAGES = MODEL / "images.bin"
FEATURES = struct.pack("<QI7dI", 1, 1, 1, *[0] * 6, 1) + b"a.png\0" + struct.pack("<Q", (1 << 64) - 1) + bytes(100)
PINHOLE = (20.0, 20.0, 8.0, 6.0)
FAR_POINT = r"sparse/0: 1 of (1|60) sparse points are NaN or beyond 1e\+09, and are left out"
COLMAP = {
    "no model": (lambda root: (root / "sparse").rename(root / ".sparse"), r"holds no COLMAP model: .* sparse, "),
    "half a model": (lambda root: (root / IMAGES).unlink(), r"images.bin does not exist; the folder holds cameras"),
    "an unknown number": (cameras(77, *PINHOLE), r"cameras.bin holds a camera of the unknown model number 77"),
    "an unknown lens": (cameras(7, *PINHOLE, 0.1), r"uses the camera model FOV, whose .* not supported"),
    "two kinds of lenses": (mixed, r"p_0.png has another kind of lens \(fisheye\) than most", 8),
    "an empty model": (emptied, r"has no registered photograph, so nothing can be learned. Copy the model again, or"),
    "a tail": (text(IMAGES, lambda old: old + b"tail"), r"images.bin cannot be read .* claims \S+ bytes, but has"),
    "files exchanged": (exchanged, r"(cameras|images).bin (cannot be read|holds)"),
    "more announced": (text(IMAGES, lambda old: struct.pack("<Q", 1 << 60) + old[8:]), r"images.bin .*claims \S+ en"),
    "more features announced": (text(IMAGES, lambda _: FEATURES), r"images.bin .*claims \S+ bytes"),
    "a name that is no text": (
        swap(b"p_0.png", b"\xffp_0.png"),
        r"images.bin is not UTF-8: its names are read in the enc",
        8,
    ),
    "a photograph twice": (swap(b"p_0.png", b"p_1.png"), r"lists p_1.png more than once, with different", 7),
    "a photograph without a name": (swap(b"p_0.png", b""), r"the image \S+images does not exist", 8),
    "a camera twice": (cameras(1, *PINHOLE, views=(7, 7)), r"cameras.bin holds 7 more than once"),
    "unlisted cameras": (cameras(1, *PINHOLE, views=(1,)), r"a camera that does not exist: 2\. .* 8 of the 9 views"),
    "a point with NaN": (point(np.nan), FAR_POINT, 9),
    "a point beyond float32": (point(1e300), FAR_POINT, 9),
    "no rotation": (text(IMAGES, lambda old: old[:12] + bytes(32) + old[44:]), r"p_0.png has a pose or intrinsics", 8),
    "fx of zero": (cameras(1, 0.0, 20.0, 8.0, 6.0), r"sparse/0: the view p_0.png has the focal length 0, 20"),
    "another size": (cameras(1, 20.0, 20.0, 800.0, 600.0), r"principal point at 800, 600, outside of its 16 x 12"),
    "no size": (cameras(1, *PINHOLE, size=(0, 0)), r"has the focal length 20, 20 for 0 x 0 pixels; all must be above"),
    "a fold": (cameras(2, 10.0, 8.0, 6.0, -2.0), r"The lens of p_0.png .*folds back .* Check the coefficients"),
    "a photograph missing": (lambda root: one_picture(root).unlink(), r"the image \S+images/p_3.png does not exist", 8),
    "an absolute name": (swap(b"p_0.png", b"/home/a.jpg"), r"/home/a.jpg is an absolute path of another machine", 8),
    "a long name": (swap(b"p_0.png", b"x" * 5000), r"the image \S+images/x+ does not exist", 8),
}


def lines(name, change):
    return lambda root: edit_text(root, name, change)


def without_features(old):
    return "\n".join(line for line in old.split("\n") if line.endswith(".png") or line.startswith("#"))


TEXT = {
    "an unknown camera": (lines("cameras.txt", lambda old: old.replace("PINHOLE", "P")), r"line 2 holds .*unknown"),
    "few parameters": (
        lines("cameras.txt", lambda old: old.replace(" 6.0\n", "\n")),
        r"cameras.txt, line 2 .*PINHOLE has 4 parameters, not 3",
    ),
    "no width": (lines("cameras.txt", lambda old: old.replace("E 16", "E nan")), r"txt, line 2 .*float NaN to"),
    "words": (lines("images.txt", lambda old: old.replace("10 ", "10 one ", 1)), r"images.txt, line 3 .*float: 'one'"),
    "no features": (lines("images.txt", without_features), r"line 3 .*the next line must hold features"),
    "cut short": (lines("images.txt", lambda old: old[: old.index(" p_8.png")]), r"line 19 .*expected 7, got 6"),
    "cut points": (lines("points3D.txt", lambda old: old[: old.rindex("\n59 ") + 4]), r"left out: .*line 60 .*exp", 9),
    "binary": (text(MODEL / "images.txt", lambda _: b"\xff\xfe\x00"), r"images.txt cannot be read \(Unicode"),
    "a point far away": (lines("points3D.txt", lambda old: re.sub(r"(?m)^0 \S+", "0 -1e300", old)), FAR_POINT, 9),
}


def png_header(width, height):
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in (header, b"IDATx", b"IEND")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def picture(change):
    return lambda root: one_picture(root).write_bytes(change(one_picture(root).read_bytes()))


def link_to_itself(root):
    one_picture(root).unlink()
    one_picture(root).symlink_to(one_picture(root))


PHOTOGRAPHS = {
    "cropped": (
        lambda root: Image.fromarray(photograph(3, 12, 12)).save(one_picture(root)),
        r"p_3.png has 12 x 12 pixels, but its camera was calibrated for 16 x 12: .* use the original one",
    ),
    "empty": (picture(lambda _: b""), r"p_3.png is empty \(0 bytes\). Copy or render it again"),
    "text": (picture(lambda _: b"<html>404</html>"), r"p_3.png is a web page"),
    "cut short": (picture(lambda old: old[:-150]), r"p_3.png cannot be read: .* cut short"),
    "no pixels": (picture(lambda _: png_header(0, 0)), r"p_3.png is not an image that can be read. Copy or render"),
    "200 megapixels": (picture(lambda _: png_header(20_000, 10_000)), r"more megapixels than the limit of 178"),
    "HEIC": (picture(lambda _: b"\0\0\0\x18ftypheic" + bytes(100)), r"p_3.png is a photograph in the format HEIC"),
    "a link to itself": (
        link_to_itself,
        r"(p_3.png does not exist|p_3.png is a symbolic link to .*, which leads nowhere)",
    ),
}
# A case without a number is refused; else so many of nine views remain. Of a picture with two poses neither is taken.
CASES = [
    pytest.param(kind, damage, message, *(rest or [default]), id=f"{table}-{name}")
    for table, kind, cases, default in (
        *(("transforms", "transforms", TRANSFORMS, None), ("llff", "llff", LLFF, None)),
        *(("colmap", "colmap", COLMAP, None), ("text", "text", TEXT, None), ("photographs", "colmap", PHOTOGRAPHS, 8)),
    )
    for name, (damage, message, *rest) in cases.items()
]


@pytest.mark.parametrize(("kind", "damage", "message", "remaining"), CASES)
def test_it_is_left_out_or_refused_in_one_paragraph(tmp_path, caplog, kind, damage, message, remaining):
    root = WRITERS[kind](tmp_path / "capture")
    damage(root)
    if remaining is None:
        refused(kind, root, message)
        return
    assert len(read("colmap" if kind == "text" else kind, root).view_names) == remaining
    assert re.search(message, caplog.text)


def ahead(root):
    """One camera far ahead of the others, which all look the same way."""
    poses = wall()
    poses[4, 1, 3] += 3.0
    return write_llff(root, Known(c2w=poses))


LLFF_WALL, JSON_WALL = (
    lambda root, write=write: write(root, Known(c2w=wall())) for write in (write_llff, write_transforms)
)
SETTINGS = [
    ("transforms", None, {"masks_keep": "black"}, r"masks_keep=black, but no photograph of .* has a mask. Name their"),
    ("transforms", None, {"masks": "images/x"}, r"masks=images/x holds no mask for any photograph of "),
    ("transforms", None, {"file": "absent/transforms.json"}, r"does not exist; the folder holds nothing that can be"),
    ("transforms", None, {"file": "x" * 5000}, r"does not exist; the folder holds images"),
    ("llff", None, {"images": "images_16"}, r"has no photographs in images_16. Set scene.images"),
    ("llff", None, {"images": "x" * 5000}, r"has no photographs in x"),
    ("colmap", None, {"images": "images_2"}, r"images_2 does not exist. Set scene.images to the pho"),
    ("colmap", None, {"images": "x" * 5000}, r"does not exist. Set scene.images to the photographs'"),
    ("llff", None, {"downscale": 13}, r"scene.downscale=13 leaves nothing of a photograph of 16 x 12 pixels. Choose a"),
    ("colmap", None, {"frames": "IMG_*"}, r"frames='IMG_\*' fits none of the views of \S+sparse/0; they are p_0.png,"),
    ("colmap", None, {"near": 1000.0}, r"scene.near=1000 lies behind all content of \S+sparse/0, which ends at"),
    ("colmap", None, {"hold_every": 1}, r"scene.hold_every=1 would leave no training views: give 2 or more"),
    ("llff", None, {"space": "ndc"}, r"ndc needs cameras that all look the same way, .*scene.space=contracted"),
    ("transforms", JSON_WALL, {"space": "ndc"}, r"scene.space=ndc needs the depth at which content begins,"),
    ("llff", LLFF_WALL, {"far": 9.0}, r"scene.far=9 cannot be used with scene.space=ndc, which reaches to infinity"),
    (
        "llff",
        ahead,
        {"space": "ndc"},
        r"the view p_4.png .* stands 2.\d+ ahead of the cameras' middle, behind the near plane",
    ),
]


@pytest.mark.parametrize(("kind", "write", "settings", "message"), SETTINGS)
def test_settings_that_do_not_suit_the_capture(tmp_path, kind, write, settings, message):
    refused(kind, (write or WRITERS[kind])(tmp_path / "capture"), message, **settings)


@pytest.mark.parametrize(
    ("kind", "root", "message"),
    [
        ("llff", Path("~nobody_of_that_name/capture"), r"scene.root=~nobody\S+: .*home directory.* Give the folder"),
        ("colmap", Path("x" * 5000), r"does not exist"),
    ],
)
def test_a_folder_that_cannot_be_named(kind, root, message):
    refused(kind, root, message)


NEEDED = {"transforms": JSON, "llff": NPY, "colmap": "sparse/0/cameras.txt"}


@pytest.mark.skipif(os.name != "posix", reason="FIFOs and devices are posix's")
@pytest.mark.parametrize(("kind", "name"), NEEDED.items())
def test_what_is_no_file_in_the_place_of_one_is_called_what_it_is(tmp_path, kind, name):
    path = fifo(tmp_path / name)
    with within(5):
        refused(kind, tmp_path, rf"{path.name} is a named pipe \(FIFO\), and only regular files are opened")
        if kind != "colmap":
            with pytest.raises(InputError, match=rf"it holds {name} \(a named pipe \(FIFO\)\)"):
                AutoReader(root=str(tmp_path)).read()
    path.unlink()
    path.symlink_to("/dev/zero")
    refused(kind, tmp_path, rf"{path.name} is a device, and only regular files are opened")


@pytest.mark.parametrize("aabb_scale", [1e12, float("nan")])
def test_a_box_that_no_scene_has(tmp_path, aabb_scale):
    root = write_transforms(tmp_path / "capture", Known(), aabb_scale=aabb_scale)
    refused("transforms", root, r"would reach .* cameras' distance from the middle|aabb_scale is nan", space="bounded")


def test_sparse_points_that_are_mistakes(tmp_path):
    known = Known(c2w=ring() * [1.0, 1.0, 1.0, 1e-3])
    points = 1e-4 * known.points[:20]  # of few points, the outermost ones count
    points[0] = known.c2w[0] @ [0.0, 0.0, -5e8, 1.0]
    root = write_colmap(tmp_path / "capture", replace(known, points=points))
    refused("colmap", root, "the content .* would reach .* the cameras' distance from the middle", space="contracted")
