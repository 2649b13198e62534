"""Broken photographs, and settings that do not suit the capture: one paragraph each, never another exception."""

import struct
import zlib
from pathlib import Path

import pytest
from PIL import Image
from support.malformed import WRITERS, Cases, one_picture, refused, refused_when_damaged
from support.posed_captures import Known, photograph, read, wall, write_llff, write_transforms

case = Cases()


@case("colmap", r"p_3.png has 12 x 12 pixels, but its camera was calibrated for 16 x 12: .* use the original one")
def a_photograph_that_was_cropped(root):
    Image.fromarray(photograph(3, 12, 12)).save(one_picture(root))


@case("colmap", r"p_3.png is empty \(0 bytes\). Copy or render it again")
def a_photograph_without_bytes(root):
    one_picture(root).write_bytes(b"")


@case("colmap", r"p_3.png is not an image that can be read")
def a_photograph_that_is_text(root):
    one_picture(root).write_text("<html>404</html>")


@case("colmap", r"p_3.png cannot be read: .* cut short")
def a_photograph_cut_short(root):
    one_picture(root).write_bytes(one_picture(root).read_bytes()[:-150])


def png_header(width, height):
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    end = b"IEND"
    chunks = [struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in (header, b"IDATx", end)]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


@case("colmap", r"p_3.png is not an image that can be read. Copy or render it again")
def a_photograph_of_no_pixels(root):
    one_picture(root).write_bytes(png_header(0, 0))


@case("colmap", r"p_3.png announces more than 178 megapixels; .* add budgets.megapixels=")
def a_photograph_of_200_megapixels(root):
    one_picture(root).write_bytes(png_header(20_000, 10_000))


@case("colmap", r"p_3.png has CMYK colours, which are for printing, and no one reading as RGB. Convert it")
def a_photograph_in_cmyk(root):
    Image.fromarray(photograph(3, 16, 12)).convert("CMYK").save(one_picture(root), format="JPEG")


@case("colmap", r"p_3.png holds 2 pictures \(an animation, or pages\), and which of them was meant is not known")
def a_photograph_that_moves(root):
    pictures = [Image.fromarray(photograph(view, 16, 12)) for view in range(2)]
    pictures[0].save(one_picture(root), save_all=True, append_images=pictures[1:])


@case(
    "colmap",
    r"p_3.png carries the EXIF orientation 6: it is stored turned .* remove the tag alone .* turn the pixels",
)
def a_photograph_that_lies_on_its_side(root):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(photograph(3, 16, 12)).save(one_picture(root), format="JPEG", exif=exif)


@case("colmap", r"images lacks 1 of the 9 photographs .*p_3.png")
def a_link_that_leads_to_itself(root):
    one_picture(root).unlink()
    one_picture(root).symlink_to(one_picture(root))


@case("llff", r"p_3.png cannot be read: .*symbolic links")
def a_link_that_leads_to_itself_in_order_of_names(root):
    one_picture(root).unlink()
    one_picture(root).symlink_to(one_picture(root))


@case("llff", r"The folder \S+capture does not exist")
def a_folder_that_leads_to_itself(root):
    root.rename(root.parent / "elsewhere")
    root.symlink_to(root)


@case(
    "llff",
    r"scene.downscale=13 leaves nothing of a photograph of 16 x 12 pixels. Choose a",
    downscale=13,
)
def shrunk_to_nothing(root):
    pass


@case(
    "colmap",
    r"scene.frames='IMG_\*' fits none of the views of \S+sparse/0; they are p_0.png, .* 4 more",
    frames="IMG_*",
)
def a_filter_that_fits_nothing(root):
    pass


@case("colmap", r"scene.near=5.0 and scene.far=2.0: rays need 0 <= near < far", near=5.0, far=2.0)
def near_behind_far(root):
    pass


@case("colmap", r"scene.near=nan .*rays need 0 <= near < far", near=float("nan"))
def near_that_is_no_number(root):
    pass


@case("colmap", r"scene.near=1000 lies behind all content of \S+sparse/0, which ends at", near=1000.0)
def near_behind_everything(root):
    pass


@case("colmap", r"scene.hold_every=1 would leave nothing to learn from: give 2 or more", hold_every=1)
def everything_held_out(root):
    pass


@case("colmap", r"scene.background is 'pink'; choose one of", background="pink")
def an_unknown_background(root):
    pass


@case("llff", r"scene.space=ndc needs cameras that all look the same way, .*scene.space=contracted", space="ndc")
def ndc_of_a_ring(root):
    pass


@case("transforms", r"scene.space=ndc needs the depth at which content begins, .* Give scene.near", space="ndc")
def ndc_without_depths(root):
    write_transforms(root, Known(c2w=wall()))


@case("llff", r"scene.far=9 cannot be kept with scene.space=ndc, which reaches to infinity. Leave it out", far=9.0)
def ndc_with_an_end(root):
    write_llff(root, Known(c2w=wall()))


@case("llff", r"scene.space=ndc: the view p_4.png .* stands 2.\d+ ahead of the cameras' middle, behind the near plane")
def a_camera_behind_the_near_plane(root):
    poses = wall()
    poses[4, 1, 3] += 3.0
    write_llff(root, Known(c2w=poses))


@pytest.mark.parametrize(("kind", "damage", "message", "settings"), case.params)
def test_it_is_refused_in_one_paragraph(tmp_path, kind, damage, message, settings):
    refused_when_damaged(tmp_path, kind, damage, message, settings)


def test_a_folder_of_a_user_that_is_not_known():
    refused("llff", Path("~nobody_of_that_name/capture"), r"scene.root=~nobody\S+: .*home directory.* Give the folder")


@pytest.mark.parametrize("kind", WRITERS)
def test_unharmed_captures_are_read(tmp_path, kind):
    assert len(read("colmap" if kind == "text" else kind, WRITERS[kind](tmp_path / kind)).view_names) == 9
