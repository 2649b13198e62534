"""`nerf render`: what is shown, of which checkpoints, and how it goes on after a stop."""

import os
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import psutil
import pytest
import torch
from support.peak_bytes import peak_bytes
from support.running import FAST, done, said
from support.scenes import ball_scene, tiny_field
from torch import nn

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf import row_chunks
from nerf_lightning.nerf.geometry.cameras import pinhole_cameras
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.renderings import Rendering
from nerf_lightning.video.film import bytes_per_pixel, film, require_room
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.settings import FilmSettings
from nerf_lightning.video.shots import Subject

SMALL = ("path=orbit", "path.num_frames=2", "path.width=12", "trainer.tile_points=8192")


@pytest.fixture
def last(finished_run):
    return finished_run / "checkpoints" / "last.ckpt"


@pytest.fixture
def rendered(nerf, tmp_path):
    """Render frames, and return one of them by its film."""

    def call(checkpoint, *arguments, name="a", frame=1):
        folder = tmp_path / name
        done(nerf("render", f"ckpt={checkpoint}", *SMALL, "format=frames", *arguments, f"paths.output_dir={folder}"))
        return {
            film: iio.imread(folder / film / f"frame_{frame:04d}.png") for film in os.listdir(folder) if film[0] != "."
        }

    return call


def test_every_output_is_a_film_and_a_mosaic_is_one(last, rendered):
    outputs = "outputs=[rgb,depth,opacity,normals,levels]"
    films = rendered(last, outputs)
    assert set(films) == {"video", "depth", "opacity", "normals", "levels"}
    assert films["video"].shape == films["normals"].shape == films["opacity"].shape == (12, 12, 3)
    mosaic = rendered(last, outputs, "mosaic=true", name="b")
    assert set(mosaic) == {"mosaic"}
    assert mosaic["mosaic"].shape[1] > 5 * 12


def test_two_checkpoints_stand_side_by_side(last, rendered):
    best = last.with_name("best.ckpt")
    alone, both = rendered(last)["video"], rendered(f"[{last},{best}]", "labels=[one,two]", name="b")["video"]
    places = [x for x in range(both.shape[1] - 12) if np.array_equal(both[-17:-5, x : x + 12], alone)]
    assert places, "the first one's picture is in it"
    assert both.shape[1] > 2 * 12


def test_background_crop_and_near_change_the_picture(last, rendered):
    white, black = rendered(last, "background=white")["video"], rendered(last, "background=black", name="b")["video"]
    assert bool((white >= black).all())
    assert not np.array_equal(white, black)
    gone = rendered(last, "background=white", "crop=[[5,5,5],[6,6,6]]", name="c")["video"]
    assert gone.min() == 255
    some = rendered(last, "background=white", "crop=[[-1,-1,0],[1,1,1]]", name="d")["video"]
    assert not np.array_equal(some, white)
    assert not np.array_equal(rendered(last, "background=white", "near=4.5", name="e")["video"], white)


def test_a_held_camera_sees_the_same_shape_in_another_light(last, rendered):
    first = rendered(last, "outputs=[rgb,opacity]", frame=0)
    held = rendered(last, "outputs=[rgb,opacity]", "hold_camera=true", name="b", frame=1)
    assert rendered(last, "path.num_frames=1", name="c", frame=0)["video"].shape == (12, 12, 3)  # a film, too
    assert np.array_equal(held["opacity"], first["opacity"])
    assert not np.array_equal(held["video"], first["video"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["outputs=[rgb,color]"], ["this model shows no color", "rgb, depth, opacity, normals, levels"]),
        (["mosaic=maybe"], ["mosaic=maybe", "true or false"]),
        (["format=gif"], ["format=gif", "animation (WebP"]),
        (["background=red"], ["scene.background is 'red'"]),
        (["near=-1"], ["near=-1", "not negative"]),
        (["near=7"], ["near=7 leaves nothing to see", "rays end at"]),
        (["crop=[[0,0,0]]"], ["crop=[[0, 0, 0]]", "lower and the upper corner"]),
        (["crop=[[0,0,0],[1,-1,1]]"], ["holds nothing", "smaller than"]),
        (["crop=[[-9,-9,-9],[9,9,9]]"], ["the camera of frame 0 is in the box (2 of 2 frames are)"]),
        (["crop=[[-1,-1,0],[1,1,1]]", "background=none"], ["crop: this model has no background", "background=white"]),
        (["projection=round"], ["projection=round: choose one of perspective, equirectangular"]),
        (["projection=equirectangular", "path.fov=60.0"], ["path.fov=60 with projection=equirectangular"]),
        (["labels=[a,b]"], ["labels=['a', 'b']", "one for each of the 1 checkpoints"]),
        (["path=photographs", "path.views=[nobody,0]"], ["path.views: the capture has no photograph nobody"]),
        (["path=keyframes"], ["path.file"]),
    ],
)
def test_bad_input_is_one_paragraph(nerf, last, tmp_path, arguments, words):
    given = [*SMALL, *arguments] if not arguments[0].startswith("path=") else arguments
    said(nerf("render", f"ckpt={last}", *given, f"paths.output_dir={tmp_path}"), *words)
    assert not list(tmp_path.rglob("*.png"))


