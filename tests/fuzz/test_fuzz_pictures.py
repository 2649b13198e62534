"""Damaged pictures, and small ones that ask for much: decoded to what they announce, or one paragraph."""

import functools
import io
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin
from support.fuzzing import fuzzed, harmless
from support.mutations import EXTREMES, damaged

from nerf_lightning.data.pixels.images import image_size, read_mask, read_rgba

MEGABYTE = 1 << 20
PIXELS = np.random.default_rng(0).integers(0, 256, (12, 16, 4), dtype=np.uint8)
PLANE = Image.fromarray(PIXELS[..., 0])


def encoded(image: Image.Image, form: str, **options) -> bytes:
    stream = io.BytesIO()
    image.save(stream, form, **options)
    return stream.getvalue()


def with_text() -> PngImagePlugin.PngInfo:
    info = PngImagePlugin.PngInfo()
    info.add_text("a", "b" * 50, zip=True)
    info.add_itxt("c", "d" * 50, zip=True)
    return info


def exif(orientation: int = 1) -> Image.Exif:
    tags = Image.Exif()
    tags[0x0112], tags[0x010F] = orientation, "maker"
    return tags


RGBA, RGB = Image.fromarray(PIXELS), Image.fromarray(PIXELS[..., :3])
SOUND = {
    "png": encoded(RGBA, "PNG"),
    "png with all": encoded(RGB, "PNG", pnginfo=with_text(), icc_profile=bytes(300), exif=exif()),
    "png of a palette": encoded(RGB.convert("P"), "PNG", transparency=3),
    "png of 16 bits": encoded(Image.fromarray(PIXELS[..., 0].astype(np.uint16) << 8), "PNG"),
    "interlaced": b"\x89PNG\r\n\x1a\n",
    "animated png": encoded(RGBA, "PNG", save_all=True, append_images=[RGBA.rotate(90), RGBA]),
    "jpeg": encoded(RGB, "JPEG", exif=exif(), icc_profile=bytes(300)),
    "progressive": encoded(RGB, "JPEG", progressive=True, comment=b"c" * 40),
    "grey jpeg": encoded(PLANE, "JPEG"),
    "tiff": encoded(RGB, "TIFF"),
    "tiff in lzw": encoded(RGBA, "TIFF", compression="tiff_lzw"),
    "tiff deflated": encoded(RGB, "TIFF", compression="tiff_adobe_deflate", exif=exif()),
    "tiff as jpeg": encoded(RGB, "TIFF", compression="jpeg"),
    "tiff of pages": encoded(RGB, "TIFF", save_all=True, append_images=[RGB, RGB]),
    "webp": encoded(RGB, "WEBP", exif=exif(), icc_profile=bytes(300)),
    "lossless webp": encoded(RGBA, "WEBP", lossless=True),
    "animated webp": encoded(RGBA, "WEBP", save_all=True, append_images=[RGBA.rotate(90), RGBA]),
    "gif": encoded(RGB, "GIF"),
}


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(*middle: bytes, width: int = 16, height: int = 12, form: tuple[int, ...] = (8, 2, 0, 0, 0)) -> bytes:
    rows = zlib.compress(bytes((16 * 3 + 1) * 24))
    head = chunk(b"IHDR", struct.pack(">II5B", width, height, *form))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(middle) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


SOUND["interlaced"] = png(form=(8, 2, 0, 0, 1))


def tiff(**changed: tuple[int, int, int]) -> bytes:
    """Return a TIFF of these tags: name (t and a number), and its type, count and value."""
    tags = {256: (4, 1, 16), 257: (4, 1, 12), 258: (3, 1, 8), 259: (3, 1, 1), 262: (3, 1, 1), 273: (4, 1, 8)}
    tags |= {277: (3, 1, 1), 278: (4, 1, 12), 279: (4, 1, 192)} | {int(key[1:]): tag for key, tag in changed.items()}
    entries = b"".join(struct.pack("<HHII", number, *tag) for number, tag in sorted(tags.items()))
    where = 8 + 192
    return b"II*\0" + struct.pack("<I", where) + bytes(192) + struct.pack("<H", len(tags)) + entries + bytes(4)


def decode(path):
    """Return a picture as a reader of captures does: its size first, its pixels later."""
    size = image_size(path)
    rgba = read_rgba(path)
    assert rgba.dtype == np.uint8
    assert rgba.shape == (*size[::-1], 4)
    return rgba


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("pictures") / "a.png"


@pytest.mark.parametrize("kind", SOUND)
def test_a_sound_picture(file, kind):
    file.write_bytes(SOUND[kind])
    read = harmless(decode, file)
    assert (read is None) == (kind in ("gif", "animated png", "animated webp", "tiff of pages"))


