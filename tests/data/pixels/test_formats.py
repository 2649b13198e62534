"""Formats beside JPEG and PNG: those of phones, and those that are refused."""

import logging

import numpy as np
import pytest
from PIL import Image, features
from support.captures import picture
from support.decoders import without_heic

from nerf_lightning.data.pixels import picture_files
from nerf_lightning.data.pixels.formats import FORMATS, decoders
from nerf_lightning.data.pixels.picture_files import image_size, read_header, read_rgba
from nerf_lightning.data.sfm.photograph_folder import find_photographs, put_upright
from nerf_lightning.messages.errors import InputError

HEIC = b"\0\0\0\x18ftypheic" + bytes(100)
EXACT = {"quality": -1, "chroma": 444}
PHOTOGRAPH = Image.fromarray(np.kron(picture(0)[..., :3], np.ones((12, 16, 1), np.uint8)))


@pytest.fixture
def heif():
    library = pytest.importorskip("pillow_heif")
    assert "HEIF" in decoders()
    return library


def differences(path, wanted):
    return np.abs(read_rgba(path)[..., :3].astype(int) - np.asarray(wanted)).max()


def test_no_other_decoder_is_reached():
    assert set(decoders()) <= set(FORMATS) == {"PNG", "JPEG", "TIFF", "WEBP", "AVIF", "HEIF"}


def test_heic_without_its_decoder_names_the_extra_first(tmp_path):
    (tmp_path / "a.jpg").write_bytes(HEIC)
    with without_heic(), pytest.raises(InputError, match=r"HEIC.*: pip install '\.\[heic\]'\. Or convert"):
        image_size(tmp_path / "a.jpg")


def test_heic_is_read_as_a_phone_shows_it(heif, tmp_path):
    turned = Image.Exif()
    turned[picture_files.ORIENTATION] = 6
    PHOTOGRAPH.save(tmp_path / "a.heic", **EXACT)
    PHOTOGRAPH.save(tmp_path / "b.heic", exif=turned.tobytes(), **EXACT)
    assert differences(tmp_path / "a.heic", PHOTOGRAPH) <= 2
    assert image_size(tmp_path / "b.heic") == PHOTOGRAPH.size[::-1]
    assert read_header(tmp_path / "b.heic").orientation == 1
    assert differences(tmp_path / "b.heic", PHOTOGRAPH.transpose(Image.Transpose.ROTATE_270)) <= 2


def test_of_a_heic_the_primary_picture_counts(heif, tmp_path):
    file = heif.from_pillow(PHOTOGRAPH.resize((40, 30)))
    file.add_from_pillow(PHOTOGRAPH)
    file.save(tmp_path / "a.heic", primary_index=1, **EXACT)
    assert image_size(tmp_path / "a.heic") == PHOTOGRAPH.size
    assert differences(tmp_path / "a.heic", PHOTOGRAPH) <= 2


def test_a_damaged_heic_is_named(heif, tmp_path):
    PHOTOGRAPH.save(tmp_path / "a.heic")
    for content in (HEIC, (tmp_path / "a.heic").read_bytes()[:-100]):
        (tmp_path / "a.heic").write_bytes(content)
        with pytest.raises(InputError, match=r"a.heic is a photograph in the format HEIC\. It cannot be decoded"):
            read_rgba(tmp_path / "a.heic")


def test_formats_that_colmap_does_not_read_are_written_as_jpeg_or_png(heif, tmp_path):
    exif = Image.Exif()
    exif[0x0110] = "Phone"
    for name in ("a.heic", "b.HEIC", "b.jpg"):
        PHOTOGRAPH.save(tmp_path / name, exif=exif.tobytes(), icc_profile=b"profile")
    Image.fromarray(np.asarray(PHOTOGRAPH.convert("RGBA")) // 2).save(tmp_path / "c.webp")
    (tmp_path / "out").mkdir()
    for photograph in find_photographs(tmp_path):
        put_upright(photograph, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.heic.jpg", "b.jpg", "c.webp.png"]
    with Image.open(tmp_path / "out" / "a.heic.jpg") as written:
        assert (written.getexif()[0x0110], written.info["icc_profile"]) == ("Phone", b"profile")
    assert read_rgba(tmp_path / "out" / "c.webp.png")[..., 3].max() == 127


@pytest.mark.skipif("avif" not in features.modules or not features.check("avif"), reason="Pillow has no AVIF")
def test_avif(tmp_path):
    PHOTOGRAPH.save(tmp_path / "a.avif", quality=100, subsampling="4:4:4")
    assert differences(tmp_path / "a.avif", PHOTOGRAPH) <= 4


@pytest.mark.parametrize(("name", "cure"), [("a.dng", "Develop all of them"), ("a.EXR", "magick mogrify")])
def test_raw_and_linear_files_are_refused_before_their_preview_is_read(tmp_path, name, cure):
    PHOTOGRAPH.save(tmp_path / name, format="TIFF")
    with pytest.raises(InputError, match=f"{name} cannot be read.*{cure}"):
        read_rgba(tmp_path / name)


def test_of_sixteen_bits_it_is_said_once_what_is_kept(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    for name in ("a.png", "b.tif"):
        Image.fromarray(np.full((4, 4), 0x1234, np.uint16)).save(tmp_path / name)
        assert read_rgba(tmp_path / name)[0, 0, 0] == 0x12
    assert caplog.messages == [f"{tmp_path}: pictures with 16 bits per channel are read with the upper 8"]