def test_a_model_of_one_level_has_no_difference_of_levels(tmp_path):
    model = RadianceModel({"fine": DenseLevel(StratifiedSampler(8), tiny_field())})
    subject, settings = Subject(model, scene_record(ball_scene()), "white"), FilmSettings(outputs=("levels",))
    with pytest.raises(InputError, match=r"this model renders one level.*model=nerf"):
        film([subject], Orbit(2), 1000, tmp_path, settings)
    assert not list(tmp_path.iterdir())


def test_panoramas_show_what_their_faces_show(last, rendered):
    """Ahead, the middle of a panorama is what a camera of 90 degrees sees."""
    width = ("path.width=64", "outputs=[rgb]")
    panorama = rendered(last, *width, "projection=equirectangular")["video"]
    assert panorama.shape == (32, 64, 3)
    face = rendered(last, *width, "path.height=64", "path.fov=90.0", name="face")["video"]
    across, down = np.meshgrid(np.arange(24, 40), np.arange(8, 24))
    azimuth, depression = 2 * np.pi * ((across + 0.5) / 64 - 0.5), np.pi * ((down + 0.5) / 32 - 0.5)
    column, row = np.tan(azimuth), np.tan(depression) / np.cos(azimuth)
    seen = (np.abs(column) < 1) & (np.abs(row) < 1)
    column, row = ((32 * (1 + place[seen])).astype(int) for place in (column, row))
    assert np.abs(face[row, column].astype(float) - panorama[down[seen], across[seen]]).mean() < 6


def test_a_film_is_of_one_precision(last, rendered):
    """Frames that are there already are those of the same precision only."""
    exact, mixed = ("trainer.precision=32-true", "trainer.precision=bf16-mixed")
    before = rendered(last, exact)["video"]
    after, alone = rendered(last, mixed)["video"], rendered(last, mixed, name="b")["video"]
    assert not np.array_equal(before, alone)
    assert np.array_equal(after, alone)


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


def world(scene):
    return scene


# Each setting, of a scene of either kind, with one model or two.
@pytest.mark.parametrize(
    ("settings", "where", "models"),
    [
        (FilmSettings(), world, 1),
        (FilmSettings(), forward_facing, 2),
        (FilmSettings(crop=CROP, near=0.1, hold_camera=True), forward_facing, 1),
        (FilmSettings(outputs=EVERYTHING), world, 1),
        (FilmSettings(outputs=EVERYTHING, mosaic=True, crop=CROP, hold_camera=True), forward_facing, 2),
    ],
)
def test_a_frame_takes_what_is_said(tmp_path, monkeypatch, settings, where, models):
    monkeypatch.setattr(row_chunks, "CHUNK_PIXELS", 1 << 12)  # frames worth refusing have many chunks
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

    with pytest.raises(
        InputError, match=r"A frame of 30000 x 15000 pixels .* takes 32\.4 GB, but only 0\.8 GB"
    ) as error:
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
    said(result, "A frame of 3000000 x 3000000 pixels")
    assert not list(run.rglob("*.ckpt"))
