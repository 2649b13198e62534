"""What a training chooses where the user leaves it open, and says."""

from dataclasses import replace

import pytest
import torch
from omegaconf import OmegaConf
from support.configs import composed
from support.running import FAST
from support.scenes import ball_scene

from nerf_lightning.commands.train_job.build import assemble_job
from nerf_lightning.compute import devices
from nerf_lightning.config.auto_settings import (
    GPU_BATCHES,
    RAYS_SETTING,
    STEPS_SETTING,
    fit_model,
    resolve_auto,
    resolve_correction,
    with_longest,
)
from nerf_lightning.config.compose import compose_config
from nerf_lightning.doctor.check import Check
from nerf_lightning.doctor.gate import exposure_finding
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.rays import KnownDepths, PixelIndex
from nerf_lightning.runs.resume import former_config

IN_A_BOX = ball_scene()
PHOTOGRAPHS = replace(IN_A_BOX, space="contracted")
FORWARD_FACING = replace(IN_A_BOX, space="ndc")
LARGE_PICTURES = replace(IN_A_BOX, cameras=replace(IN_A_BOX.cameras, focal=IN_A_BOX.cameras.focal * 100.0))


def resumed(asked, former):
    return replace(asked, resumed=OmegaConf.to_container(former, resolve=True))


def chosen_for(scene, *overrides):
    resolved = resolve_auto(compose_config("train", overrides), scene)
    return resolved.config, resolved.choices


@pytest.mark.parametrize(
    ("scene", "model", "batch_rays"),
    [(IN_A_BOX, "fast", 32768), (PHOTOGRAPHS, "fast_proposal", 2048), (FORWARD_FACING, "fast_proposal", 2048)],
)
def test_the_model_follows_the_scene_and_is_said_unless_it_is_named(caplog, scene, model, batch_rays):
    caplog.set_level("INFO")
    for named in ("model=nerf", "experiment=fern"):
        assert chosen_for(scene, named)[1]["model"] == "nerf"
    assert "model:" not in caplog.text
    config, choices = chosen_for(scene, "encoder.log2_table_size=12")
    assert choices["model"] == model
    assert (config.data.batch_rays, config.encoder.log2_table_size) == (batch_rays, 12)
    assert f"model: {model}, because " in caplog.text
    assert "(choose another with model=NAME)" in caplog.text


@pytest.mark.parametrize(
    ("scene", "model"), [(IN_A_BOX, "fast"), (LARGE_PICTURES, "fast_large"), (PHOTOGRAPHS, "fast_proposal")]
)
def test_a_gpu_takes_larger_batches_and_for_large_pictures_a_larger_model_and_says_so(caplog, scene, model):
    caplog.set_level("INFO")
    asked = compose_config("train", [])
    plain = resolve_auto(asked, scene).config
    assert "samples a step" not in caplog.text
    resolved = resolve_auto(asked, scene, "cuda")
    larger = resolved.config
    assert resolved.choices["model"] == model
    assert larger.data.batch_rays == GPU_BATCHES[model]["data.batch_rays"] == 2 * plain.data.batch_rays
    assert caplog.text.count("about 2^18 samples a step") == 1
    # A run goes on with what was chosen for it, wherever and for however long that was.
    for device, former in (("cuda", plain), ("cpu", larger)):
        assert resolve_auto(resumed(asked, former), scene, device).config == former
    typed = ["data.batch_rays=77", "data.sample_budget=5000"]
    assert resolve_auto(compose_config("train", typed), scene, "cuda").config.data.batch_rays == 77


def test_a_run_is_built_for_the_gpu_that_there_is(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a stand-in")
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: True)
    monkeypatch.setattr(devices, "_trouble_of_gpu", lambda: None)
    overrides = ["scene=bricks", "scene.resolution=16", "encoder.log2_table_size=8"]
    job = assemble_job(compose_config("train", overrides))
    assert job.settings.device_type == "cuda"
    assert job.data.batches.batch_rays == GPU_BATCHES["fast"]["data.batch_rays"]


@pytest.mark.parametrize(
    ("scene", "overrides", "suited"),
    [
        (LARGE_PICTURES, (), (1024, 1024, 20, 2)),
        (LARGE_PICTURES, ("budget.seconds=60",), (576, 512, 18, 1)),
        (
            LARGE_PICTURES,
            (f"{STEPS_SETTING}=100", "encoder=hash_grid_small", "field.color_layers=3"),
            (100, 256, 16, 3),
        ),
        (IN_A_BOX, (), (384, 512, 18, 1)),
    ],
)
def test_large_pictures_of_a_box_take_finer_steps_and_with_time_a_larger_model(caplog, scene, overrides, suited):
    caplog.set_level("INFO")
    config, _ = chosen_for(scene, *overrides)
    grid = config.encoder.max_resolution, config.encoder.log2_table_size
    assert (config.model.levels.fine.sampler.num_steps, *grid, config.field.color_layers) == suited
    assert (f"steps: {suited[0]} across the box" in caplog.text) == (suited[0] in (576, 1024))
    assert ("encoder: 1024 cells per side, because" in caplog.text) == (suited[1] == 1024)


