"""A method as named levels of (sampler, field): each level samples where the one before saw something."""

from abc import abstractmethod
from typing import Any, cast

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils import get_total_norm

from nerf_lightning.fields.base import Field
from nerf_lightning.geometry.contracted import Contracted
from nerf_lightning.products import Products
from nerf_lightning.randomness import RayRandom
from nerf_lightning.rendering.quadrature import composite
from nerf_lightning.samplers.base import AnySampler, Sampler
from nerf_lightning.types.rays import RayBundle
from nerf_lightning.types.renderings import DenseRendering, FieldOutput, Rendering
from nerf_lightning.types.scene import Scene


class Level(nn.Module):
    """The contract of a level: one round of sampling and rendering."""

    sampler: AnySampler
    field: Field
    has_color = True
    """Whether its rendering is a picture."""

    sampler_kind: type[AnySampler] = AnySampler
    """What it can sample with."""

    has_static_shapes: bool = True
    """False where what is computed depends on how much is found along the rays; compilers like XLA's refuse that."""

    def __init__(self, sampler: AnySampler, field: Field):
        super().__init__()
        if not isinstance(sampler, self.sampler_kind):
            raise ValueError(
                f"{type(self).__name__} samples with {self.sampler_kind.__name__} or what follows it, and "
                f"{type(sampler).__name__} does not: choose another sampler, or a model with another level"
            )
        self.sampler = sampler
        self.field = field

    @abstractmethod
    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        history: list[Any],
        random: RayRandom | None,
    ) -> Rendering:
        """Render rays; `history` is what the earlier levels saw, `random` is None outside training."""

    @abstractmethod
    def points_per_ray(self, before: float, training: bool) -> float:
        """Return how many points a ray sends through the field at once, given how many the level before had."""

    def place(self, scene: Scene) -> None:
        """Take note of where the scene's content lies, once, before training; a checkpoint carries it."""
        self.field.place(scene)
        self.sampler.place(scene)

    def density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density per unit length, as rendering sees it."""
        return self.field.density(positions).float()

    def counts(self) -> list[Tensor]:
        """Return the buffers in which a training step counts, to put them back where a step is repeated."""
        return []

    def measurements(self) -> list[Tensor]:
        """Return the buffers that hold means over rays, which the processes of a run must agree on."""
        return []

    def compile_field(self) -> bool:
        """Compile the field where its shapes do not depend on the data; tell whether it was."""
        return False

    def update(self, step: int, key: int) -> None:
        """Do what is done between steps of training: `step` steps have been taken, `key` is the next one's."""

    def statistics(self) -> dict[str, float]:
        """Return what is worth watching while training."""
        return {}

    def forget_measurements(self) -> None:
        """Forget what was counted while rendering."""

    def reset_parameters(self) -> None:
        """Draw every parameter anew from torch's generator, and forget what was learnt otherwise."""
        self.field.reset_parameters()


class DenseLevel(Level):
    """A level in which every ray has the same number of samples."""

    sampler: Sampler
    sampler_kind = Sampler

    def points_per_ray(self, before: float, training: bool) -> float:
        """As the sampler says."""
        return float(self.sampler.num_samples_after(int(before)))

    def compile_field(self) -> bool:
        """Compile the field, for static shapes: dynamic ones may be specialised otherwise after a resume."""
        if self.field.compiles:
            self.field.compile(dynamic=False)
        return self.field.compiles

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        history: list[DenseRendering],
        random: RayRandom | None,
    ) -> DenseRendering:
        """Sample, ask the field at the midpoints, composite."""
        samples = self.sampler(rays, history, random)
        along = samples.midpoints[..., None] * rays.directions[..., None, :]
        output = self.ask(rays.origins[..., None, :] + along, rays.view_directions[..., None, :], random)
        return composite(output, samples, rays, background)

    def ask(
        self,
        positions: Float[Tensor, "*rays samples 3"],
        directions: Float[Tensor, "*rays 1 3"],
        random: RayRandom | None,
    ) -> FieldOutput:
        """Return what the field says of the samples."""
        return self.field(positions, directions, random)


