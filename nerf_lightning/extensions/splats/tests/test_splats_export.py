"""`nerf export what=splats`: fitted splats are nearer to the photographs, lie in the capture's frame, and refusals."""

import json
import sys
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from support.command_fixtures import *  # noqa: F403
from support.configs import composed
from support.known_fields import ball, photographed_ball, solid
from support.planted import in_config, write_checkpoint
from support.running import refused
from support.scenes import ball_scene

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.commands.export import neutral_colors
from nerf_lightning.config.load_model import load_correction
from nerf_lightning.export import base
from nerf_lightning.export.base import RunContext
from nerf_lightning.extensions.splats.export import SplatsExport
from nerf_lightning.extensions.splats.fit import LEAST_VARIANCE
from nerf_lightning.extensions.splats.fitted import training_views
from nerf_lightning.extensions.splats.views import photographed, without_lens
from nerf_lightning.messages import errors
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.nerf.geometry.panoramas import panorama_cameras
from nerf_lightning.nerf.geometry.world_frame import similarity, upright_rotation
from nerf_lightning.nerf.rendering.linear_light import scale_light, to_linear

TILE = 1 << 15


def exported(folder, model, scene, photographs=True, crop=None, min_opacity=0.5, **settings):
    export = SplatsExport(**({"num_splats": 600, "seconds": 0.0, "sh_degree": 1} | settings))
    run = RunContext(photographs=scene if photographs else None, crop=crop, min_opacity=min_opacity)
    with torch.no_grad():
        written = export.export(model, scene_record(scene), folder, TILE, run)
    return json.loads((folder / "splats.json").read_text()), written


def test_fitting_brings_the_splats_nearer_to_the_photographs(tmp_path):
    """No splat is thinner than the pixels of the nearest photograph."""
    scene, model = photographed_ball(32)
    lost = []
    for seconds in (0.0, 1.5):
        facts, written = exported(tmp_path / str(seconds), model, scene, seconds=seconds, frame="capture")
        assert [path.name for path in written] == ["splats.ply", "splats.json", "splats.png"]
        assert facts["splats"] <= 600
        assert facts["fitted_to"] == "photographs"
        lost.append(facts["field_metrics"]["psnr"] - facts["splats_metrics"]["psnr"])
    assert lost[1] < lost[0] - 5.0
    header = written[0].read_bytes().partition(b"end_header")[0].decode().splitlines()
    names = [line.split()[-1] for line in header if line.startswith("property")]
    rows = rows_of(written[0])
    thinnest = np.exp(rows[:, names.index("scale_0") : names.index("scale_2") + 1].min(axis=1))
    apart = np.linalg.norm(rows[:, None, :3] - scene.cameras.c2w[:, :, 3].numpy(), axis=-1).min(axis=1)
    pixels = apart / float(scene.cameras.focal[0, 0])
    assert (thinnest > 0.9 * LEAST_VARIANCE**0.5 * pixels).all()  # means move a little after the last split
    assert (thinnest < 2.0 * pixels).mean() > 0.5


def test_only_the_splats_in_a_crop_box_are_written_and_all_are_compared(tmp_path):
    scene, model = photographed_ball(24)
    upper = CropBox.from_user((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0), scene.to_user)
    whole, _ = exported(tmp_path / "whole", model, scene, frame="capture")
    part, written = exported(tmp_path / "part", model, scene, crop=upper, frame="capture")
    assert 0 < part["splats"] < 0.7 * whole["splats"]
    assert part["splats_metrics"] == whole["splats_metrics"]
    assert "without the crop box" in part["measured"]
    assert rows_of(written[0])[:, 2].min() > 0
    outside = CropBox.from_user((8.0, 8.0, 8.0), (9.0, 9.0, 9.0), scene.to_user)
    refused(exported, tmp_path / "none", model, scene, True, outside, parts=("crop: there are no splats in this box",))


def test_without_photographs_the_field_is_what_they_are_fitted_to(tmp_path):
    scene, model = photographed_ball(24)
    begun, fitted = (
        exported(tmp_path / str(seconds), model, scene, photographs=False, seconds=seconds)[0] for seconds in (0.0, 1.0)
    )
    assert fitted["fitted_to"] == "the field"
    assert "field_metrics" not in fitted
    assert fitted["splats_metrics"]["psnr"] > begun["splats_metrics"]["psnr"] + 3.0


