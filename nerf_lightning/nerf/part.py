"""The contract of every part that learns, inside the model or next to it: the hooks that training calls.

A hook acts for the part itself and not for its submodules, which training finds by a walk over modules: a part may be
anywhere, and nothing has to forward a hook. Only `reset_parameters` acts for all submodules.
"""

from collections.abc import Hashable, Iterator
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.types.scene import Scene


@dataclass(frozen=True)
class StepContext:
    """The state of a run before a training step."""

    progress: float
    """Share of the run's steps taken so far, in [0, 1)."""
    step: int
    """Steps taken in this attempt."""
    key: int
    """Key of the step's random numbers."""


class Part(nn.Module):
    """A module with hooks for training: its learning rate and penalty, the scene, and each step.

    Models, levels, samplers, fields, encoders, cameras, corrections and losses are parts.
    """

    learning_rate: float | None = None
    """Initial rate of all its parameters, scaled by the run's schedule, without weight decay. None: the run's rate."""

    replays: bool = True
    """Whether it uses the same kernels in each step of one `step_variant`, so that a recording of one
    (trainer.cuda_graph) may be replayed for others. The value counts for a part of your own if its class sets it; else
    the part is recorded only on request. Such a step changes no buffers but `sample_counts`."""

    couples_rays: bool = False
    """Whether a ray's result depends on the other rays of a step; tiles and processes must not split them. (For pixels
    that a loss needs together, see `Objective.pixels_per_patch`.)"""

    step_variant: Hashable = None
    """What the host has decided for the next step that changes its kernels."""

    def fit_to(self, scene: Scene) -> None:
        """Record where the scene's content is, once, before training; a checkpoint contains it."""

    def on_step(self, context: StepContext) -> None:
        """Prepare for the next training step; the inner parts have done so."""

    def after_step(
        self, rgb: Float[Tensor, "rays 3"], target: Float[Tensor, "rays 3"], weight: Float[Tensor, "rays"]
    ) -> None:
        """Learn from a step's result, after it is taken; state that the next steps depend on must be in buffers.

        Args:
            rgb: the last level's picture.
            target: what the photographs show.
            weight: 0 for masked pixels.
        """

    def penalty(self) -> Float[Tensor, ""] | None:
        """Return what is added to the loss once per step, however it is cut into tiles; None: nothing."""
        return None

    def sample_counts(self) -> list[Tensor]:
        """Return the buffers in which a training step counts, to restore them when a step is repeated."""
        return []

    def buffers_to_average(self) -> list[Tensor]:
        """Return the buffers that hold means over rays, on which the processes of a run must agree."""
        return []

    def statistics(self) -> dict[str, float]:
        """Return values worth watching while training."""
        return {}

    def reset_statistics(self) -> None:
        """Reset what was counted while rendering."""

    def validate_state(self) -> None:
        """Check the loaded state.

        Raises:
            InputError: it is invalid.
        """

    def reset_parameters(self) -> None:
        """Begin a new attempt: reinitialize all parameters from torch's generator, and reset all else that was learned.

        By default the inner parts do so, in their order.
        """
        for part in _nearest_parts(self):
            part.reset_parameters()


def parts_of(*modules: nn.Module) -> Iterator[Part]:
    """Yield every part within modules, each once, outer parts before inner ones."""
    known: set[int] = set()
    for module in modules:
        for part in module.modules():
            if isinstance(part, Part) and id(part) not in known:
                known.add(id(part))
                yield part


def coupled_parts(module: nn.Module) -> list[str]:
    """Return the classes of the parts within a module that depend on all rays of a step (`Part.couples_rays`)."""
    return [type(part).__name__ for part in parts_of(module) if part.couples_rays]


def _nearest_parts(module: nn.Module) -> Iterator[Part]:
    """Yield the outermost parts within a module."""
    for child in module.children():
        if isinstance(child, Part):
            yield child
        else:
            yield from _nearest_parts(child)


def fit_parts(module: nn.Module, scene: Scene) -> None:
    """Fit every part within a module to the scene."""
    for part in parts_of(module):
        part.fit_to(scene)


def begin_step(module: nn.Module, context: StepContext) -> None:
    """Let every part within a module prepare for a step, inner parts first: a level's grid evaluates its field."""
    for part in reversed(list(parts_of(module))):
        part.on_step(context)


def end_step(
    module: nn.Module, rgb: Float[Tensor, "rays 3"], target: Float[Tensor, "rays 3"], weight: Float[Tensor, "rays"]
) -> None:
    """Let every part within a module learn from a step's result."""
    for part in parts_of(module):
        part.after_step(rgb, target, weight)


def sample_counts(module: nn.Module) -> list[Tensor]:
    """Return the buffers in which a training step counts."""
    return [count for part in parts_of(module) for count in part.sample_counts()]


def buffers_to_average(module: nn.Module) -> list[Tensor]:
    """Return the buffers that hold means over rays."""
    return [mean for part in parts_of(module) for mean in part.buffers_to_average()]


def reset_statistics(module: nn.Module) -> None:
    """Reset what every part within a module has counted."""
    for part in parts_of(module):
        part.reset_statistics()


def statistics(module: nn.Module) -> dict[str, float]:
    """Return values worth watching while training."""
    return {name: value for part in parts_of(module) for name, value in part.statistics().items()}
