"""A camera path that is recorded by hand, as yaml."""

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import yaml
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.export.atomic import whole_file


@dataclass(frozen=True)
class Keyframe:
    """A camera of the path, in the user's frame."""

    position: list[float]
    look_at: list[float]
    up: list[float]
    fov: float
    """Vertical field of view in degrees."""
    time: float
    """Seconds from the start."""


def keyframe_in_user_frame(
    position: Float[Tensor, "3"],
    look_at: Float[Tensor, "3"],
    up: Float[Tensor, "3"],
    fov: float,
    time: float,
    to_user: Float[Tensor, "4 4"],
) -> Keyframe:
    """Return a keyframe of a camera in the model's frame; `fov` in degrees, `time` in seconds."""
    linear, offset = to_user[:3, :3].double(), to_user[:3, 3].double()
    turned = torch.nn.functional.normalize(linear @ up.double(), dim=0)
    return Keyframe(
        position=_rounded(linear @ position.double() + offset),
        look_at=_rounded(linear @ look_at.double() + offset),
        up=_rounded(turned),
        fov=round(fov, 3),
        time=time,
    )


def write_keyframes(path: Path, keyframes: list[Keyframe]) -> None:
    """Write keyframes as a yaml list: whole or not at all."""
    with whole_file(path) as part:
        part.write_text(yaml.safe_dump([asdict(each) for each in keyframes], sort_keys=False), encoding="utf-8")


def _rounded(values: Tensor) -> list[float]:
    return [round(value, 6) for value in values.tolist()]
