"""Animated pictures hold every frame, for as long as it should be seen."""

import numpy as np
import pytest
import torch
from PIL import Image

from nerf_lightning.errors import InputError
from nerf_lightning.video.animation import write_animation

COLORS = [(220, 40, 40), (40, 180, 60), (40, 180, 60), (250, 250, 250)]


def plain(height, width, colors=COLORS):
    return [torch.tensor(color, dtype=torch.uint8).expand(height, width, 3) for color in colors]


def test_it_reads_back_and_goes_on_without_end(tmp_path):
    path = tmp_path / "new" / "orbit.webp"
    write_animation(path, iter(plain(21, 32)), fps=20, total=4)
    with Image.open(path) as found:
        assert (found.size, found.n_frames, found.info["loop"]) == ((32, 21), 3, 0)
        for number, (color, duration) in enumerate([(COLORS[0], 50), (COLORS[1], 100), (COLORS[3], 50)]):
            found.seek(number)
            found.load()
            assert found.info["duration"] == duration
            assert np.abs(np.asarray(found.convert("RGB")).astype(int) - color).max() <= 6
    assert [file.name for file in path.parent.iterdir()] == ["orbit.webp"]


def test_what_cannot_be_one_leaves_nothing(tmp_path):
    path = tmp_path / "a.webp"
    with pytest.raises(ValueError, match="at least one frame"):
        write_animation(path, iter([]), fps=20)
    with pytest.raises(ValueError, match="4 frames came, 5 were promised"):
        write_animation(path, plain(8, 8), fps=20, total=5)
    with pytest.raises(InputError, match=r"20000 x 1 pixels is larger than a WebP can be.*Lower path\.width"):
        write_animation(path, plain(1, 20000), fps=20)
    assert not list(tmp_path.iterdir())
