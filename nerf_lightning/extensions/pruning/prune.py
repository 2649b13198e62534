"""Make a model narrower: remove neurons from every hidden layer of its fields."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nerf_lightning.extensions.pruning.activity import mean_activity
from nerf_lightning.extensions.pruning.selection import By, Side, choose, narrowed, neurons_of
from nerf_lightning.messages.errors import InputError, require_positive
from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.randomness import fold
from nerf_lightning.nerf.types.scene import SceneRecord


@dataclass(frozen=True)
class Pruning:
    """How many neurons stay, and which."""

    keep: int | float = 0.5
    """Share of each layer's neurons to keep."""
    by: By = "importance"
    weights: Side = "out"
    """The weights whose magnitude is importance: a neuron's outgoing or incoming ones, or both."""
    round_to: int = 16
    """Widths are multiples of it."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.keep <= 1.0:
            raise InputError(f"keep={self.keep}: give the share of neurons to keep, above 0 and up to 1 (all).")
        require_positive(round_to=self.round_to)

    def width(self, there: int, where: str) -> int:
        """Return the new width of a field: the multiple of `round_to` nearest to the share, at least `round_to`.

        Raises:
            InputError: less than one neuron would stay.
        """
        if self.keep * there < 1.0:
            raise InputError(
                f"keep={self.keep} leaves {self.keep * there:.2g} of the {there} neurons that a layer of {where} has: "
                f"nothing. Give keep={min(1.0, self.round_to / there):.3g} or more."
            )
        return min(there, max(self.round_to, round(self.keep * there / self.round_to) * self.round_to))


def prunable_fields(model: Model) -> dict[str, Field]:
    """Return a model's fields that expose their hidden layers, by module name."""
    return {name: part for name, part in model.named_modules() if isinstance(part, Field) and part.hidden_layers()}


@torch.no_grad()
def prune(
    model: Model, narrower: nn.Module, pruning: Pruning, scene: SceneRecord, tile_points: int
) -> dict[str, Tensor]:
    """Return the state of a narrower model, with the remaining neurons of this one.

    Args:
        model: with its weights, on the CPU, in evaluation mode.
        narrower: the same with smaller widths; its values are not used, and it may be on `meta`.
        pruning: which neurons stay.
        scene: the source of the training views with which activity is measured.
        tile_points: maximum number of points that go through a field at once.

    Raises:
        InputError: activity decides, and rays never evaluate a field.
    """
    fields, state, shapes = prunable_fields(model), model.state_dict(), narrower.state_dict()
    key = fold(pruning.seed, "pruning")
    active = mean_activity(model, fields, scene, key, tile_points) if pruning.by == "activation" else {}
    for name, field in fields.items():
        prefix = f"{name}."
        own = {key.removeprefix(prefix): tensor for key, tensor in state.items() if key.startswith(prefix)}
        selections = {}
        for number, layer in enumerate(field.hidden_layers()):
            count = shapes[prefix + layer.rows[0]].shape[0]
            activity = active[name][number] if name in active else None
            draw = fold(key, name, number)
            selections[layer] = choose(neurons_of(own, layer), count, pruning.by, pruning.weights, activity, draw)
        state |= {prefix + key: tensor for key, tensor in narrowed(own, selections).items()}
    return state
