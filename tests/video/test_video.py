"""Films as one file, with alpha and as EXR frames: what is read back was written; what cannot be leaves nothing."""

import os
import sys
from dataclasses import replace

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image
from support.known_fields import ball, solid
from support.scenes import ball_scene
from support.videos import read_video

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.world_frame import similarity
from nerf_lightning.video import encoding, exr
from nerf_lightning.video.encoding import pad_to_even, write_animation, write_video
from nerf_lightning.video.film import film
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.settings import FilmSettings, film_settings
from nerf_lightning.video.shots import Subject, content_of, make_shots

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


def test_an_odd_size_gets_one_pixel_that_repeats_the_edge_and_no_rescaling(tmp_path):
    stripes = torch.zeros(201, 301, 3, dtype=torch.uint8)
    stripes[:, ::20] = 255
    stripes[-1] = 128
    path = tmp_path / "odd.mp4"
    write_video(path, [stripes] * 3, fps=10)
    _, frames = read_video(path)
    assert frames.shape == (3, 202, 302, 3)
    assert np.abs(frames[0, 100, :301:20].astype(int) - 255).max() < 20
    assert frames[0, 100, 10:300:20].max() < 20
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
    with pytest.raises(InputError, match=r"which is not installed.*pip install imageio-ffmpeg.*PNG frames"):
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


PLAIN = {"outputs": ["rgb"], "mosaic": False, "format": "frames", "alpha": False, "projection": "perspective"}
PLAIN |= {"background": None, "near": None, "crop": None, "hold_camera": False}
# ffmpeg's own decoder of VP9 leaves alpha out.
READ = {".webm": ["-c:v", "libvpx-vp9"], ".mov": []}


def filmed(folder, form, background="white", inside=1000.0, **settings):
    subject = Subject(solid(ball(), inside=inside), scene_record(ball_scene(num_views=6, size=24)), background)
    settings = FilmSettings(outputs=("rgb",), form=form, **settings)
    (path,) = film([subject], Orbit(2, width=32), 1 << 15, folder, settings)
    return path


def read_rgba(path):
    settings = {"input_params": READ[path.suffix]}
    return read_video(path, pix_fmt="rgba", bits_per_pixel=32, **settings)[1].astype(int)


def test_frames_with_alpha_are_the_scene_over_any_background(tmp_path):
    with_alpha = iio.imread(filmed(tmp_path / "alpha", "frames", alpha=True, inside=1.0) / "frame_0001.png") / 255.0
    colors, alpha = with_alpha[..., :3], with_alpha[..., 3:]
    assert with_alpha.shape[-1] == 4
    assert ((alpha > 0.2) & (alpha < 0.9)).any()
    for background, level in (("white", 1.0), ("black", 0.0)):
        behind = filmed(tmp_path / background, "frames", background, inside=1.0) / "frame_0001.png"
        np.testing.assert_allclose(colors * alpha + level * (1 - alpha), iio.imread(behind) / 255.0, atol=2 / 255)


@pytest.mark.parametrize("ending", [".webm", ".mov"])
def test_the_codecs_keep_colours_and_alpha(tmp_path, ending):
    colors = torch.tensor([[220, 40, 40, 255], [40, 180, 60, 128], [30, 60, 200, 0]], dtype=torch.uint8)
    write_video(tmp_path / f"a{ending}", [color.expand(33, 47, 4) for color in colors], fps=10, total=3)
    frames = read_rgba(tmp_path / f"a{ending}")
    assert frames.shape == (3, 34, 48, 4)
    assert np.abs(frames - colors.numpy().astype(int)[:, None, None]).max() <= 5


def test_an_animation_has_alpha_too_and_webm_without_it_is_opaque(tmp_path):
    with Image.open(filmed(tmp_path, "animation", alpha=True)) as picture:
        assert (picture.width, picture.n_frames) == (32, 2)
        alpha = np.asarray(picture.convert("RGBA"))[..., 3]
    assert (alpha.min(), alpha.max()) == (0, 255)
    frames = read_rgba(filmed(tmp_path, "webm"))
    assert (frames[..., 3] == 255).all()
    assert frames[:, 0, 0, :3].min() > 245  # the white background


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": "video"}, "mp4, which has no alpha. Give format=webm"),
        ({"background": "white"}, "background=white would lie behind"),
        ({"mosaic": True}, "mosaic=true"),
        ({"outputs": ["depth"]}, "outputs has no rgb"),
    ],
)
def test_what_has_no_alpha_is_refused(changes, words):
    with pytest.raises(InputError, match=rf"alpha=true: .*{words}"):
        film_settings(PLAIN | {"alpha": True} | changes)
    assert film_settings(PLAIN | {"alpha": True}).alpha


