"""What somebody may add with one file and one yaml: it trains, renders, and is saved, with nothing else edited."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support import extensions
from support.captures import picture
from support.configs import composed
from support.extensions.dssim import DSSIM
from support.running import refused
from support.scenes import ball_scene
from support.steps import rays_of

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.config.instantiate import build
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.export.images import ImagesExport
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.losses.weighted_sum import WeightedSum
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.part import fit_parts, statistics
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.attempts import draw_weights
from nerf_lightning.training.step import TrainStep
from nerf_lightning.video.film import film
from nerf_lightning.video.settings import FilmSettings
from nerf_lightning.video.shots import Subject

SEARCHED = f"hydra.searchpath=[file://{Path(extensions.__file__).parent / 'conf'}]"
SMALL_GRID = ["encoder.first.log2_table_size=10", "encoder.second.num_frequencies=3"]
ADDED = {
    "an encoder that joins two": ["model=fast_small", "encoder=joined", *SMALL_GRID],
    "a packed sampler without a grid": ["model=fast_small", "sampler@model.levels.fine.sampler=box"],
    "a code for each photograph": ["model=nerf_tiny", "field=nerf_mlp_with_codes"],
    "an encoder with a penalty": ["model=fast_small", "encoder=kplanes"],
    "a structural loss beside the squared error": ["model=nerf_tiny", "loss=mse_dssim", "field.width=16"],
    "a semantic channel": ["model=semantic"],
    "a model of its own kind": ["model=voxels", "model.resolution=12", "sampler@model.sampler=stratified_32"],
}  # fmt: skip


def a_step(overrides) -> TrainStep:
    config, scene = composed("train", SEARCHED, *overrides), ball_scene(num_views=8, size=16, background="random")
    model = build(config.model)
    fit_parts(model, scene)
    train_step = TrainStep(
        Objective(model, rays_of(scene), build(config.loss), "random"),
        lambda groups: torch.optim.Adam(groups, lr=2e-2), ExponentialDecay(decay_rate=1.0), Progress(), 0, 4096,
        num_steps=100,
    )  # fmt: skip
    draw_weights(train_step)
    return train_step


@pytest.mark.parametrize("added", ADDED)
def test_it_learns_renders_and_is_saved(added):
    scene = ball_scene(num_views=8, size=16, background="random")
    train_step = a_step(ADDED[added])
    loader = RayBatches(scene, train_step.progress, 0, 96, patch=train_step.objective.loss.patch)
    optimizer = train_step.new_optimizer()
    losses = [train_step(loader.batch_at(0, train_step.progress.rays_seen), optimizer).losses[-1] for _ in range(35)]
    assert float(torch.stack(losses[-5:]).mean()) < 0.8 * float(torch.stack(losses[:5]).mean())
    assert train_step.guard.skipped == 0
    objective, again = train_step.objective, a_step(ADDED[added]).objective
    again.model.load_state_dict(objective.model.state_dict())
    ours, theirs = (render_picture(each.model.eval(), each.rays, 0, "white", 4096) for each in (objective, again))
    assert torch.equal(ours.rgb, theirs.rgb)


@pytest.mark.parametrize("tile_points", [None, 256])
def test_the_penalty_of_an_encoder_inside_the_model_reaches_its_gradients_once(tile_points):
    scene, gradients = ball_scene(num_views=8, size=16, background="random"), []
    for weight in (0.0, 1.0):
        train_step = a_step([*ADDED["an encoder with a penalty"], f"encoder.total_variation={weight}"])
        train_step.tiles.points = tile_points
        train_step.gradients(RayBatches(scene, train_step.progress, 0, 96).batch_at(0, 0), train_step.key)
        gradients.append(train_step.objective.model.last.field.position_encoder.planes.grad)
    encoder = train_step.objective.model.last.field.position_encoder
    (expected,) = torch.autograd.grad(encoder.penalty(), [encoder.planes])
    assert float(expected.abs().max()) > 1e-4
    torch.testing.assert_close(gradients[1] - gradients[0], expected, rtol=1e-3, atol=1e-6)


def test_each_term_of_a_weighted_sum_is_told_apart_and_their_sum_is_minimised():
    scene, train_step = ball_scene(num_views=8, size=16), a_step(ADDED["a structural loss beside the squared error"])
    seen = train_step.gradients(RayBatches(scene, train_step.progress, 0, 96, patch=4).batch_at(0, 0), train_step.key)
    assert list(seen.terms) == ["mse", "dssim"]
    assert float(seen.terms["dssim"].min()) > 0
    torch.testing.assert_close(seen.losses, seen.terms["mse"] + seen.terms["dssim"])
    torch.testing.assert_close(seen.terms["mse"], seen.color_errors)


def test_a_channel_is_trained_rendered_filmed_and_exported_without_being_listed(tmp_path):
    scene, train_step = ball_scene(num_views=8, size=16, background="black"), a_step(ADDED["a semantic channel"])
    loader, optimizer = RayBatches(scene, train_step.progress, 0, 96), train_step.new_optimizer()
    terms = [
        train_step(loader.batch_at(0, train_step.progress.rays_seen), optimizer).terms["bright"].sum()
        for _ in range(40)
    ]
    assert float(torch.stack(terms[-5:]).mean()) < 0.9 * float(torch.stack(terms[:5]).mean())
    model = train_step.objective.model.eval()
    seen = render_picture(model, train_step.objective.rays, 0, "black", 4096)
    assert seen.channels["bright"].shape == (16, 16, 2)
    torch.testing.assert_close(seen.channels["bright"].sum(dim=-1), seen.opacity)
    record, shown = scene_record(scene), FilmSettings(outputs=("rgb", "bright"), form="frames")
    path = build(composed("render", "path=orbit", "path.num_frames=2", "path.width=12").path)
    _, classes = film([Subject(model, record, "black")], path, 4096, tmp_path, shown)
    assert len(list(classes.glob("*.png"))) == 2
    assert classes.name == "bright"
    with pytest.raises(InputError, match=r"this model shows no dark\. Choose one or more of rgb, .*bright"):
        film([Subject(model, record, "black")], path, 4096, tmp_path / "b", FilmSettings(outputs=("dark",)))
    ImagesExport(split="test").export(model, record, tmp_path, 4096)
    arrays = [np.load(file) for file in sorted((tmp_path / "bright").glob("*.npy"))]
    assert [array.shape for array in arrays] == [(16, 16, 2)] * len(record.splits["test"])


def test_a_weighted_sum_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="weights names ssim, which is not a loss: there are mse"):
        WeightedSum({"mse": MeanSquaredError()}, {"ssim": 1.0})
    with pytest.raises(ValueError, match=r"squares of \[4, 8\] pixels"):
        WeightedSum({"a": DSSIM(4), "b": DSSIM(8)})


def test_a_packed_sampler_without_a_grid_renders_as_it_trains():
    train_step = a_step(ADDED["a packed sampler without a grid"])
    torch.nn.init.normal_(train_step.objective.model.last.field.position_encoder.table)
    rays = train_step.objective.rays(RayBatches(ball_scene(), train_step.progress, 0, 64).batch_at(0, 0).pixels)
    whole = train_step.objective.model(rays, torch.ones(64, 3), None)[0]
    with torch.no_grad():
        walked = train_step.objective.model(rays, torch.ones(64, 3), None)[0]
    torch.testing.assert_close(walked.rgb, whole.rgb.detach(), atol=2e-3, rtol=0)
    assert "train/occupied" not in statistics(train_step.objective.model)


def test_a_table_of_cameras_is_a_capture(tmp_path):
    cameras = ball_scene(num_views=8, size=16).cameras
    rows = []
    for view, c2w in enumerate(cameras.c2w.double()):
        Image.fromarray(picture(view, 16, 16)).save(tmp_path / f"{view}.png")
        rows.append([f"{view}.png", 25.0, *c2w[:, 3].tolist(), *(c2w[:, 3] - 2.0 * c2w[:, 2]).tolist()])
    (tmp_path / "cameras.csv").write_text("".join(",".join(map(str, row)) + "\n" for row in rows))
    given = [f"scene.root={tmp_path}", f"scene.cache_dir={tmp_path}/cache"]
    scene = build(composed("train", SEARCHED, "scene=table", "scene.background=white", *given).scene).read()
    assert (scene.name, scene.background, scene.view_names[1]) == ("table", "white", "1.png")
    assert torch.equal(scene.pixels.view(1), torch.from_numpy(picture(1, 16, 16)))
    torch.testing.assert_close(scene.cameras.focal, torch.full((8, 2), 25.0))
    centers = scene.cameras.c2w[..., 3].double() @ scene.to_user[:3, :3].T + scene.to_user[:3, 3]
    torch.testing.assert_close(centers, cameras.c2w[..., 3].double(), atol=1e-4, rtol=0)
    for written in ("0.png,25,1,2\n", "0.png,wide,0,0,1,0,0,0\n"):
        (tmp_path / "cameras.csv").write_text(written)
        refused(build(composed("train", SEARCHED, "scene=table", *given).scene).read, parts=("file,focal,x,y,z",))
