"""The command line, whole: a run that is resumed, a checkpoint that is read back, a film of two frames."""

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.data.pixels.images import read_rgba
from nerf_lightning.evaluation.metrics import psnr
from nerf_lightning.files.tensor_files import load_tensors
from nerf_lightning.nerf.geometry.near_far import near_and_far_from
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import Picture, render_picture
from nerf_lightning.nerf.types.scene import Cameras, SceneRecord
from nerf_lightning.selftest.check import Check
from nerf_lightning.selftest.place import Place
from nerf_lightning.selftest.runs import FILM_VIEWS, STEPS, STOP
from nerf_lightning.selftest.scene import HELD_OUT, ball_scene
from nerf_lightning.sfm.video_frames import count_frames
from nerf_lightning.video.paths.base import frame_of
from nerf_lightning.video.paths.photograph_path import PhotographPath

ONE_STEP = 0.03
"""The learning rate: about what a step moves a weight by."""
TILE_POINTS = 1 << 16


def checks(place: Place) -> list[Check]:
    """Return the checks of what the command line leaves on the disk."""
    return [
        _resume(place),
        Check(
            "checkpoint read back: PSNR of the held-out views, dB",
            0.01,
            "the run measured the same pictures before it ended: only tiles and rounding differ",
            lambda: _read_back(place),
        ),
        Check(
            "film: two frames against the same pictures rendered here, levels of 255",
            1.0,
            "a colour is rounded to 8 bits, and may fall to either side",
            lambda: _film(place),
        ),
        Check(
            "film: frames missing from the video (mp4)",
            0.0,
            "two were asked for",
            lambda: abs(count_frames(place.runs.whole() / "video.mp4") - len(FILM_VIEWS)),
        ),
    ]


def _resume(place: Place) -> Check:
    if place.is_cuda:
        return Check(
            f"resume at step {STOP} of {STEPS}: share of weights more than a step apart",
            0.1,
            "GPUs add in any order, and Adam makes whole steps of rounding where gradients are all but zero",
            lambda: _weights_apart(place, ONE_STEP),
        )
    return Check(
        f"resume at step {STOP} of {STEPS}: share of the state that differs",
        0.0,
        "on the CPU a resumed run is the uninterrupted one, bit for bit",
        lambda: _state_apart(place),
    )


def _state_apart(place: Place) -> float:
    whole, resumed = (_tensors(_last(path)) for path in (place.runs.whole(), place.runs.resumed()))
    if whole.keys() != resumed.keys():
        raise ValueError(f"one state lacks {sorted(whole.keys() ^ resumed.keys())[:3]}")
    differ = sum(int((whole[name] != resumed[name]).sum()) for name in whole)
    return differ / sum(tensor.numel() for tensor in whole.values())


def _weights_apart(place: Place, step: float) -> float:
    states = [load_tensors(_last(path))["state_dict"] for path in (place.runs.whole(), place.runs.resumed())]
    pairs = [(states[0][name], states[1][name]) for name in states[0] if name.endswith((".table", "mlp.0", "mlp.1"))]
    apart = torch.cat([((one - other).abs() > step).flatten() for one, other in pairs])
    return float(apart.double().mean())


def _last(folder: Path) -> Path:
    return folder / "checkpoints" / "last.ckpt"


def _tensors(path: Path) -> dict[str, Tensor]:
    """Return weights, grid and the optimizer's state of a checkpoint by name, and where the run stood."""
    content = load_tensors(path)
    found: dict[str, Tensor] = dict(content["state_dict"])
    progress = content["nerf_lightning"]["progress"]
    found["progress"] = torch.tensor([float(value) for _, value in sorted(progress.items())])
    for number, state in content["optimizer_states"][0]["state"].items():
        found |= {f"optimizer.{number}.{name}": torch.as_tensor(value) for name, value in state.items()}
    return found


def _loaded(place: Place) -> tuple[Model, SceneRecord]:
    path = _last(place.runs.whole())
    model = place.read_model(path)
    model.multiply_in(place.chosen)
    return model.to(place.device), read_checkpoint(path).scene


def _read_back(place: Place) -> float:
    model, scene = _loaded(place)
    measured: dict[str, Any] = json.loads((place.runs.whole() / "metrics.json").read_text())
    truth, values = ball_scene().pixels, []
    for view in HELD_OUT:
        photograph = truth.view(view).float() / 255.0
        seen = _picture(model, scene, scene.cameras, view, scene.near, scene.far)
        values.append(float(psnr((seen.rgb - photograph[..., :3] * photograph[..., 3:]).square().mean())))
    return abs(sum(values) / len(values) - measured["psnr"])


def _film(place: Place) -> float:
    files = sorted(place.runs.film().glob("*.png"))
    if len(files) != len(FILM_VIEWS):
        raise ValueError(f"{len(files)} frames were written, and {len(FILM_VIEWS)} were asked for")
    model, scene = _loaded(place)
    path = PhotographPath(num_frames=len(FILM_VIEWS), views=list(FILM_VIEWS))
    cameras = path.cameras(frame_of(scene.cameras, scene.aabb, to_user=scene.to_user, view_names=scene.view_names))
    near, far = near_and_far_from(cameras.c2w[:, :, 3], scene)
    differences = []
    for frame, file in enumerate(files):
        seen = (255.0 * _picture(model, scene, cameras, frame, near, far).rgb.clamp(0, 1)).round()
        written = torch.from_numpy(read_rgba(file)[..., :3].copy()).float()
        differences.append(float((seen - written).abs().max()))
    return max(differences)


def _picture(model: Model, scene: SceneRecord, cameras: Cameras, view: int, near: Tensor, far: Tensor) -> Picture:
    return render_picture(model, RayGenerator(cameras, near, far), view, scene.background, TILE_POINTS)
