"""Small pictures that ask for much: decoded to what they announce, or one paragraph, soon and in bounded memory."""

import functools
import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image
from support.fuzzing import harmless

from nerf_lightning.data.pixels.picture_files import image_size, read_rgba

MEGABYTE = 1 << 20
PIXELS = np.random.default_rng(0).integers(0, 256, (12, 16, 4), dtype=np.uint8)
RGBA, RGB = Image.fromarray(PIXELS), Image.fromarray(PIXELS[..., :3])


def encoded(image: Image.Image, form: str, **options) -> bytes:
    stream = io.BytesIO()
    image.save(stream, form, **options)
    return stream.getvalue()


def animated(form: str) -> bytes:
    return encoded(RGBA, form, save_all=True, append_images=[RGBA.rotate(90), RGBA])


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(*middle: bytes, width: int = 16, height: int = 12, form: tuple[int, ...] = (8, 2, 0, 0, 0)) -> bytes:
    rows = zlib.compress(bytes((16 * 3 + 1) * 24))
    head = chunk(b"IHDR", struct.pack(">II5B", width, height, *form))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(middle) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


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


@functools.cache
def packed() -> bytes:
    return zlib.compress(bytes(200 * MEGABYTE), 1)


def large_jpeg(side: int) -> bytes:
    return encoded(RGB, "JPEG").replace(struct.pack(">HH", 12, 16), struct.pack(">HH", side, side), 1)


def lying_webp() -> bytes:
    content = bytearray(animated("WEBP"))
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
    "an animation of billions": lambda: animated("PNG").replace(b"acTL\0\0\0\3", b"acTL\x7f\xff\xff\xff"),
    "a canvas of 16 million squared": lying_webp,
}


@pytest.mark.parametrize("kind", BOMBS)
def test_a_bomb(tmp_path, kind):
    content = BOMBS[kind]()
    assert len(content) < 4 * MEGABYTE
    (tmp_path / "a.png").write_bytes(content)
    harmless(decode, tmp_path / "a.png")
