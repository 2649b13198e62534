"""Films with alpha: what is read back of them is the scene's own colours, and how much of the light it stops."""

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image
from support.known_fields import ball, solid
from support.scenes import ball_scene
from support.videos import read_video

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.messages.errors import InputError
from nerf_lightning.video import encoding
from nerf_lightning.video.encoding import write_video
from nerf_lightning.video.film import film
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.settings import FilmSettings, film_settings
from nerf_lightning.video.shots import Subject

PLAIN = {
    "outputs": ["rgb"],
    "mosaic": False,
    "format": "frames",
    "alpha": False,
    "background": None,
    "near": None,
    "crop": None,
    "hold_camera": False,
    "projection": "perspective",
}
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


@pytest.mark.parametrize(("form", "ending"), [("webm", ".webm"), ("prores", ".mov")])
def test_a_film_has_the_ending_and_the_alpha_of_its_form(tmp_path, form, ending):
    path = filmed(tmp_path / "film", form, alpha=True)
    alpha = read_rgba(path)[..., 3]
    assert path.name == f"video{ending}"
    assert alpha.min() < 3 < 250 < alpha.max()


@pytest.mark.parametrize("ending", [".webm", ".mov"])
def test_the_codecs_keep_colours_and_alpha(tmp_path, ending):
    colors = torch.tensor([[220, 40, 40, 255], [40, 180, 60, 128], [30, 60, 200, 0]], dtype=torch.uint8)
    write_video(tmp_path / f"a{ending}", [color.expand(33, 47, 4) for color in colors], fps=10, total=3)
    frames = read_rgba(tmp_path / f"a{ending}")
    assert frames.shape == (3, 34, 48, 4)
    assert np.abs(frames - colors.numpy().astype(int)[:, None, None]).max() <= 5


def test_an_animation_has_alpha_too(tmp_path):
    with Image.open(filmed(tmp_path, "animation", alpha=True)) as picture:
        assert (picture.width, picture.n_frames) == (32, 2)
        alpha = np.asarray(picture.convert("RGBA"))[..., 3]
    assert (alpha.min(), alpha.max()) == (0, 255)


def test_webm_without_alpha_is_opaque(tmp_path):
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