@pytest.mark.parametrize(
    ("scene", "overrides", "rays"),
    [
        (IN_A_BOX, (), 2),
        (IN_A_BOX, ("budget.seconds=300",), 2),
        (IN_A_BOX, ("budget.seconds=60",), 1),
        (IN_A_BOX, ("loss=robust",), 1),
        (IN_A_BOX, (f"{RAYS_SETTING}=3",), 3),
        (LARGE_PICTURES, (), 2),
        (LARGE_PICTURES, ("budget.seconds=60",), 1),
        (PHOTOGRAPHS, (), 1),
    ],
)
def test_pictures_of_a_box_take_several_rays_a_pixel_with_time(caplog, scene, overrides, rays):
    caplog.set_level("INFO")
    assert chosen_for(scene, *overrides)[0].model.subpixels == rays
    assert ("rays: 2 x 2 through each pixel at the end of the run, for" in caplog.text) == (rays == 2)


def with_depths(scene, distance=1.0):
    pixels = PixelIndex(*(torch.tensor([0, 1, 2]) for _ in range(3)))
    return replace(scene, depths=KnownDepths(pixels, torch.full((3,), distance), torch.ones(3)))


def test_known_depths_are_trained_on_with_a_grid_as_fine_as_the_pixels(caplog):
    caplog.set_level("INFO")
    far = replace(PHOTOGRAPHS.cameras, focal=PHOTOGRAPHS.cameras.focal * 30.0)  # 576 pixels
    scene = with_depths(replace(PHOTOGRAPHS, cameras=far), distance=1.5)
    config, choices = chosen_for(scene, "seed=3")
    assert choices["loss"] == "depth"
    # Cells of 4 / 2048 are as small as pixels of 1.5 / 576; those of 4 / 1024 are not.
    assert (config.encoder.max_resolution, config.encoder.log2_table_size) == (2048, 19)
    assert "loss: depth, since the distance of 3 pixels is known" in caplog.text
    assert "encoder: 2048 cells per side" in caplog.text


def seen_sharply(photographs=30):
    """Pictures of 1,920 pixels in focal length, whose cameras stand 4 units from the middle."""
    sharp = replace(PHOTOGRAPHS.cameras, focal=PHOTOGRAPHS.cameras.focal * 100.0)
    train = PHOTOGRAPHS.splits["train"]
    splits = PHOTOGRAPHS.splits | {"train": tuple(train[number % len(train)] for number in range(photographs))}
    return replace(PHOTOGRAPHS, cameras=sharp, splits=splits)


@pytest.mark.parametrize(
    ("photographs", "overrides", "grid", "said"),
    [
        (30, (), (2048, 19), "as small as the pixels"),
        (30, ("encoder.blend_in=0.5",), (2048, 19), "as small as the pixels"),
        (30, ("budget.seconds=60",), (1024, 18), "twice as wide as the pixels because the run is short"),
        (29, (), (1024, 18), "twice as wide as the pixels because there are few photographs and no known distances"),
    ],
)
def test_without_depths_pixels_are_as_wide_as_at_the_middle_of_the_scene(caplog, photographs, overrides, grid, said):
    caplog.set_level("INFO")
    config, _ = chosen_for(seen_sharply(photographs), *overrides)
    assert (config.encoder.max_resolution, config.encoder.log2_table_size) == grid
    assert said in caplog.text


def test_a_loss_and_a_grid_stay_where_they_are_typed_or_no_depths_are_known():
    for scene, typed in (
        (PHOTOGRAPHS, ()),
        (with_depths(IN_A_BOX), ()),
        (with_depths(PHOTOGRAPHS), ("loss=proposal",)),
    ):
        config, choices = chosen_for(scene, *typed)
        assert (choices["loss"] != "depth", config.encoder.max_resolution) == (True, 512)
    for distance, resolution in ((1e-4, 4096), (100.0, 512)):
        assert chosen_for(with_depths(PHOTOGRAPHS, distance))[0].encoder.max_resolution == resolution
    config, choices = chosen_for(with_depths(PHOTOGRAPHS, 1e-3), "encoder.log2_table_size=12")
    assert (choices["loss"], config.encoder.max_resolution, config.encoder.log2_table_size) == ("depth", 512, 12)
    _, choices = chosen_for(with_depths(PHOTOGRAPHS), "model=nerf")
    assert choices["loss"] == "mse"


