"""The memory of a film's frames: as much as is said, and refused where it is not there."""

from dataclasses import replace

import psutil
import pytest
import torch
from support.running import FAST
from support.scenes import ball_scene
from torch import nn

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.commands.train_job.memory_trial import peak_bytes
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf import bands
from nerf_lightning.nerf.geometry.cameras import pinhole_cameras
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.types.renderings import Rendering
from nerf_lightning.video.film import bytes_per_pixel, film, require_room
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.settings import FilmSettings
from nerf_lightning.video.shots import Subject

SIDE = 256
EVERYTHING = ("rgb", "depth", "opacity", "normals", "levels")
CROP = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


class Blank(RadianceModel):
    """A model that takes no memory of its own: two levels that see a thin fog."""

    def __init__(self):
        super().__init__({})
        self.parameter = nn.Parameter(torch.zeros(()))

    first_picture = 0

    def points_per_ray(self, training):
        return 1.0

    def forward(self, rays, background, random):
        rgb = rays.directions.abs()
        seen = Rendering(rgb, rgb, 0.5 + 0 * rays.near, rays.near)
        return [seen, seen]


def forward_facing(scene):
    return replace(scene, cameras=replace(scene.cameras, ndc=torch.full((len(scene.near), 2), 1.6)))


@pytest.mark.parametrize("models", [1, 3])
@pytest.mark.parametrize("where", [lambda scene: scene, forward_facing], ids=["world", "ndc"])
@pytest.mark.parametrize(
    "settings",
    [
        FilmSettings(),
        FilmSettings(crop=CROP, near=0.1, hold_camera=True),
        FilmSettings(outputs=EVERYTHING),
        FilmSettings(outputs=EVERYTHING, mosaic=True, crop=CROP, hold_camera=True),
    ],
    ids=["default", "cut", "everything", "everything cut"],
)
def test_a_frame_takes_what_is_said(tmp_path, monkeypatch, settings, where, models):
    monkeypatch.setattr(bands, "BAND_PIXELS", 1 << 12)  # frames worth refusing have many bands
    scene = where(scene_record(ball_scene()))
    subjects, path = [Subject(Blank(), scene, "white", "one")] * models, Orbit(1, width=SIDE)
    settings = replace(settings, form="frames")
    said = SIDE**2 * bytes_per_pixel(settings, models)
    counted = peak_bytes(lambda: film(subjects, path, 1 << 12, tmp_path, settings), torch.device("cpu"))
    # PIL's and numpy's copies are not counted here.
    assert 0.35 * said < counted < said


def with_free(monkeypatch, available):
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": available}))


def test_a_frame_beyond_memory_is_refused_with_what_would_fit(monkeypatch):
    with_free(monkeypatch, 10**9)
    settings = FilmSettings()

    def cameras(width, height):
        return pinhole_cameras(torch.eye(4)[:3][None], 100.0, width, height)

    with pytest.raises(InputError, match=r"A frame of 30000 x 15000 pixels .* takes 32\.4 GB, and 0\.8 GB") as error:
        require_room(cameras(30000, 15000), settings)
    width, height = (int(part.split("=")[1].split(" ")[0]) for part in str(error.value).split("path.")[1:])
    assert height == round(width / 2)
    assert width * height * bytes_per_pixel(settings, 1) == pytest.approx(0.8e9, rel=0.01)
    require_room(cameras(width, height), settings)
    with pytest.raises(InputError, match=r"path\.width="):
        require_room(cameras(width, height), settings, num_models=2)


def test_nothing_is_begun_of_a_film_that_would_not_fit(tmp_path, monkeypatch):
    with_free(monkeypatch, 10**7)
    subject = Subject(Blank(), scene_record(ball_scene()), "white")
    with pytest.raises(InputError, match=r"500 x 500 pixels .* path\.width=\d+ path\.height=\d+ would fit"):
        film([subject], Orbit(2, width=500), 1000, tmp_path)
    assert not list(tmp_path.iterdir())


def test_training_does_not_begin_where_its_film_would_not_fit(capture, nerf, tmp_path):
    run = tmp_path / "run"
    result = nerf("train", *FAST, "scene=npz", f"scene.path={capture}", "path.width=3000000", f"paths.output_dir={run}")
    assert result.code == 2
    assert "A frame of 3000000 x 3000000 pixels" in result.err
    assert not list(run.rglob("*.ckpt"))
