"""The contract of every part that learns, inside the model or beside it: what training asks of it, and tells it.

A hook speaks for the part itself and not for the parts within, which training finds by a walk over modules: a part may
sit anywhere, and nothing has to hand a hook down. Only `reset_parameters` is for all that lies within.
"""

from collections.abc import Hashable, Iterator
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.types.scene import Scene


@dataclass(frozen=True)
class StepContext:
    """Where a run stands before a step of training."""

    progress: float
    """Share of the run's steps that have been taken, in [0, 1)."""
    step: int
    """Steps that this attempt has taken."""
    key: int
    """Of the step's random numbers."""


class Part(nn.Module):
    """A module that training asks for its learning rate and penalty, and tells of the scene and of each step.

    Models, levels, samplers, fields, encoders, cameras, corrections and losses are parts.
    """

    learning_rate: float | None = None
    """Initial rate of all its parameters; the run's schedule scales it, and they do not decay. None: the run's."""

    replays: bool = True
    """Whether it takes the same kernels in each step of one `step_variant`, so that a recording (trainer.cuda_graph)
    of one may be replayed for others. A part of your own is taken at its word where its own class says so; else it is
    recorded only where that is asked for. What such a step changes in buffers are `sample_counts` alone."""

    couples_rays: bool = False
    """Whether a ray's result depends on the other rays of a step; tiles and processes must not split them. (Pixels that
    a loss wants together are `Objective.together`.)"""

    step_variant: Hashable = None
    """What the host has decided for the next step, which changes what kernels it takes."""

    def fit_to(self, scene: Scene) -> None:
        """Take note of where the scene's content lies, once, before training; a checkpoint carries it."""

    def on_step(self, context: StepContext) -> None:
        """Prepare for the next step of training; the parts within have done so."""

    def after_step(
        self, rgb: Float[Tensor, "rays 3"], target: Float[Tensor, "rays 3"], weight: Float[Tensor, "rays"]
    ) -> None:
        """Learn from what a step has seen, once it is taken; state that the next steps depend on is kept in buffers.

        Args:
            rgb: the last level's picture.
            target: what the photographs show.
            weight: 0 for masked pixels.
        """

    def penalty(self) -> Float[Tensor, ""] | None:
        """Return what is added to the loss of each step, once, however the step is cut; None: nothing."""
        return None

    def sample_counts(self) -> list[Tensor]:
        """Return the buffers in which a training step counts, to put them back where a step is repeated."""
        return []

    def buffers_to_average(self) -> list[Tensor]:
        """Return the buffers that hold means over rays, which the processes of a run must agree on."""
        return []

    def statistics(self) -> dict[str, float]:
        """Return what is worth watching while training."""
        return {}

    def reset_statistics(self) -> None:
        """Forget what was counted while rendering."""

    def validate_state(self) -> None:
        """Check what was loaded.

        Raises:
            InputError: it holds what it never can.
        """

    def reset_parameters(self) -> None:
        """Begin a new attempt: draw all parameters anew from torch's generator, and forget what was learned otherwise.

        By default the parts within do so, in their order.
        """
        for part in _nearest_parts(self):
            part.reset_parameters()


def parts_of(*modules: nn.Module) -> Iterator[Part]:
    """Return every part within modules, each once, outer parts before those inside of them."""
    known: set[int] = set()
    for module in modules:
        for part in module.modules():
            if isinstance(part, Part) and id(part) not in known:
                known.add(id(part))
                yield part


def coupled_parts(module: nn.Module) -> list[str]:
    """Return the classes of the parts within a module that look at all rays of a step (`Part.couples_rays`)."""
    return [type(part).__name__ for part in parts_of(module) if part.couples_rays]


def _nearest_parts(module: nn.Module) -> Iterator[Part]:
    """Return the parts within a module that lie in no other part within it."""
    for child in module.children():
        if isinstance(child, Part):
            yield child
        else:
            yield from _nearest_parts(child)


def fit_parts(module: nn.Module, scene: Scene) -> None:
    """Let every part within a module take note of the scene."""
    for part in parts_of(module):
        part.fit_to(scene)


def begin_step(module: nn.Module, context: StepContext) -> None:
    """Let every part within a module prepare for a step, inner parts first: a level's grid asks its field."""
    for part in reversed(list(parts_of(module))):
        part.on_step(context)


def end_step(
    module: nn.Module, rgb: Float[Tensor, "rays 3"], target: Float[Tensor, "rays 3"], weight: Float[Tensor, "rays"]
) -> None:
    """Let every part within a module learn from what a step has seen."""
    for part in parts_of(module):
        part.after_step(rgb, target, weight)


def sample_counts(module: nn.Module) -> list[Tensor]:
    """Return the buffers in which a training step counts."""
    return [count for part in parts_of(module) for count in part.sample_counts()]


def buffers_to_average(module: nn.Module) -> list[Tensor]:
    """Return the buffers that hold means over rays."""
    return [mean for part in parts_of(module) for mean in part.buffers_to_average()]


def reset_statistics(module: nn.Module) -> None:
    """Let every part within a module forget what it counted."""
    for part in parts_of(module):
        part.reset_statistics()


def statistics(module: nn.Module) -> dict[str, float]:
    """Return what is worth watching while training."""
    return {name: value for part in parts_of(module) for name, value in part.statistics().items()}
