"""Our method in NerfBaselines itself: found, trained, rendered, evaluated, and resumed to the bit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.orbit import LENS, orbit_images, orbit_masks, orbit_poses

nerfbaselines = pytest.importorskip("nerfbaselines", reason="NerfBaselines is not installed: make test-nerfbaselines")

from nerfbaselines.evaluation import DefaultEvaluationProtocol  # noqa: E402
from nerfbaselines.metrics import psnr  # noqa: E402
from nerfbaselines.training import Trainer, get_presets_and_config_overrides  # noqa: E402
from nerfbaselines.utils import Indices, convert_image_dtype  # noqa: E402

from nerf_lightning.extensions.nerfbaselines.nerfbaselines import cameras_of, scene_of  # noqa: E402

SETTINGS = {"model": "nerf_tiny", "trainer": "cpu", "data.batch_rays": 64, "data.crop_steps": 0, "max_steps": 8}
SIZE = (20, 16)
pytestmark = pytest.mark.filterwarnings("default")  # they are not ours


class PsnrAlone(DefaultEvaluationProtocol):
    """LPIPS, part of the default, loads networks."""

    _name = "psnr"

    def evaluate(self, predictions, dataset):
        truth = convert_image_dtype(dataset["images"][0], np.float32)
        return {"psnr": float(psnr(((predictions["color"] - truth) ** 2).mean()))}


nerfbaselines.register({"id": "psnr", "evaluation_protocol_class": f"{__name__}:PsnrAlone"})


@pytest.fixture(params=["opencv", "opencv_fisheye"])
def dataset(request):
    poses, count = orbit_poses(6), 6
    cameras = nerfbaselines.new_cameras(
        poses=poses.numpy(),
        intrinsics=np.tile(np.float32([22.0, 22.0, 10.0, 8.0]), (count, 1)),
        camera_models=np.full(count, nerfbaselines.camera_model_to_int(request.param), np.int32),
        image_sizes=np.tile(np.int32(SIZE), (count, 1)),
        distortion_parameters=np.tile(np.float32([*LENS, 0.001, 0.0002]), (count, 1)),
    )
    return nerfbaselines.new_dataset(
        cameras=cameras,
        image_paths=[f"/captures/{number}.png" for number in range(count)],
        images=list(orbit_images(count, SIZE)),
        masks=list(orbit_masks(count, SIZE)),
        metadata={"id": "own", "color_space": "srgb", "evaluation_protocol": "psnr"},
    )


def trained(dataset, output, checkpoint=None, steps=8):
    output.mkdir()
    spec = nerfbaselines.get_method_spec("nerf-lightning")
    with nerfbaselines.build_method_class(spec, backend="python") as method_class:
        method = method_class(
            train_dataset=dataset, checkpoint=checkpoint and str(checkpoint), config_overrides=SETTINGS
        )
        trainer = Trainer(
            train_dataset=dataset,
            test_dataset=dataset,
            method=method,
            output=str(output),
            save_iters=Indices([3]),
            eval_all_iters=Indices([8]),
            generate_output_artifact=False,
            config_overrides=SETTINGS,
        )
        trainer.train()
    return method


def test_a_run_is_evaluated_and_a_resumed_one_has_its_weights(dataset, tmp_path):
    whole = trained(dataset, tmp_path / "whole")
    assert (tmp_path / "whole" / "results-8.json").is_file()
    resumed = trained(dataset, tmp_path / "resumed", tmp_path / "whole" / "checkpoint-3")
    assert resumed.get_info()["loaded_step"] == 3
    ours, theirs = whole.run.system.state_dict(), resumed.run.system.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    camera = dataset["cameras"][2]
    with nerfbaselines.load_checkpoint(str(tmp_path / "whole" / "checkpoint-8"), backend="python") as (loaded, _):
        seen = loaded.render(camera)
        loaded.save(str(tmp_path))
    assert {name: value.shape for name, value in seen.items()} == {
        "color": (16, 20, 3),
        "depth": (16, 20),
        "accumulation": (16, 20),
    }
    np.testing.assert_array_equal(seen["color"], whole.render(camera)["color"])
    assert (tmp_path / "model.ckpt").is_file()


def test_rays_are_those_of_nerfbaselines(dataset):
    from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels

    cameras = cameras_of(dataset["cameras"])
    cameras = replace(cameras, c2w=cameras.c2w.float())
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    places = np.stack([x, y], -1).reshape(-1, 2).astype(np.int32)
    camera = dataset["cameras"][np.full(len(places), 1)]
    _, theirs = nerfbaselines.cameras.get_rays(camera, places)
    zeros = torch.zeros(6)
    ours = rays_through_pixels(cameras, all_pixels(cameras, 1), zeros, zeros).directions.reshape(-1, 3)
    theirs = theirs / np.linalg.norm(theirs, axis=-1, keepdims=True)
    np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-5)


def test_a_data_set_is_learnt_from_as_it_is(dataset):
    scene = scene_of(dataset)
    assert scene.splits == {"train": tuple(range(6)), "val": (), "test": ()}
    np.testing.assert_array_equal(scene.pixels.view_mask(3).numpy(), dataset["masks"][3])
    poses = torch.from_numpy(dataset["cameras"].poses)
    assert torch.allclose(scene.user_cameras.c2w[:, :, 3], poses[:, :, 3].double(), atol=1e-5)


@pytest.mark.parametrize(
    ("name", "model"), [("blender", "fast"), ("llff", "fast_proposal"), ("mipnerf360", "fast_proposal")]
)
def test_presets_are_found_by_the_data_set(name, model):
    spec = nerfbaselines.get_method_spec("nerf-lightning")
    applied, overrides = get_presets_and_config_overrides(spec, {"id": name})
    assert applied == {name}
    assert overrides["model"] == model
    assert Path(f"conf/model/{model}.yaml").is_file()