def test_captures_are_examined_trained_for_minutes_and_reported():
    pytest.importorskip("nerf_lightning.extensions.splats", reason="whose page takes part of the time")
    photos, _ = chosen_for(PHOTOGRAPHS, "scene=photos", "scene.root=a")
    assert (photos.doctor, photos.final.report, photos.budget.seconds) == (True, True, 200)
    other, _ = chosen_for(PHOTOGRAPHS, "scene=colmap", "scene.root=a")
    assert (other.doctor, other.final.report, other.budget.seconds) == (True, True, 200)
    built_in, _ = chosen_for(PHOTOGRAPHS, "scene=bricks")
    assert (built_in.doctor, built_in.final.report) == (False, False)
    given, _ = chosen_for(PHOTOGRAPHS, "scene=photos", "doctor=off", "final.report=false")
    assert (given.doctor, given.final.report) == (False, False)


@pytest.mark.parametrize(
    ("scene", "typed", "page"),
    [
        (PHOTOGRAPHS, (), True),
        (PHOTOGRAPHS, ("budget.seconds=100",), True),
        (PHOTOGRAPHS, ("budget.seconds=99",), False),
        (PHOTOGRAPHS, ("trainer.max_steps=900",), False),
        (PHOTOGRAPHS, ("final.page=false",), False),
        (PHOTOGRAPHS, ("trainer.max_steps=900", "final.page=true"), True),
        (IN_A_BOX, (), False),
    ],
)
def test_photographs_that_are_trained_on_for_long_enough_become_a_page(scene, typed, page):
    pytest.importorskip("nerf_lightning.extensions.splats", reason="an extension, which is not here")
    assert chosen_for(scene, "scene=photos", "scene.root=a", *typed)[0].final.page is page


@pytest.mark.parametrize(
    ("on_gpu", "typed", "former", "longest"),
    [
        (False, (), None, 640),
        (True, (), None, 1600),
        (True, ("scene.longest=800",), None, 800),
        (False, (), {"scene": {"longest": 1600}}, 1600),
        (True, (), {"scene": {"longest": 640}}, 640),
    ],
)
def test_photographs_are_as_large_as_the_device_has_time_for(on_gpu, typed, former, longest):
    typed = ("scene=auto", "scene.root=a", *typed)
    asked = with_longest(replace(compose_config("train", typed), resumed=former), on_gpu)
    assert (asked.config.scene.downscale, asked.config.scene.longest) == ("auto", longest)
    assert fit_model(replace(asked, resumed=None), PHOTOGRAPHS, on_gpu).config.scene.longest == longest
    built_in = replace(compose_config("train", ()), resumed=former)
    assert with_longest(built_in, on_gpu) is built_in


@pytest.mark.parametrize(
    ("device", "typed", "seconds", "steps"),
    [
        ("cpu", (), 300, None),
        ("cpu", ("scene=photos", "scene.root=a"), 300, None),
        ("cpu", ("model=nerf",), 300, None),
        ("cuda", (), None, 35_000),
        ("cuda", ("scene=photos", "scene.root=a"), None, 35_000),
        ("xla", ("model=nerf_small",), None, 200_000),
        ("cpu", ("scene=photos", "scene.root=a", "trainer.max_steps=250"), None, 250),
        ("cpu", ("trainer.max_epochs=3",), None, None),
        ("cuda", ("budget.seconds=60",), 60, None),
        ("cpu", ("budget.seconds=60", "trainer.max_steps=250"), 60, 250),
        ("cpu", ("experiment=quickstart",), None, 600),
        ("cpu", ("budget.seconds=null",), None, 35_000),
    ],
)
def test_the_length_is_what_is_typed_or_minutes_on_a_cpu_or_the_published_steps(device, typed, seconds, steps):
    config = resolve_auto(compose_config("train", typed), IN_A_BOX, device).config
    assert (config.budget.seconds, config.trainer.max_steps) == (seconds, steps)


def corrected_for(verdict, *overrides):
    said = "2 of 20 differ in brightness"
    checks = [Check("sharpness", "look", "blurred"), Check("exposure", verdict, said)] if verdict else None
    resolved = resolve_correction(compose_config("train", overrides), exposure_finding(checks))
    return resolved.config, resolved.choices


