import struct
import threading
import zlib

import numpy as np
import pytest
from PIL import Image
from support.budget import budget
from support.captures import picture

from nerf_lightning.data.pixels import downscale, picture_files
from nerf_lightning.data.pixels.downscale import area_downscale, crop_to_multiple, downscaled_size, whole_blocks
from nerf_lightning.data.pixels.masks import read_mask
from nerf_lightning.data.pixels.picture_files import image_size, read_header, read_rgba
from nerf_lightning.messages.errors import InputError


def slow_downscale(rgba, factor):
    """Average premultiplied color block by block, in floating point."""
    height, width = rgba.shape[0] // factor, rgba.shape[1] // factor
    out = np.zeros((height, width, 4), dtype=np.uint8)
    for y in range(height):
        for x in range(width):
            block = rgba[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor].reshape(-1, 4)
            colour, alpha = np.zeros(3), 0.0
            for pixel in block.astype(np.float64):
                colour += pixel[:3] * pixel[3] / factor**2
                alpha += pixel[3] / factor**2
            if np.floor(alpha + 0.5) > 0:
                out[y, x] = np.floor(np.array([*(colour / alpha), alpha]) + 0.5 + 1e-9)
    return out


def png_16_bit(values):
    """Return a 16-bit RGB png of one row, which PIL cannot write."""

    def chunk(kind, content):
        check = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)

    header = struct.pack(">IIBBBBB", len(values), 1, 16, 2, 0, 0, 0)
    row = b"\0" + b"".join(struct.pack(">3H", *value) for value in values)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(row)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


@pytest.mark.parametrize("factor", [1, 2, 3, 6])
def test_area_filter_equals_the_slow_loop(factor):
    rgba = picture(1, width=18, height=12)
    rgba[:6, :6, 3] = 0
    rgba[0, 0] = (250, 120, 3, 1)
    expected = rgba if factor == 1 else slow_downscale(rgba, factor)
    assert np.array_equal(area_downscale(rgba, factor), expected)


@pytest.mark.parametrize("alpha", ["opaque", "opaque above", "any"])
def test_what_is_shrunk_in_parts_has_the_means_of_the_whole(monkeypatch, alpha):
    rgba = np.random.default_rng(0).integers(0, 256, (21, 12, 4), dtype=np.uint8)
    if alpha != "any":
        rgba[: 21 if alpha == "opaque" else 9, :, 3] = 255
    monkeypatch.setattr(downscale, "PIXELS_AT_ONCE", 100)  # two rows of blocks, and then one that is left
    assert np.array_equal(area_downscale(rgba, 3), slow_downscale(rgba, 3))


def test_blocks_whose_sums_pass_32_bits_are_shrunk_exactly():
    rgba = np.full((200, 200, 4), 255, dtype=np.uint8)
    rgba[0, 0, 3] = 254  # not opaque: sums of 200 * 200 * 255 * 255, doubled, are more than 2^32
    assert area_downscale(rgba, 200).tolist() == [[[255, 255, 255, 255]]]


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA"])
def test_modes_with_a_plain_reading(tmp_path, mode):
    path = tmp_path / "a.png"
    image = Image.fromarray(picture(2)).convert("RGB" if mode == "P" else "RGBA").convert(mode)
    image.save(path)
    rgba = read_rgba(path)
    assert np.array_equal(rgba, np.asarray(image.convert("RGBA")))
    if mode not in ("LA", "RGBA"):
        assert rgba[..., 3].min() == 255


def test_palette_with_transparency(tmp_path):
    image = Image.new("P", (2, 1))
    image.putpalette([10, 20, 30, 40, 50, 60])
    image.putpixel((1, 0), 1)
    image.save(tmp_path / "a.png", transparency=1)
    assert read_rgba(tmp_path / "a.png").tolist() == [[[10, 20, 30, 255], [40, 50, 60, 0]]]


def test_sixteen_bit_colour_keeps_the_upper_byte(tmp_path):
    (tmp_path / "a.png").write_bytes(png_16_bit([(0, 257 * 128, 65535), (257, 513, 255)]))
    assert read_rgba(tmp_path / "a.png").tolist() == [[[0, 128, 255, 255], [1, 2, 0, 255]]]


def saved(image, name, **options):
    return lambda folder: image.save(folder / name, **options)


RGB = [Image.fromarray(picture(view)[..., :3]) for view in range(3)]
SEVERAL = {"save_all": True, "append_images": RGB[1:]}
REFUSED = [
    ("a.tif", saved(Image.fromarray(np.full((2, 2), 0.5, np.float32)), "a.tif"), r"pixel mode 'F'.* 8-bit RGB"),
    ("a.webp", saved(RGB[0], "a.webp", **SEVERAL), r"holds several pictures.* Save each as a file of its own"),
    ("a.png", saved(RGB[0], "a.png", **SEVERAL), r"holds several pictures"),
    ("a.tiff", saved(RGB[0], "a.tiff", **SEVERAL), r"holds several pictures"),
    # Of a format that starts another program.
    ("a.eps", saved(RGB[0], "a.eps"), r"is not an image that can be read"),
    ("b.png", lambda folder: (folder / "b.png").write_bytes(png_16_bit([])), r"is not an image that can be read"),
    ("c.png", lambda folder: None, r"does not exist; the folder holds nothing"),
]


