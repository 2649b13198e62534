"""The contract of a model: exactly what training, bench, exporters and the viewer need."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.photographs import photographs_of
from nerf_lightning.nerf.models.ray_generator import Subpixels
from nerf_lightning.nerf.part import Part, parts_of
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.types.photographs import Photographs
from nerf_lightning.nerf.types.rays import Points, RayBundle
from nerf_lightning.nerf.types.renderings import FieldOutput, Rendering
from nerf_lightning.nerf.types.scene import Background, Scene

Baselines = Callable[[Scene, list[int], Background, int], dict[str, Any]]


class Model(Part, ABC):
    """Render rays in one round, or in several that build on each other; the last one's picture counts."""

    has_static_shapes: bool = True
    """False if shapes depend on what is found along the rays; compilers such as XLA's refuse that."""
    needs_photographs: bool = False
    """True if it renders a scene from photographs: `set_source_images` is called before the first rays."""
    baselines: Baselines | None = None
    """Returns the mean PSNR (dB) of views rendered from a number of photographs without the model, for each method."""

    def __init__(self) -> None:
        super().__init__()
        self.subpixels = Subpixels()
        """Number of rays through each pixel, in training and in pictures."""
        self.most_rays: int | None = None
        """Number of rays at once that rendering has lowered to after running out of memory; None: it has not."""
        self.register_load_state_dict_post_hook(_look_at_what_was_loaded)

    @property
    @abstractmethod
    def level_names(self) -> tuple[str, ...]:
        """The names of the rounds, first to last."""

    @property
    def first_picture(self) -> int | None:
        """The index of the first round whose rendering is a picture, if that is not the last one."""
        return None

    @abstractmethod
    def forward(
        self, rays: RayBundle, background: Float[Tensor, "*rays 3"] | None, random: RayRandom | None
    ) -> list[Rendering]:
        """Render rays, one rendering for each round, first to last.

        Args:
            rays: unit directions, scene units.
            background: color behind each ray; None closes the ray.
            random: the step's numbers for these rays; None for evaluation.
        """

    def takes_whole_rays(self, device: torch.device, training: bool, learns_cameras: bool = False) -> bool:
        """Return whether kernels process whole rays and share them among threads, so that tiles may be large.

        Args:
            device: device of the parameters.
            training: whether gradients follow.
            learns_cameras: whether gradients of rays are needed, too.
        """
        return False

    @abstractmethod
    def points_per_ray(self, training: bool) -> float:
        """Return the largest number of points that a ray sends through any field at once: it determines the tiles."""

    def set_source_images(self, photographs: Photographs) -> None:
        """Set the photographs that rays are rendered from, replacing earlier ones; most models need none.

        They are not part of the model's state: no checkpoint contains them.
        """

    def rounds(self) -> dict[str, nn.Module]:
        """Return the module that learns in each round, by name; the norms of its gradients are logged."""
        return {self.level_names[-1]: self}

    def kernels(self) -> tuple[str, ...]:
        """Return the modules of `nerf.kernels` that training uses on a CPU, to be compiled ahead of the first step."""
        return ()

    def compile_fields(self) -> list[str]:
        """Compile the fields of rounds with static shapes (torch.compile), and return the rounds' names."""
        return []


class PointField(Model):
    """A model of one scene with density and color at single points, which exporters need."""

    @abstractmethod
    def density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density per unit length, as rays of the last level find it."""

    @abstractmethod
    def query(self, points: Points) -> FieldOutput:
        """Return the output of the last level's field at points."""


def point_field(model: Model) -> PointField:
    """Return the model, if it has density and color at points.

    Raises:
        InputError: it renders only rays.
    """
    if isinstance(model, PointField):
        return model
    raise InputError(
        f"{type(model).__name__} renders rays and has neither density nor color at points, so neither surfaces nor "
        "volumes can be exported. nerf render films it; for the others train a model of the scene, such as model=fast."
    )


def _look_at_what_was_loaded(model: Model, _: Any) -> None:
    """Let the parts of a model check their loaded state.

    Raises:
        InputError: a part's state is invalid.
    """
    for part in parts_of(model):
        part.validate_state()


def show_photographs(model: Model, scene: Scene) -> None:
    """Give a model the photographs that it renders a scene from, if it needs any.

    Raises:
        InputError: there are too few, or the model cannot use them.
    """
    if model.needs_photographs:
        model.set_source_images(photographs_of(scene, scene.sources))