@fuzzed(120)
@given(kind=st.sampled_from(sorted(SOUND)), data=st.data())
def test_a_damaged_picture(file, kind, data):
    file.write_bytes(data.draw(damaged(SOUND[kind])))
    harmless(decode, file)
    harmless(read_mask, file)


@fuzzed(20)
@given(data=st.data())
def test_a_png_with_other_chunks(file, data):
    """Chunks have checksums, so that changed bytes alone never come through."""
    kinds = st.sampled_from(
        (b"iCCP", b"zTXt", b"iTXt", b"tEXt", b"eXIf", b"tRNS", b"PLTE", b"acTL", b"fcTL", b"gAMA", b"pHYs", b"cHRM")
    )
    content = st.binary(max_size=40) | st.sampled_from(
        (b"n\0\0" + zlib.compress(bytes(5000)), b"n\0\1\0\0\0", bytes(900))
    )
    chunks = data.draw(st.lists(st.builds(chunk, kinds, content), max_size=4))
    sides = st.sampled_from((0, 1, 12, 16, 65535, 1 << 24, (1 << 31) - 1, 1 << 31))
    form = data.draw(st.just((8, 2, 0, 0, 0)) | st.tuples(*[st.integers(0, 17)] * 5))
    width, height = (data.draw(st.just(side) | sides) for side in (16, 12))
    file.write_bytes(png(*chunks, width=width, height=height, form=form))
    harmless(decode, file)


@fuzzed(20)
@given(data=st.data())
def test_a_tiff_with_other_tags(file, data):
    numbers = (
        254,
        256,
        257,
        258,
        259,
        262,
        266,
        273,
        274,
        277,
        278,
        279,
        284,
        317,
        320,
        322,
        323,
        330,
        338,
        339,
        34665,
        34675,
    )
    tag = st.tuples(
        st.integers(0, 18), st.sampled_from(EXTREMES[:12]), st.integers(0, 300) | st.sampled_from(EXTREMES[:12])
    )
    found = data.draw(st.dictionaries(st.sampled_from(numbers).map(lambda number: f"t{number}"), tag, max_size=3))
    tags = {key: tuple(number & 0xFFFFFFFF for number in value) for key, value in found.items()}
    file.write_bytes(tiff(**{key: (kind & 0xFFFF, count, value) for key, (kind, count, value) in tags.items()}))
    harmless(decode, file)


@functools.cache
def packed() -> bytes:
    return zlib.compress(bytes(200 * MEGABYTE), 1)


def large_jpeg(side: int) -> bytes:
    return SOUND["jpeg"].replace(struct.pack(">HH", 12, 16), struct.pack(">HH", side, side), 1)


def lying_webp() -> bytes:
    content = bytearray(SOUND["animated webp"])
    content[24:30] = b"\xff" * 6
    return bytes(content)


LOOP = b"Exif\0\0II*\0\x08\0\0\0" + struct.pack("<HHHIII", 1, 0x8769, 4, 1, 8, 8)
BOMBS = {
    "a profile": lambda: png(chunk(b"iCCP", b"n\0\0" + packed())),
    "a text": lambda: png(chunk(b"zTXt", b"n\0\0" + packed())),
    "an international text": lambda: png(chunk(b"iTXt", b"n\0\1\0\0\0" + packed())),
    "many texts": lambda: png(*[chunk(b"zTXt", b"n\0\0" + zlib.compress(bytes(MEGABYTE)))] * 200),
    "many chunks": lambda: png(*[chunk(b"tEXt", b"n\0a")] * 100_000),
    "rows beyond its height": lambda: png(chunk(b"IDAT", packed())),
    "an exif within itself": lambda: encoded(RGB, "JPEG", exif=LOOP),
    "a tag of four billion bytes": lambda: tiff(t34675=(1, 0xFFFFFFFF, 8)),
    "many samples": lambda: tiff(t277=(3, 1, 65535)),
    "pages in a ring": lambda: tiff()[:-4] + struct.pack("<I", 200),
    "a jpeg of 60,000 squared": lambda: large_jpeg(60_000),
    "a jpeg of 9,000 squared": lambda: large_jpeg(9000),
    "an animation of billions": lambda: SOUND["animated png"].replace(b"acTL\0\0\0\3", b"acTL\x7f\xff\xff\xff"),
    "a canvas of 16 million squared": lying_webp,
}


@pytest.mark.parametrize("kind", BOMBS)
def test_a_bomb(file, kind):
    content = BOMBS[kind]()
    assert len(content) < 4 * MEGABYTE
    file.write_bytes(content)
    harmless(decode, file)
