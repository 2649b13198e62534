"""The contract of a model: what training, bench, exporters and the viewer ask of it, and no more."""

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
from nerf_lightning.nerf.types.points import Points
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.renderings import FieldOutput, Rendering
from nerf_lightning.nerf.types.scene import Background, Scene

Baselines = Callable[[Scene, list[int], Background, int], dict[str, Any]]


class Model(Part, ABC):
    """Render rays, in one round or in several that build on each other; the last one's picture counts."""

    has_static_shapes: bool = True
    """False where what is computed depends on how much is found along the rays; compilers like XLA's refuse that."""
    needs_photographs: bool = False
    """True where it renders a scene from photographs: `set_source_images` is called before the first rays."""
    baselines: Baselines | None = None
    """Mean PSNR (dB) of views that are shown by so many photographs, without the model, for each way to do so."""

    def __init__(self) -> None:
        super().__init__()
        self.subpixels = Subpixels()
        """How many rays go through each pixel, in training and in pictures."""
        self.most_rays: int | None = None
        """So many rays at once have found room in memory while rendering; None: no more were tried in vain."""
        self.register_load_state_dict_post_hook(_look_at_what_was_loaded)

    @property
    @abstractmethod
    def level_names(self) -> tuple[str, ...]:
        """The names of the rounds, first to last."""

    @property
    def first_picture(self) -> int | None:
        """The number of the first round whose rendering is a picture, where that is not the last one."""
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
        """Return whether kernels take rays from end to end and share them out over threads, so that tiles may be large.

        Args:
            device: of the parameters.
            training: whether gradients follow.
            learns_cameras: whether gradients of rays are wanted, too.
        """
        return False

    @abstractmethod
    def points_per_ray(self, training: bool) -> float:
        """Return the largest number of points that a ray sends through any field at once: what tiles are cut by."""

    def set_source_images(self, photographs: Photographs) -> None:
        """Take the photographs that rays are rendered from, in the place of earlier ones; most models need none.

        They are no part of the model's state: no checkpoint carries them.
        """

    def rounds(self) -> dict[str, nn.Module]:
        """Return what learns in each round, by name: the norms of its gradients are logged."""
        return {self.level_names[-1]: self}

    def kernels(self) -> tuple[str, ...]:
        """Return the modules of `nerf.kernels` that training takes on a CPU, to be compiled ahead of the first step."""
        return ()

    def compile_fields(self) -> list[str]:
        """Compile the fields of rounds with static shapes (torch.compile), and return the rounds' names."""
        return []


class PointField(Model):
    """A model of one scene, which has density and color at points by themselves: exporters ask it for both."""

    @abstractmethod
    def density(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """Return the density per unit length, as the last level's rays find it."""

    @abstractmethod
    def query(self, points: Points) -> FieldOutput:
        """Return what the last level's field says of points."""


def point_field(model: Model) -> PointField:
    """Return a model that has density and color at points.

    Raises:
        InputError: it renders rays alone.
    """
    if isinstance(model, PointField):
        return model
    raise InputError(
        f"{type(model).__name__} renders rays and has neither density nor color at points, so neither surfaces nor "
        "volumes can be exported. nerf render films it; for the others train a model of the scene, such as model=fast."
    )


def _look_at_what_was_loaded(model: Model, _: Any) -> None:
    """Let the parts of a model look at what was loaded into them.

    Raises:
        InputError: a part holds what it never can.
    """
    for part in parts_of(model):
        part.validate_state()


def show_photographs(model: Model, scene: Scene) -> None:
    """Show a model the photographs that it renders a scene from, if it needs any.

    Raises:
        InputError: they are too few, or of a kind that the model cannot use.
    """
    if model.needs_photographs:
        model.set_source_images(photographs_of(scene, scene.sources))