def test_photographs_of_a_corrected_model_are_made_neutral_first(tmp_path):
    config = OmegaConf.to_container(composed("train", "correction=exposure").correction)
    stops = torch.zeros(6, 3)
    stops[2] = torch.tensor([1.0, 0.0, 0.0])

    def corrected(content):
        in_config(lambda plain: plain.update(correction=config))(content)
        content["state_dict"]["correction.stops"] = stops

    checkpoint = read_checkpoint(write_checkpoint(tmp_path / "a.ckpt", corrected))
    neutral, rgb = neutral_colors(checkpoint), torch.rand(4, 4, 3)
    torch.testing.assert_close(neutral(scale_light(rgb, torch.tensor(2.0)), "ball_2"), rgb)
    scene, _ = photographed_ball(16)
    pinholes = without_lens(scene.cameras, 100)
    plain, dark = (training_views(checkpoint.scene, scene, pinholes, each)[2].rgba for each in (None, neutral))
    light = [float(to_linear(rgba[..., :3] / 255.0).sum()) for rgba in (plain, dark)]
    assert light[1] == pytest.approx(0.5 * light[0], rel=0.02)
    assert neutral_colors(replace(checkpoint, correction={}))(rgb, "ball_2") is None
    foreign = in_config(lambda plain: plain.update(correction={"_target_": "os.getcwd"}))
    with pytest.raises(InputError, match="is not a model part of this program"):
        load_correction(read_checkpoint(write_checkpoint(tmp_path / "b.ckpt", foreign)))


def test_splats_lie_on_the_surface_in_the_captures_frame_and_none_is_haze(tmp_path):
    gsply = pytest.importorskip("gsply", reason="gsply is not installed (the extra splats)")
    to_user = similarity(upright_rotation(torch.tensor([1.0, 0.0, 0.0])), torch.tensor([5.0, 6.0, 7.0]), 100.0)
    scene = replace(ball_scene(num_views=12, size=24, background="random"), to_user=to_user)
    _, (path, *_) = exported(tmp_path, solid(ball()), scene, photographs=False, frame="capture")
    read = gsply.plyread(path)
    radius = np.linalg.norm(read.means - [5.0, 6.0, 7.0], axis=1) / 100.0
    assert len(radius) == 600
    assert np.abs(radius - 0.8).max() < 0.1
    assert np.exp(read.scales).max() < 30.0


@pytest.mark.parametrize("settings", [{}, {"frame": "capture"}, {"format": "glb", "frame": "capture"}])
def test_what_is_up_is_down_in_a_ply_unless_the_captures_axes_are_kept(settings):
    """`save_splats` negates y and z for a GLB, in which up is y and a unit a meter."""
    to_user = similarity(upright_rotation(torch.tensor([1.0, 0.0, 0.0])).mT, torch.zeros(3), 3.0)
    record = scene_record(replace(ball_scene(), to_user=to_user, metres_per_unit=2.0))
    matrix = SplatsExport(**settings)._to_file(record)
    expected = {"ply": [0.0, -3.0, 0.0], "glb": [0.0, -6.0, 0.0]}[settings.get("format", "ply")]
    if settings == {"frame": "capture"}:
        expected = [3.0, 0.0, 0.0]
    torch.testing.assert_close(matrix[:3, 2], torch.tensor(expected, dtype=torch.float64), atol=1e-6, rtol=0)


def test_a_photograph_through_a_lens_is_what_a_pinhole_sees():
    """The same soft ball, photographed with and without a lens."""
    bent, _ = photographed_ball(48, lens=(0.2, 0.0, 0.0, 0.0, 0.0, 0.0), lens_model="radial_tangential")
    straight, _ = photographed_ball(48)
    for view in (0, 3):
        seen = photographed(bent, view, without_lens(bent.cameras, 800))
        expected = photographed(straight, view, without_lens(straight.cameras, 800))
        error = (seen.over(torch.zeros(3)) - expected.over(torch.zeros(3))).abs()[seen.mask]
        assert float(error.mean()) < 0.01
        assert 0.5 < float(seen.mask.float().mean()) < 1.0 or bool(seen.mask.all())