@pytest.mark.parametrize("overrides", [(), ("correction=auto",)])
def test_photographs_whose_exposures_differ_are_corrected_and_it_is_said(caplog, overrides):
    caplog.set_level("INFO")
    config, choices = corrected_for("look", "model=fast_small", "field.width=32", *overrides)
    assert (choices["correction"], choices["model"]) == ("exposure", "fast_small")
    assert (config.correction, config.field.width) == (composed("train", "correction=exposure").correction, 32)
    assert "correction: exposure, since 2 of 20 differ in brightness (correction=none " in caplog.text


@pytest.mark.parametrize("verdict", ["ok", None])
def test_other_photographs_are_taken_as_they_are(caplog, verdict):
    caplog.set_level("INFO")
    config, choices = corrected_for(verdict)
    assert choices["correction"] == "none"
    assert config.correction == composed("train", "correction=none").correction
    assert "correction:" not in caplog.text


def test_a_correction_that_is_named_stays():
    for named in ("none", "exposure"):
        for verdict in ("ok", "look"):
            config, choices = corrected_for(verdict, f"correction={named}")
            assert choices["correction"] == named
            assert config.correction == composed("train", f"correction={named}").correction


@pytest.mark.parametrize("goes_on", ["resume={}", "resume={}/checkpoints/last.ckpt", "paths.output_dir={} resume=auto"])
def test_a_run_that_is_gone_on_with_keeps_the_correction_that_was_chosen_for_it(tmp_path, goes_on):
    (tmp_path / ".hydra").mkdir()
    for named, verdict in (("exposure", None), ("none", "look")):
        chosen = OmegaConf.create({"correction": composed("train", f"correction={named}").correction})
        OmegaConf.save(chosen, tmp_path / ".hydra" / "config.yaml")
        asked = compose_config("train", goes_on.format(tmp_path, tmp_path).split())
        asked = replace(asked, resumed=former_config(asked.config, job_folder=None))
        checks = [Check("exposure", verdict, "one differs")] if verdict else None
        resolved = resolve_correction(asked, exposure_finding(checks))
        assert resolved.choices["correction"] == named
        assert resolved.config.correction == chosen.correction


def test_a_new_run_knows_of_no_former_one_and_what_is_neither_a_switch_nor_auto_is_refused(tmp_path):
    for overrides in ([], [f"paths.output_dir={tmp_path}/new"], ["resume=auto"]):
        assert former_config(compose_config("train", overrides).config, job_folder=None) is None
    with pytest.raises(InputError, match="doctor=maybe is not valid"):
        chosen_for(PHOTOGRAPHS, "doctor=maybe")


def test_what_the_doctor_of_a_training_finds_reaches_its_step(monkeypatch):
    found = [Check("exposure", "look", "one differs")]
    monkeypatch.setattr("nerf_lightning.runs.plan_run.require_sound", lambda scene: found)
    monkeypatch.setattr("nerf_lightning.data.bricks.reader.BricksReader.read", lambda reader: IN_A_BOX)
    for doctor, learnt in (("on", True), ("off", False)):
        overrides = [*FAST, f"doctor={doctor}", "trainer.precision=32-true"]
        parts = assemble_job(compose_config("train", overrides))
        assert (parts.system.train_step.objective.correction is not None) == learnt
        assert parts.system.record["choices"]["correction"] == ("exposure" if learnt else "none")


@pytest.mark.parametrize(
    ("typed", "device", "evaluated"),
    [
        (("budget.seconds=120",), "cpu", 11),
        (("budget.seconds=3",), "cpu", 3),
        ((), "cpu", 29),
        (("budget.seconds=120", "evaluation.max_views=null"), "cpu", None),
        (("budget.seconds=120", "evaluation.max_views=50"), "cpu", 50),
        (("trainer.max_steps=100",), "cpu", None),
        (("budget.seconds=120",), "cuda", None),
    ],
)
def test_no_more_views_are_evaluated_than_a_budget_has_time_for(typed, device, evaluated):
    views = [0] * 40
    size = {"width": torch.tensor([640]), "height": torch.tensor([480])}
    cameras = replace(PHOTOGRAPHS.cameras, **{key: each.expand(6) for key, each in size.items()})
    scene = replace(PHOTOGRAPHS, splits=PHOTOGRAPHS.splits | {"test": tuple(views)}, cameras=cameras)
    config = resolve_auto(compose_config("train", typed), scene, device).config
    assert config.evaluation.max_views == evaluated
    typed = [each for each in typed if "max_views" in each]
    again = resolve_auto(resumed(compose_config("train", typed), config), scene, "cpu").config
    assert again.evaluation.max_views == evaluated
