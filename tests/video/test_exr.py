"""EXR frames: colours in linear light and depth, against what is known of a ball."""

import sys

import numpy as np
import pytest
import torch
from support.known_fields import ball, solid
from support.scenes import ball_scene
from test_alpha import PLAIN

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.frames import similarity
from nerf_lightning.video import exr
from nerf_lightning.video.film import film
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.settings import FilmSettings, film_settings
from nerf_lightning.video.shots import Subject, make_shots

PATH = Orbit(2, width=32, elevation=0.0)


def ball_of(inside=1000.0, unit=10.0):
    record = scene_record(ball_scene(num_views=6, size=24))
    record = type(record)(**{**vars(record), "to_user": similarity(torch.eye(3), torch.zeros(3), unit)})
    return Subject(solid(ball(), inside=inside), record, "white")


def filmed(folder, subject, **settings):
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed (the extra exr)")
    (path,) = film([subject], PATH, 1 << 15, folder, FilmSettings(form="exr", **settings))
    assert [file.name for file in sorted(path.glob("[!.]*"))] == ["frame_0000.exr", "frame_0001.exr"]
    with openexr.File(str(path / "frame_0001.exr"), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


def test_depth_is_along_the_cameras_axis_in_the_captures_units(tmp_path):
    subject = ball_of()
    channels = filmed(tmp_path, subject)
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
    plain = filmed(tmp_path / "plain", subject, outputs=("rgb",))
    with_alpha = filmed(tmp_path / "alpha", subject, outputs=("rgb",), alpha=True)
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
    with pytest.raises(InputError, match=r"format=exr needs OpenEXR, .* pip install 'nerf-lightning\[exr\]'"):
        film([ball_of()], PATH, 1 << 15, tmp_path / "out", FilmSettings(form="exr"))
    assert not (tmp_path / "out").exists()


def test_a_full_disk_is_said_and_nothing_half_written_stays(tmp_path, monkeypatch):
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed (the extra exr)")

    def full(file, path):
        raise RuntimeError("No space left on device")

    monkeypatch.setattr(openexr.File, "write", full)
    with pytest.raises(InputError, match=r"No space left on device.*0 of 2 frames are kept"):
        film([ball_of()], PATH, 1 << 15, tmp_path, FilmSettings(form="exr"))
    assert not list(tmp_path.glob("exr/*.exr"))


@pytest.mark.parametrize("changes", [{"mosaic": True}, {"outputs": ["rgb", "normals"]}])
def test_other_outputs_are_refused(changes):
    assert film_settings(PLAIN | {"format": "exr"}).form == "exr"
    with pytest.raises(InputError, match="format=exr holds rgb and depth as numbers"):
        film_settings(PLAIN | {"format": "exr"} | changes)