def test_an_ffmpeg_without_the_encoder_is_named_before_the_first_frame(tmp_path, monkeypatch):
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\necho Codec is not recognized by FFmpeg.\n")
    program.chmod(0o755)
    monkeypatch.setattr(encoding, "require_ffmpeg", lambda: str(program))
    with pytest.raises(InputError, match=r"ends in \.mov needs prores_ks, which ffmpeg \(.*\) lacks"):
        filmed(tmp_path / "out", "prores", alpha=True)
    assert not (tmp_path / "out").exists()


PATH = Orbit(2, width=32, elevation=0.0)


def ball_of(inside=1000.0, unit=10.0):
    to_user = similarity(torch.eye(3), torch.zeros(3), unit)
    record = replace(scene_record(ball_scene(num_views=6, size=24)), to_user=to_user)
    return Subject(solid(ball(), inside=inside), record, "white")


def channels_of(folder, subject, **settings):
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed (the extra exr)")
    (path,) = film([subject], PATH, 1 << 15, folder, FilmSettings(form="exr", **settings))
    assert [file.name for file in sorted(path.glob("[!.]*"))] == ["frame_0000.exr", "frame_0001.exr"]
    with openexr.File(str(path / "frame_0001.exr"), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


def test_depth_is_along_the_cameras_axis_in_the_captures_units(tmp_path):
    subject = ball_of()
    channels = channels_of(tmp_path, subject)
    assert set(channels) == {"R", "G", "B", "Z"}
    shot = make_shots([subject], PATH, 1 << 15)[0]
    away = 10.0 * float(shot.cameras.c2w[1, :, 3].norm())
    z = channels["Z"]
    middle = z[z.shape[0] // 2, z.shape[1] // 2]
    assert middle == pytest.approx(away - 8.0, abs=0.6)  # the ball's radius is 0.8, and one unit of ours is ten of his
    assert (z[0, 0], z[-1, -1]) == (np.float32(exr.NOTHING), np.float32(exr.NOTHING))
    # Each pixel with its own depth lies on the ball.
    rows, columns = np.nonzero(z < 1e9)
    focal, center = float(shot.cameras.focal[1, 0]), shot.cameras.center[1].tolist()
    x, y = (columns + 0.5 - center[0]) / focal * z[rows, columns], (rows + 0.5 - center[1]) / focal * z[rows, columns]
    assert np.abs(np.sqrt(x**2 + y**2 + (z[rows, columns] - away) ** 2) - 8.0).max() < 1.0


def test_colours_are_linear_and_times_alpha(tmp_path):
    subject = ball_of(inside=1.0)
    plain = channels_of(tmp_path / "plain", subject, outputs=("rgb",))
    with_alpha = channels_of(tmp_path / "alpha", subject, outputs=("rgb",), alpha=True)
    assert (set(plain), set(with_alpha)) == ({"R", "G", "B"}, {"R", "G", "B", "A"})
    picture = make_shots([subject], PATH, 1 << 15)[0].picture(1)
    lower_and_upper = 12.92 * plain["R"], 1.055 * np.maximum(plain["R"], 1e-9) ** (1 / 2.4) - 0.055
    encoded = np.where(plain["R"] <= 0.0031308, *lower_and_upper)
    np.testing.assert_allclose(encoded, picture.rgb[..., 0].clamp(0, 1).numpy(), atol=1e-4)
    alpha = with_alpha["A"]
    np.testing.assert_allclose(alpha, picture.opacity.numpy(), atol=1e-5)
    assert ((alpha > 0.2) & (alpha < 0.9)).any()
    # Of the picture over white, the white is taken away, and what is left is the scene's own, as sRGB encodes it.
    seen = alpha > 0.05
    straight = (encoded[seen] - (1 - alpha[seen])) / alpha[seen]
    linear = ((np.maximum(straight, 0.04045) + 0.055) / 1.055) ** 2.4
    expected = alpha[seen] * np.where(straight <= 0.04045, straight / 12.92, linear)
    np.testing.assert_allclose(with_alpha["R"][seen], expected, atol=2e-3)
    assert (with_alpha["R"][alpha == 0] == 0).all()


def test_without_openexr_it_is_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(InputError, match=r"format=exr needs OpenEXR, .* pip install '\.\[exr\]'"):
        film([ball_of()], PATH, 1 << 15, tmp_path / "out", FilmSettings(form="exr"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("changes", [{"mosaic": True}, {"outputs": ["rgb", "normals"]}])
def test_other_outputs_are_refused(changes):
    assert film_settings(PLAIN | {"format": "exr"}).form == "exr"
    with pytest.raises(InputError, match="format=exr holds rgb and depth as numbers"):
        film_settings(PLAIN | {"format": "exr"} | changes)


def test_the_content_of_a_film_is_what_photographs_show_in_their_middle():
    above = ball(0.1, center=(0.0, 0.0, 1.2))
    both = solid(lambda positions: torch.minimum(ball(0.5)(positions), above(positions)))
    points = content_of(Subject(both, scene_record(ball_scene(num_views=8, size=33)), "white"), 1 << 15)
    assert len(points) > 100
    assert (points.norm(dim=-1) - 0.5).abs().max() < 0.05
