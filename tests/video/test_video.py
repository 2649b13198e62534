"""Films as one file: videos and animated pictures read back as what was written; what cannot be one leaves nothing."""

import os
import sys

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image
from support.videos import read_video

from nerf_lightning.messages.errors import InputError
from nerf_lightning.video.encoding import pad_to_even, write_animation, write_video

COLORS = [(220, 40, 40), (40, 180, 60), (30, 60, 200), (250, 250, 250)]


def plain(height, width, colors=COLORS):
    return [torch.tensor(color, dtype=torch.uint8).expand(height, width, 3) for color in colors]


def test_a_video_reads_back(tmp_path):
    path = tmp_path / "new" / "orbit.mp4"
    write_video(path, iter(plain(64, 96)), fps=24, total=4)
    meta, frames = read_video(path)
    assert frames.shape == (4, 64, 96, 3)
    assert meta["codec"] == "h264"
    assert meta["pix_fmt"].startswith("yuv420p")
    assert "bt709" in meta["pix_fmt"]
    assert meta["fps"] == 24
    assert np.abs(frames.astype(int) - np.array(COLORS)[:, None, None]).max() <= 4
    assert os.listdir(path.parent) == ["orbit.mp4"]


def test_brightness_is_stored_by_the_rule_that_the_file_names(tmp_path):
    path = tmp_path / "a.mp4"
    write_video(path, plain(64, 96), fps=24)
    _, stored = read_video(path, pix_fmt="yuv444p", bits_per_pixel=24)
    wanted = 16 + 219 / 255 * (np.array(COLORS) @ np.array([0.2126, 0.7152, 0.0722]))
    luma = stored.reshape(4, 3, -1)[:, 0].mean(axis=-1)
    assert np.abs(luma - wanted).max() < 1.5


def test_an_odd_size_gets_one_pixel_and_no_rescaling(tmp_path):
    stripes = torch.zeros(201, 301, 3, dtype=torch.uint8)
    stripes[:, ::20] = 255
    stripes[-1] = 128
    path = tmp_path / "odd.mp4"
    write_video(path, [stripes] * 3, fps=10)
    _, frames = read_video(path)
    assert frames.shape == (3, 202, 302, 3)
    assert np.abs(frames[0, 100, :301:20].astype(int) - 255).max() < 20
    assert frames[0, 100, 10:300:20].max() < 20


def test_padding_repeats_the_edge():
    picture = torch.arange(3 * 5 * 3).reshape(3, 5, 3).to(torch.uint8)
    padded = pad_to_even(picture)
    assert padded.shape == (4, 6, 3)
    assert torch.equal(padded[:3, :5], picture)
    assert torch.equal(padded[3, :5], picture[2])
    assert torch.equal(padded[:3, 5], picture[:, 4])
    assert torch.equal(pad_to_even(picture[:2, :4]), picture[:2, :4])


def test_a_broken_video_leaves_the_old_one_and_nothing_else(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"old")

    def stumble():
        yield from plain(32, 32)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(path, stumble(), fps=10)

    def lose_the_line():
        yield from plain(32, 32)
        raise BrokenPipeError("the frames' own pipe")

    with pytest.raises(BrokenPipeError, match="own pipe"):
        write_video(path, lose_the_line(), fps=10)
    with pytest.raises(ValueError, match="4 frames came, 5 were promised"):
        write_video(path, plain(32, 32), fps=10, total=5)
    with pytest.raises(ValueError, match="frame 1 is"):
        write_video(path, [*plain(32, 32)[:1], *plain(32, 34)], fps=10)
    with pytest.raises(ValueError, match="at least one frame"):
        write_video(path, [], fps=10)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.mp4"]


def test_ffmpeg_that_fails_is_quoted(tmp_path, monkeypatch):
    script = tmp_path / "ffmpeg"
    script.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('Unknown encoder libx264')\n")
    script.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(script))
    big = [torch.zeros(256, 256, 3, dtype=torch.uint8)] * 20  # more than the pipe holds
    for frames in (plain(8, 8), big):
        with pytest.raises(InputError, match=r"Unknown encoder libx264.*PNG frames"):
            write_video(tmp_path / "a.mp4", frames, fps=10)
    assert os.listdir(tmp_path) == ["ffmpeg"]


def test_no_ffmpeg_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match=r"does not start.*pip install imageio-ffmpeg.*PNG frames"):
        write_video(tmp_path / "a.mp4", plain(8, 8), fps=10)

    def none():
        raise RuntimeError("No ffmpeg exe could be found")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", none)
    with pytest.raises(InputError, match=r"there is none.*pip install imageio-ffmpeg.*PNG frames"):
        write_video(tmp_path / "a.mp4", plain(8, 8), fps=10)
    assert os.listdir(tmp_path) == []


def test_an_animation_reads_back_and_goes_on_without_end(tmp_path):
    colors, path = [COLORS[0], COLORS[1], COLORS[1], COLORS[3]], tmp_path / "new" / "orbit.webp"
    write_animation(path, iter(plain(21, 32, colors)), fps=20, total=4)
    with Image.open(path) as found:
        assert (found.size, found.n_frames, found.info["loop"]) == ((32, 21), 3, 0)
        for number, (color, duration) in enumerate([(COLORS[0], 50), (COLORS[1], 100), (COLORS[3], 50)]):
            found.seek(number)
            found.load()
            assert found.info["duration"] == duration
            assert np.abs(np.asarray(found.convert("RGB")).astype(int) - color).max() <= 6
    with pytest.raises(ValueError, match="4 frames came, 5 were promised"):
        write_animation(path.with_name("a.webp"), plain(8, 8), fps=20, total=5)
    with pytest.raises(InputError, match=r"20000 x 1 pixels is larger than a WebP can be.*Lower path\.width"):
        write_animation(path.with_name("b.webp"), plain(1, 20000), fps=20)
    assert [file.name for file in path.parent.iterdir()] == ["orbit.webp"]
