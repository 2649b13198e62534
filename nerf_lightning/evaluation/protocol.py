"""How a number was measured, and of what: recorded in every result, so that only like is compared with like.

`measured_how` is the protocol: two results belong in one table if theirs agree. `measured_of` names the weights and the
program; it differs from run to run, and says where a number came from.
"""

import hashlib
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn

from nerf_lightning import __version__
from nerf_lightning.config.overrides import leaves
from nerf_lightning.config.setting_rules import fingerprint, meaning_of
from nerf_lightning.evaluation.metrics import SSIM_SIGMA, SSIM_WINDOW
from nerf_lightning.evaluation.metrics_files import as_text
from nerf_lightning.files.yaml_files import plain_yaml
from nerf_lightning.nerf.rendering.background import at_evaluation
from nerf_lightning.nerf.types.scene import Background, Scene

REPOSITORY = Path(__file__).parents[2]
GIT_SECONDS = 10
EVERYWHERE = ("split", "pixels", "psnr", "ssim", "lpips", "cameras", "colors")
"""What must agree even between results of different scenes."""
MAY_LACK = ("lpips", "cc_psnr")  # What one result may have and another not
Colors = Literal["raw", "half_fit"]
"""Compare a render as it is, or only its right half, with exposure and white balance fitted on the left."""
COLORS = {"raw": "raw", "half_fit": "exposure and white balance fitted on the left half, scored on the right"}


def measured_how(
    scene: Scene,
    split: str,
    views: list[int],
    background: Background,
    quantize: bool,
    lpips: str | None,
    colors: Colors = "raw",
) -> dict[str, Any]:
    """Return the protocol of a measurement.

    A background drawn at random in training stands for its color at evaluation; `quantize`: the render was rounded to 8
    bits; `lpips` is the backbone, None if LPIPS is not computed.
    """
    sizes = sorted({(int(scene.cameras.width[v]), int(scene.cameras.height[v])) for v in views})
    return {
        "scene": scene.name,
        "split": split,
        "split_hash": split_hash(scene, views),
        "background": at_evaluation(background),
        "resolution": [list(size) for size in sizes],
        "pixels": "8-bit" if quantize else "float",
        "cameras": "refined" if scene.refined else "raw",
        "colors": COLORS[colors],
        "masks": "none" if scene.pixels.mask is None else "left out",
        "psnr": "mean of the pictures' own",
        "cc_psnr": "after an affine fit of each picture's colors, by least squares",
        "ssim": f"torchmetrics, Gaussian {SSIM_WINDOW} x {SSIM_WINDOW}, sigma {SSIM_SIGMA}",
        "lpips": None if lpips is None else f"{lpips}, version 0.1",
        **scene.protocol,
    }


def split_hash(scene: Scene, views: list[int]) -> str:
    """Return a fingerprint of names, pixels and masks, so that numbers on different pictures are not compared."""
    digest = hashlib.sha256()
    for view in views:
        digest.update(scene.view_names[view].encode("utf-8", "surrogatepass"))
        digest.update(scene.pixels.view(view).contiguous().numpy().tobytes())
        kept = scene.pixels.view_mask(view)
        if kept is not None:
            digest.update(kept.numpy().tobytes())
    return digest.hexdigest()[:16]


def measured_of(
    model: nn.Module,
    config: str,
    choices: Mapping[str, str],
    device: torch.device,
    precision: str,
    step: int | None = None,
) -> dict[str, Any]:
    """Return what was measured, with what; `config` is resolved yaml, `choices` the names picked from each group."""
    settings = plain_yaml(config, "The run's config")
    weights = model.state_dict()
    on_gpu = device.type == "cuda"
    return {
        "model": choices.get("model", ""),
        "scene": choices.get("scene", ""),
        "seed": settings.get("seed") if isinstance(settings, dict) else None,
        "config": config_hash(settings),
        "checkpoint": weights_hash(weights),
        "step": step,
        "version": __version__,
        "commit": commit(),
        "device": torch.cuda.get_device_name(device) if on_gpu else device.type,
        "precision": precision,
        "parameters": sum(parameter.numel() for parameter in model.parameters()),
        "megabytes": round(sum(tensor.nbytes for tensor in weights.values()) / 1e6, 3),
    }


def config_hash(settings: Any) -> str:
    """Return a fingerprint of the settings that decide what is learned: equal for runs that differ only in their seed.

    >>> config_hash({"seed": 0, "optimizer": {"lr": 1}}) == config_hash({"seed": 1, "optimizer": {"lr": 1}})
    True
    """
    return fingerprint({key: value for key, value in leaves(settings).items() if meaning_of(key).learnt})


def weights_hash(weights: Mapping[str, torch.Tensor]) -> str:
    """Return a fingerprint of names and values, independent of where and with what else the weights are stored."""
    digest = hashlib.sha256()
    for name in sorted(weights):
        digest.update(name.encode())
        digest.update(weights[name].detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]


def commit() -> str | None:
    """Return the commit that this program runs from, with `-dirty` if files were changed; None if it is installed."""
    if not (REPOSITORY / ".git").exists():
        return None
    command = ["git", "-C", str(REPOSITORY), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=GIT_SECONDS)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def differences(one: Mapping[str, Any], other: Mapping[str, Any], same_scene: bool = True) -> list[str]:
    """Return what keeps two results from being compared, in words; a metric that only one has does not.

    >>> differences({"pixels": "float"}, {"pixels": "8-bit"})
    ['pixels: float and 8-bit']
    """
    keys = [key for key in dict.fromkeys([*one, *other]) if same_scene or key in EVERYWHERE]
    return [
        f"{key}: {_said(one, key)} and {_said(other, key)}"
        for key in keys
        if one.get(key) != other.get(key) and not (key in MAY_LACK and None in (one.get(key), other.get(key)))
    ]


def _said(protocol: Mapping[str, Any], key: str) -> str:
    return as_text(protocol[key])[:80] if key in protocol else "not said"