class RadianceModel(nn.Module):
    """The original NeRF is two levels, coarse (stratified) and fine (importance); the last one is the picture.

    Args:
        levels: name -> level, in order.
    """

    def __init__(self, levels: dict[str, Level]):
        super().__init__()
        self.levels = nn.ModuleDict(levels)
        self.most_rays: int | None = None
        """So many rays at once have found room in memory while rendering; None: no more were tried in vain."""
        self.points_per_ray(training=False)  # levels that do not fit each other are refused here
        self.register_load_state_dict_post_hook(_look_at_what_was_loaded)

    @property
    def level_names(self) -> tuple[str, ...]:
        """The levels' names, first to last."""
        return tuple(self.levels)

    @property
    def first_picture(self) -> int | None:
        """The number of the first level whose rendering is a picture, where it is not the last one."""
        numbers = [number for number, level in enumerate(self._in_order()) if level.has_color]
        return numbers[0] if len(numbers) > 1 else None

    @property
    def needs_whole_batch(self) -> bool:
        """Whether any field forbids tiles."""
        return any(level.field.needs_whole_batch for level in self._in_order())

    @property
    def has_static_shapes(self) -> bool:
        """Whether no level's shapes depend on what it finds."""
        return all(level.has_static_shapes for level in self._in_order())

    def points_per_ray(self, training: bool) -> float:
        """Return the largest number of points that a ray sends through any field at once: what tiles are cut by."""
        counts = [0.0]
        for level in self._in_order():
            counts.append(level.points_per_ray(counts[-1], training))
        return max(counts)

    @property
    def last(self) -> Level:
        """The level whose picture counts."""
        return self._in_order()[-1]

    def forward(
        self,
        rays: RayBundle,
        background: Float[Tensor, "*rays 3"] | None,
        random: RayRandom | None,
    ) -> list[Rendering]:
        """Render rays, first level first.

        Args:
            rays: unit directions, scene units.
            background: colour behind each ray; None closes the ray.
            random: the step's numbers for these rays; None for evaluation.
        """
        history: list[Rendering] = []
        for level in self._in_order():
            history.append(level(rays, background, history, random))
        return history

    def place(self, scene: Scene) -> None:
        """Tell the levels where the scene's content lies, once, before training."""
        for level in self._in_order():
            level.place(scene)

    def require_sound_state(self) -> None:
        """Look at what was loaded into the parts of the model, where they know what it can be.

        Raises:
            InputError: a part holds what it never can.
        """
        for part in self.modules():
            look = getattr(part, "require_sound_state", None)
            if part is not self and look is not None:
                look()

    def counts(self) -> list[Tensor]:
        """Return the buffers of all levels in which a training step counts."""
        return [count for level in self._in_order() for count in level.counts()]

    def measurements(self) -> list[Tensor]:
        """Return the buffers of all levels that hold means over rays."""
        return [measured for level in self._in_order() for measured in level.measurements()]

    def multiply_in(self, products: Products) -> None:
        """Set the precision of the products with the fields' weights; everything else is float32 always."""
        for level in self._in_order():
            level.field.multiply_in(products)

    def compile_fields(self) -> list[str]:
        """Compile the fields of levels with static shapes (torch.compile), and return the levels' names."""
        for module in self.modules():
            if isinstance(module, Contracted):
                module.is_on()  # read from its buffer in a compiled field, it would cut the program in pieces
        return [name for name, level in zip(self.levels, self._in_order(), strict=True) if level.compile_field()]

    def update(self, step: int, key: int) -> None:
        """Do what the levels do between steps of training."""
        for level in self._in_order():
            level.update(step, key)

    def statistics(self) -> dict[str, float]:
        """Return what is worth watching while training, of all levels."""
        return {name: value for level in self._in_order() for name, value in level.statistics().items()}

    def gradient_norms(self) -> dict[str, Float[Tensor, ""]]:
        """Return the Euclidean norm of the gradients of each level."""
        return {
            name: get_total_norm([parameter.grad for parameter in level.parameters() if parameter.grad is not None])
            for name, level in zip(self.levels, self._in_order(), strict=True)
        }

    def forget_measurements(self) -> None:
        """Forget what was counted while rendering."""
        for level in self._in_order():
            level.forget_measurements()

    def reset_parameters(self) -> None:
        """Draw every parameter anew from torch's generator."""
        for level in self._in_order():
            level.reset_parameters()

    def _in_order(self) -> list[Level]:
        return cast(list[Level], list(self.levels.values()))


def _look_at_what_was_loaded(model: RadianceModel, _: object) -> None:
    model.require_sound_state()
