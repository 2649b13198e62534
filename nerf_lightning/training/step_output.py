"""What a step of training returns."""

from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.tensor_struct import TensorStruct


@dataclass(frozen=True)
class StepOutput(TensorStruct):
    """What a step saw of its rays, and what it lost there; detached. Callbacks find it as `outputs["step"]`.

    Where steps are recorded and replayed, the next one writes over it: clone what is to be kept.
    """

    losses: Float[Tensor, "levels"]
    """Of the whole batch, over all processes; their sum was minimized, with the penalties of parts."""
    terms: dict[str, Float[Tensor, "levels"]]
    """The same by term of the loss."""
    color_errors: Float[Tensor, "levels"]
    """Mean squared errors of the levels' colors, over all processes; a level without color has a meaningless one."""
    foreground: Float[Tensor, "rays 3"]
    """The last level's light, without the background's; of this process's rays, like all that follows."""
    rgb: Float[Tensor, "rays 3"]
    """The last level's colors, as they were compared with `target`."""
    target: Float[Tensor, "rays 3"]
    weight: Float[Tensor, "rays"]
    """0 for masked pixels."""
    pixels: PixelIndex
    gradient_norms: dict[str, Float[Tensor, ""]] = field(default_factory=dict)
    """By level, before clipping; empty where they were not measured or the step was not taken."""