@pytest.mark.parametrize(("name", "write", "message"), REFUSED)
def test_refuses_by_name(tmp_path, name, write, message):
    write(tmp_path)
    with pytest.raises(InputError, match=f"{name} {message}|{name} has the {message}"):
        image_size(tmp_path / name)


def test_the_preview_that_a_phone_appends_to_its_jpeg_is_no_second_picture(tmp_path):
    first, second = (Image.fromarray(picture(view)[..., :3]) for view in range(2))
    first.save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=[second])
    first.save(tmp_path / "b.jpg")
    with Image.open(tmp_path / "a.jpg") as image:
        assert image.n_frames == 2
    assert np.array_equal(read_rgba(tmp_path / "a.jpg"), read_rgba(tmp_path / "b.jpg"))


@pytest.mark.parametrize("ending", ["png", "jpg", "webp", "tif"])
def test_a_truncated_file_is_named(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    Image.fromarray(picture(0, 64, 64)[..., :3]).save(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    with pytest.raises(InputError, match=rf"a.{ending} (cannot be read|is not an image).* Copy or render it again"):
        read_rgba(path)


def test_a_mask_keeps_what_is_brighter_than_127(tmp_path):
    Image.fromarray(np.array([[0, 1, 127, 128, 255]], dtype=np.uint8)).save(tmp_path / "m.png")
    assert read_mask(tmp_path / "m.png").tolist() == [[False, False, False, True, True]]
    Image.fromarray(np.array([[True, False]])).save(tmp_path / "one_bit.png")
    assert read_mask(tmp_path / "one_bit.png").tolist() == [[True, False]]


@pytest.mark.parametrize("on", [(0, 0, 0, 255), (255, 0, 0, 0), (255, 255, 255, 0), (255, 255, 255, 255)])
def test_a_mask_may_be_in_alpha_or_red_alone(tmp_path, on):
    off = (0, 0, 0, 0)
    Image.fromarray(np.array([[on, off]], np.uint8)).save(tmp_path / "m.png")
    assert read_mask(tmp_path / "m.png").tolist() == [[True, False]]


def test_a_mask_whose_channels_say_different_things_is_refused(tmp_path):
    Image.fromarray(np.array([[[255, 0, 0], [0, 255, 0]]], np.uint8)).save(tmp_path / "m.png")
    with pytest.raises(InputError, match=r"mask .*m.png has colors or transparent pixels.* white is kept"):
        read_mask(tmp_path / "m.png")


def test_a_factor_that_does_not_divide_crops_right_and_bottom():
    rgba = picture(4, width=11, height=8)
    assert downscaled_size(11, 8, 3) == (3, 2)
    assert np.array_equal(area_downscale(crop_to_multiple(rgba, 3), 3), slow_downscale(rgba[:6, :9], 3))
    with pytest.raises(InputError, match=r"scene.downscale=9 leaves nothing of a photograph of 11 x 8.* from 1 to 8"):
        downscaled_size(11, 8, 9)


def test_a_block_is_kept_if_all_of_it_is():
    kept = np.ones((5, 7), dtype=bool)
    kept[0, 3] = kept[4, 6] = False
    assert whole_blocks(kept, 2).tolist() == [[True, False, True], [True, True, True]]


@pytest.mark.parametrize("ending", ["png", "jpg", "webp"])
def test_a_picture_is_read_as_it_is_stored_or_upright(tmp_path, ending):
    path, rgb = tmp_path / f"a.{ending}", picture(0, 6, 4)[..., :3]
    for tag, orientation in ((6, 6), (0, 1), (9, 1)):
        exif = Image.Exif()
        exif[0x0112] = tag
        Image.fromarray(rgb).save(path, exif=exif)
        assert read_header(path).orientation == orientation
    exif[0x0112] = 6
    Image.fromarray(rgb).save(path, exif=exif)
    stored = read_rgba(path)
    assert stored.shape == (4, 6, 4)
    assert np.array_equal(read_rgba(path, upright=True), np.rot90(stored, -1))


def test_refuses_decompression_bombs(tmp_path):
    Image.new("1", (1200, 1000)).save(tmp_path / "a.png")
    assert image_size(tmp_path / "a.png") == (1200, 1000)
    with (
        budget(megapixels=1),
        pytest.raises(InputError, match=r"more megapixels than the limit of 1\. .*budgets.megap"),
    ):
        image_size(tmp_path / "a.png")


def test_large_pictures_are_decoded_one_at_a_time(tmp_path, monkeypatch):
    Image.new("RGB", (20, 10)).save(tmp_path / "a.png")
    for least, waits in ((199, True), (200, False)):
        monkeypatch.setattr(picture_files, "LARGE", least)
        read = threading.Event()
        other = threading.Thread(target=lambda read=read: (picture_files.read_rgba(tmp_path / "a.png"), read.set()))
        with picture_files.opened_picture(tmp_path / "a.png"):
            other.start()
            assert read.wait(timeout=0.3 if waits else 30) is not waits
        other.join()
        assert read.is_set()
