"""Broken COLMAP models: one paragraph that says where, what, and the cure; never another exception."""

import re
import struct

import numpy as np
import pytest
from support.malformed import MODEL, Cases, edit_bytes, edit_text, one_picture, refused, refused_when_damaged
from support.posed_captures import Known, read, ring, write_colmap

from nerf_lightning.messages.errors import InputError

case = Cases()


@case("colmap", r"capture holds no COLMAP model: there is no cameras.bin or cameras.txt in sparse/0, .* nerf poses")
def no_model(root):
    (root / "sparse").rename(root / "dense")


@case("colmap", r"holds cameras.bin but no images.bin: it is not whole. Copy the model again")
def half_a_model(root):
    (root / MODEL / "images.bin").unlink()


@case("colmap", r"cameras.bin holds a camera of the unknown model number 77. .*reconstruct with .*OPENCV")
def an_unknown_camera_number(root):
    content = bytearray((root / MODEL / "cameras.bin").read_bytes())
    content[12:16] = struct.pack("<i", 77)
    (root / MODEL / "cameras.bin").write_bytes(content)


@case("colmap", r"uses the camera model FOV, whose lens is not known here; .* image_undistorter")
def a_lens_that_is_not_known(root):
    cameras = struct.pack("<Q", 9)
    for number in range(1, 10):
        cameras += struct.pack("<IiQQ5d", number, 7, 16, 12, 20.0, 20.0, 8.0, 6.0, 0.1)
    (root / MODEL / "cameras.bin").write_bytes(cameras)


@case("colmap", r"mixes fisheye lenses with others \(OPENCV_FISHEYE, PINHOLE\), and a scene has one kind")
def two_kinds_of_lenses(root):
    cameras = struct.pack("<Q", 9) + struct.pack("<IiQQ8d", 1, 5, 16, 12, 20, 20, 8, 6, 0.1, 0, 0, 0)
    for number in range(2, 10):
        cameras += struct.pack("<IiQQ4d", number, 1, 16, 12, 20.0, 20.0, 8.0, 6.0)
    (root / MODEL / "cameras.bin").write_bytes(cameras)


@case("colmap", r"has no registered photograph, so nothing can be learnt. Copy the model again, or run .*nerf poses")
def an_empty_model(root):
    for name in ("cameras", "images", "points3D"):
        (root / MODEL / f"{name}.bin").write_bytes(struct.pack("<Q", 0))


@case("colmap", r"images.bin goes on for 4 bytes after what it announces: it is damaged or is no such file")
def a_file_with_a_tail(root):
    path = root / MODEL / "images.bin"
    path.write_bytes(path.read_bytes() + b"tail")


@case("colmap", r"(cameras|images).bin (ends after|goes on|holds)")
def files_exchanged(root):
    a, b = root / MODEL / "cameras.bin", root / MODEL / "images.bin"
    a.rename(root / "t")
    b.rename(a)
    (root / "t").rename(b)


@case("colmap", r"images.bin ends after \d+ bytes, in the middle of what it announces: it was cut short")
def more_images_announced_than_there_are(root):
    path = root / MODEL / "images.bin"
    path.write_bytes(struct.pack("<Q", 1 << 60) + path.read_bytes()[8:])


