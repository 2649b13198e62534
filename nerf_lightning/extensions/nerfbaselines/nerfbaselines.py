"""nerf_lightning as a method of NerfBaselines, using only the public API of `import nerf_lightning`."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfbaselines import Method, camera_model_to_int
from nerfbaselines.utils import convert_image_dtype

import nerf_lightning as nl

FILE, FISHEYE = "model.ckpt", camera_model_to_int("opencv_fisheye")
INFO = {
    "method_id": "nerf-lightning",
    "required_features": frozenset(("color", "points3D_xyz")),
    "supported_camera_models": frozenset(("pinhole", "opencv", "opencv_fisheye")),
    "supported_outputs": ("color", "depth", "accumulation"),
    "can_resume_training": True,
}


def cameras_of(cameras: Any) -> nl.Cameras:
    """Convert cameras of NerfBaselines, whose coefficients are k1 k2 p1 p2 k3 k4, to ours."""
    fisheye = cameras.camera_models == FISHEYE
    if fisheye.any() and not fisheye.all():
        raise nl.InputError("The data set mixes fisheyes with other lenses, and a scene has lenses of one kind.")
    poses, size, pixels = map(torch.from_numpy, (cameras.poses, cameras.image_sizes, cameras.intrinsics))
    matrix = torch.eye(3).repeat(len(poses), 1, 1)
    matrix[:, [0, 1, 0, 1], [0, 1, 2, 2]] = pixels.float()
    lens = np.pad(cameras.distortion_parameters, ((0, 0), (0, 6)))[:, [0, 1, 4, 5] if fisheye.any() else [0, 1, 2, 3]]
    return nl.Cameras.from_opencv(poses.double(), matrix, size.long(), torch.from_numpy(lens), bool(fisheye.any()))


def scene_of(dataset: Any) -> nl.Scene:
    """Return a dataset of NerfBaselines as a scene; all of its views are for training."""
    cameras, masks, behind = dataset["cameras"], dataset.get("masks"), dataset["metadata"].get("background_color")
    parts = [np.s_[: int(height), : int(width)] for width, height in cameras.image_sizes]
    images = [convert_image_dtype(image[part], np.uint8) for image, part in zip(dataset["images"], parts, strict=True)]
    clear = any(image.shape[-1] == 4 and image.min(axis=(0, 1))[3] < 255 for image in images)
    bounds = cameras.nears_fars if clear else None  # of photographs, cameras and points tell more
    return nl.scene_from_cameras(
        images,
        cameras_of(cameras),
        points=dataset.get("points3D_xyz"),
        masks=None if masks is None else [mask[part] for mask, part in zip(masks, parts, strict=True)],
        background=None if behind is None else "white" if np.mean(behind) > 127 else "black",
        names=dataset["image_paths"],
        near=None if bounds is None else float(bounds[:, 0].min()),
        far=None if bounds is None else float(bounds[:, 1].max()),
    )


class NerfLightning(Method):
    """Take one step per iteration; `config_overrides` are settings of `nerf train`, and `max_steps`."""

    def __init__(self, *, checkpoint: Any = None, train_dataset: Any = None, config_overrides: Any = None):
        settings = {"max_steps": 20_000, **(config_overrides or {})}
        length = int(settings.pop("max_steps"))
        file = None if checkpoint is None else Path(checkpoint) / FILE
        if train_dataset is None:
            self.run, self.model = None, nl.load(str(file))
        else:
            overrides = [f"{key}={value}" for key, value in settings.items()]
            self.run = nl.build_run(*overrides, scene=scene_of(train_dataset), resume=file)
            self.model, self.steps = self.run.model, self.run.steps(length)
        loaded = None if file is None else self.model.checkpoint.step
        place = {"num_iterations": length, "loaded_checkpoint": checkpoint, "loaded_step": loaded}
        self.info = INFO | place | {"hparams": settings}

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        return INFO

    def get_info(self) -> dict[str, Any]:
        return self.info

    def train_iteration(self, step: int) -> dict[str, Any]:
        return next(self.steps)

    def render(self, camera: Any, *, options: Any = None) -> dict[str, np.ndarray]:
        model = self.model if self.run is None else self.run.model
        picture = model.render(cameras_of(camera.item()[None])[0])
        depth, opacity = picture.depth.numpy(), picture.opacity.numpy()
        return {"color": picture.rgb.clamp(0.0, 1.0).numpy(), "depth": depth, "accumulation": opacity}

    def save(self, path: str) -> None:
        file = Path(path) / FILE
        if self.run is None:
            shutil.copy(self.model.checkpoint.path, file)
        else:
            self.run.save(file)