def test_larger_photographs_are_shrunk_with_their_cameras():
    scene, _ = photographed_ball(48)
    half = without_lens(scene.cameras, 24)
    view = photographed(scene, 0, half)
    assert view.rgba.shape == (24, 24, 4)
    assert view.camera.focal == pytest.approx((1.6 * 24, 1.6 * 24))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"num_splats": 0}, "what.num_splats=0: give 1 to 3,000,000 splats, which is what viewers show, or auto"),
        ({"num_splats": 10**9}, "what.num_splats=1000000000: give 1 to 3,000,000"),
        ({"seconds": -1.0}, "what.seconds=-1.0: give seconds of fitting"),
        ({"sh_degree": 4}, "what.sh_degree=4: give 0, 1, 2 or 3"),
        ({"longest": 2}, "what.longest=2: give 16 pixels"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, said):
    with pytest.raises(InputError) as error:
        SplatsExport(**settings)
    assert said in str(error.value)


def test_normalised_device_coordinates_become_places_in_the_world(tmp_path):
    """A wall at z = -3, where the third coordinate is 1 / 3, seen by cameras that look at it."""
    gsply = pytest.importorskip("gsply", reason="gsply is not installed (the extra splats)")
    scene, wall = ball_scene(num_views=8, size=24), solid(lambda positions: 1 / 3 - positions[..., 2])
    c2w = torch.eye(3, 4).repeat(8, 1, 1)
    c2w[:, :2, 3] = 0.3 * torch.randn(8, 2, generator=torch.Generator().manual_seed(0))
    cameras = replace(scene.cameras, c2w=c2w, ndc=torch.full((8, 2), 3.2))
    scene = replace(scene, cameras=cameras, space="ndc", near=torch.zeros(8), far=torch.full((8,), 4.0))
    _, (path, *_) = exported(tmp_path, wall, scene, False, frame="capture", seconds=1.0)
    assert np.median(np.abs(gsply.plyread(path).means[:, 2] + 3.0)) < 0.15


@pytest.mark.minutes
def test_panoramas_are_taken_as_faces_of_cubes(tmp_path):
    """A ball around the cameras, as a room is."""
    room, around = solid(lambda positions: 1.5 - positions.norm(dim=-1)), ball_scene(num_views=4, size=24)
    c2w = torch.cat([around.cameras.c2w[:, :, :3], 0.1 * around.cameras.c2w[:, :, 3:]], dim=-1)
    around = replace(around, cameras=panorama_cameras(c2w, 128, 64), near=torch.full((4,), 0.05))
    found = [exported(tmp_path / str(n), room, around, num_splats=1000, seconds=n) for n in (0.0, 1.5)]
    assert [facts["fitted_to"] for facts, _ in found] == ["the field"] * 2
    assert found[1][0]["splats_metrics"]["psnr"] > found[0][0]["splats_metrics"]["psnr"] + 3.0
    path = found[1][1][0]
    means = rows_of(path)[:, :3]
    assert np.quantile(np.abs(np.linalg.norm(means, axis=1) - 1.5), 0.95) < 0.2
    assert (np.sign(means).sum(axis=0) ** 2 < len(means) ** 2 / 4).all()  # on all sides


def rows_of(ply):
    header, _, body = ply.read_bytes().partition(b"end_header\n")
    return np.frombuffer(body, "<f4").reshape(-1, header.count(b"property"))


def test_empty_fields_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"no surface to put splats on: the field's opacity is at most 0\.\d+"):
        exported(tmp_path, solid(ball(), inside=0.01), ball_scene(num_views=8, size=24))
    haze = solid(ball(), inside=1.0), ball_scene(num_views=8, size=24)  # stops at most four fifths of the light
    with pytest.raises(InputError, match=r"min_opacity=0\.9 is needed in two that agree"):
        exported(tmp_path, *haze, min_opacity=0.9)
    assert not list(tmp_path.iterdir())
    exported(tmp_path, *haze)


def test_a_missing_library_is_named_with_its_cure(tmp_path, monkeypatch):
    def absent(name):
        if name.startswith("gsply"):
            raise ImportError("No module named 'gsply'")
        return import_module(name)

    monkeypatch.setattr(errors, "import_module", absent)
    monkeypatch.setitem(sys.modules, "gsply", None)
    with pytest.raises(InputError, match=r"SPZ .* needs gsply, .*pip install '\.\[splats\]'"):
        exported(tmp_path, solid(ball()), ball_scene(num_views=8, size=24), format="spz")
    monkeypatch.setattr(base, "backend", lambda module: None)
    with pytest.raises(InputError, match="Fitting splats needs numba"):
        exported(tmp_path, solid(ball()), ball_scene(num_views=8, size=24))
    assert not list(tmp_path.iterdir())
