import base64
import io

import numpy as np
import pytest
from PIL import Image

from nerf_lightning.messages.errors import InputError
from nerf_lightning.report.embedding import LONGEST_SIDE, embedded, embedded_file, embedded_video


def decoded(picture):
    content = base64.b64decode(picture.source.removeprefix("data:image/webp;base64,"))
    return np.asarray(Image.open(io.BytesIO(content)))


def test_small_pictures_are_kept_exactly_and_large_ones_shrunk():
    random = np.random.default_rng(0)
    picture = random.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    assert (decoded(embedded(picture)) == picture).all()
    assert embedded(picture).is_small
    wide = embedded(np.zeros((10, 2 * LONGEST_SIDE, 3), dtype=np.uint8))
    assert decoded(wide).shape == (5, LONGEST_SIDE, 3)
    assert not wide.is_small


def test_nothing_of_a_file_but_its_pixels_comes_into_a_page(tmp_path):
    path = tmp_path / "a.png"
    Image.new("RGB", (8, 8), "red").save(path)
    path.write_bytes(path.read_bytes() + b"planted behind the end")
    content = base64.b64decode(embedded_file(path).source.partition(",")[2])
    assert b"planted" not in content


def test_what_is_no_film_is_refused(tmp_path):
    path = tmp_path / "a.mp4"
    with pytest.raises(InputError, match="cannot be read"):
        embedded_video(path, 100)
    path.write_bytes(b"<html>")
    with pytest.raises(InputError, match="not an mp4"):
        embedded_video(path, 100)
    path.write_bytes(b"\0\0\0\x18ftypisom")
    assert embedded_video(path, 100).startswith("data:video/mp4;base64,")
    with pytest.raises(InputError, match="max_megabytes"):
        embedded_video(path, 5)
