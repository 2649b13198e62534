"""What a batch's pixels have shown and lost."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.tensor_struct import TensorStruct, concatenate


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
    """How much each color counted, on average 1; 0 for masked pixels, and from elsewhere (`Loss.rays_to_render`)."""
    pixels: PixelIndex
    gradient_norms: dict[str, Float[Tensor, ""]] = field(default_factory=dict)
    """By level, before clipping; empty where they were not measured or the step was not taken."""

    def scaled(self, share: float) -> "StepOutput":
        """Return what a tile of rays, such a share of its batch, adds to the losses and errors of all of it."""
        if share >= 1.0:
            return self
        terms = {name: levels * share for name, levels in self.terms.items()}
        return replace(self, losses=self.losses * share, terms=terms, color_errors=self.color_errors * share)

    @classmethod
    def joined(cls, tiles: Sequence["StepOutput"]) -> "StepOutput":
        """Return what tiles add up to, their rays one after the other."""
        if len(tiles) == 1:
            return tiles[0]
        return cls(
            losses=torch.stack([each.losses for each in tiles]).sum(0),
            terms={name: torch.stack([each.terms[name] for each in tiles]).sum(0) for name in tiles[0].terms},
            color_errors=torch.stack([each.color_errors for each in tiles]).sum(0),
            foreground=torch.cat([each.foreground for each in tiles]),
            rgb=torch.cat([each.rgb for each in tiles]),
            target=torch.cat([each.target for each in tiles]),
            weight=torch.cat([each.weight for each in tiles]),
            pixels=concatenate([each.pixels for each in tiles]),
        )