@case("colmap", r"images.bin ends after \d+ bytes")
def features_announced_that_are_not_there(root):
    image = struct.pack("<I7dI", 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0" + struct.pack("<Q", (1 << 64) - 1)
    (root / MODEL / "images.bin").write_bytes(struct.pack("<Q", 1) + image + bytes(100))


@case("colmap", r"images.bin holds a file name that is not UTF-8: b'\\xffp_0.png'")
def a_name_that_is_no_text(root):
    edit_bytes(root, "images.bin", b"p_0.png", b"\xffp_0.png")


@case("colmap", r"images.bin holds p_1.png more than once")
def a_photograph_twice(root):
    edit_bytes(root, "images.bin", b"p_0.png", b"p_1.png")


@case("colmap", r"images.bin holds a photograph without a name")
def a_photograph_without_a_name(root):
    edit_bytes(root, "images.bin", b"p_0.png", b"")


@case("colmap", r"cameras.bin holds 7 more than once")
def a_camera_twice(root):
    cameras = struct.pack("<Q", 2) + 2 * struct.pack("<IiQQ4d", 7, 1, 16, 12, 20.0, 20.0, 8.0, 6.0)
    (root / MODEL / "cameras.bin").write_bytes(cameras)


@case("colmap", r"sparse/0 name cameras that its cameras file lacks: 2, 3, 4, 5, 6, 7, 8, 9")
def cameras_that_are_not_listed(root):
    cameras = struct.pack("<Q", 1) + struct.pack("<IiQQ4d", 1, 1, 16, 12, 20.0, 20.0, 8.0, 6.0)
    (root / MODEL / "cameras.bin").write_bytes(cameras)


def put_point(root, x):
    point = struct.pack("<Q3d3BdQ", 1, x, 0, 0, 1, 1, 1, 0.1, 0)
    (root / MODEL / "points3D.bin").write_bytes(struct.pack("<Q", 1) + point)


@case("colmap", r"sparse/0: 1 of the 1 sparse points are NaN or not within 1e\+09 of the origin")
def points_with_nan(root):
    put_point(root, np.nan)


@case("colmap", r"sparse/0: 1 of the 1 sparse points are NaN or not within 1e\+09 of the origin")
def points_that_float32_cannot_hold(root):
    put_point(root, 1e300)


@case("text", r"sparse/0: 1 of the 60 sparse points are NaN or not within 1e\+09 of the origin")
def text_with_a_point_that_float32_cannot_hold(root):
    edit_text(root, "points3D.txt", lambda text: re.sub(r"(?m)^0 \S+", "0 -1e300", text))


@case("colmap", r"sparse/0 holds the model twice, and its binary and its text files disagree. Remove .* older")
def text_and_binary_of_other_poses(root):
    write_colmap(root, Known(c2w=ring(9, height=2.0)), ".txt")


@case("colmap", r"its binary and its text files disagree")
def text_and_binary_of_other_cameras(root):
    write_colmap(root, Known(focal=(21.0, 20.0)), ".txt")


@case("colmap", r"its binary and its text files disagree")
def text_and_binary_of_other_photographs(root):
    write_colmap(root, Known(names=tuple(f"q_{view}.png" for view in range(9))), ".txt")


@case("colmap", r"the view p_0.png has a pose or intrinsics with NaN or infinity. Remove it")
def a_quaternion_of_zeros(root):
    path = root / MODEL / "images.bin"
    content = bytearray(path.read_bytes())
    content[12:44] = bytes(32)
    path.write_bytes(content)


@case("colmap", r"sparse/0: the view p_0.png has the focal length 0, 20")
def a_focal_length_of_zero_along_x(root):
    write_colmap(root, Known(params=(0.0, 20.0, 8.0, 6.0)))


@case("colmap", r"has its principal point at 800, 600, outside of its 16 x 12 pixels. .*another size")
def a_principal_point_of_another_size(root):
    write_colmap(root, Known(params=(20.0, 20.0, 800.0, 600.0)))


@case("colmap", r"has the focal length 20, 20 for 0 x 0 pixels; all must be above 0")
def a_camera_without_size(root):
    cameras = struct.pack("<Q", 9)
    for number in range(1, 10):
        cameras += struct.pack("<IiQQ4d", number, 1, 0, 0, 20.0, 20.0, 8.0, 6.0)
    (root / MODEL / "cameras.bin").write_bytes(cameras)


@case("colmap", r"The lens of p_0.png .*folds back .* Check the coefficients")
def a_lens_that_folds_back(root):
    write_colmap(root, Known(camera="SIMPLE_RADIAL", params=(10.0, 8.0, 6.0, -2.0)))


@case("colmap", r"images_2 does not exist, and the model's photographs are looked for there. Set", images="images_2")
def a_folder_that_is_not_there(root):
    pass


@case("colmap", r"images lacks 1 of the 9 photographs of the model in \S+: p_3.png. Copy them there, or set")
def a_registered_photograph_is_missing(root):
    one_picture(root).unlink()


@case("colmap", r"names photographs by absolute paths of another machine: /home/ann/a.jpg. Make the names relative")
def absolute_names(root):
    edit_bytes(root, "images.bin", b"p_0.png", b"/home/ann/a.jpg")


@case("colmap", r"images lacks 1 of the 9 photographs")
def a_name_longer_than_names_can_be(root):
    edit_bytes(root, "images.bin", b"p_0.png", b"x" * 5000)


@case("text", r"cameras.txt, line 2 holds a camera of the unknown model 'PINHOLES'")
def an_unknown_camera_name(root):
    edit_text(root, "cameras.txt", lambda text: text.replace("PINHOLE", "PINHOLES"))


@case("text", r"cameras.txt, line 2 should hold 6 numbers there, but it holds 16 12 20.0 20.0 8.0")
def too_few_parameters(root):
    edit_text(root, "cameras.txt", lambda text: text.replace(" 6.0\n", "\n"))


@case("text", r"cameras.txt, line 2 should hold a whole number where nan stands")
def a_width_that_is_no_number(root):
    edit_text(root, "cameras.txt", lambda text: text.replace("PINHOLE 16", "PINHOLE nan"))


@case("text", r"images.txt, line 3 should hold 8 numbers there, but it holds")
def words_for_numbers(root):
    edit_text(root, "images.txt", lambda text: text.replace("p_0.png", "p_0.png").replace("10 ", "10 one ", 1))


@case("text", r"images.txt, line 3: the line after it must hold the photograph's features .* or be empty")
def text_without_lines_of_features(root):
    def change(text):
        lines = [line for line in text.split("\n") if line.endswith(".png") or line.startswith("#")]
        return "\n".join(lines)

    edit_text(root, "images.txt", change)


@case("text", r"images.txt, line 19 lacks the photograph's name")
def text_cut_short(root):
    edit_text(root, "images.txt", lambda text: text[: text.index(" p_8.png")])


@case("text", r"points3D.txt, line 60 should hold 3 numbers")
def points_cut_short(root):
    edit_text(root, "points3D.txt", lambda text: text[: text.rindex("\n59 ") + 4])


@case("text", r"images.txt is not a text file \(it is not UTF-8\)")
def text_that_is_binary(root):
    (root / MODEL / "images.txt").write_bytes(b"\xff\xfe\x00")


@pytest.mark.parametrize(("kind", "damage", "message", "settings"), case.params)
def test_it_is_refused_in_one_paragraph(tmp_path, kind, damage, message, settings):
    refused_when_damaged(tmp_path, kind, damage, message, settings)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_binary_cut_anywhere_is_refused(tmp_path, name):
    root = write_colmap(tmp_path / "capture", Known())
    path = root / MODEL / f"{name}.bin"
    content = path.read_bytes()
    for size in sorted({0, 1, 7, 8, 9, *range(10, len(content), 37), len(content) - 1}):
        path.write_bytes(content[:size])
        refused("colmap", root, rf"{name}.bin ends after {size} bytes, in the middle of what it announces")


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_binary_with_any_one_byte_changed_is_read_or_refused(tmp_path, name):
    root = write_colmap(tmp_path / "capture", Known(points=Known().points[:5]))
    path = root / MODEL / f"{name}.bin"
    content = path.read_bytes()
    rng = np.random.default_rng(4)
    for place in range(0, min(len(content), 200), 5):
        damaged = bytearray(content)
        damaged[place] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            read("colmap", root)
        except InputError:
            continue
