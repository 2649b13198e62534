"""`nerf bench`: the model, its data and its optimizer, ready for training and rendering, our way or plainly.

"Plain" is the same mathematics in a straightforward implementation: float32, whole batches, torch around the same hash
grid kernel, no screening of samples behind opaque ones.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import torch
from omegaconf import DictConfig

from nerf_lightning.config.instantiate import build
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.kernels.backends import without
from nerf_lightning.nerf.matmul_precision import set_precision
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.models.render_image import render_rays
from nerf_lightning.nerf.rendering.background import background_colors
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.rays import Batch
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.training.build_step import build_step
from nerf_lightning.training.fastest_tile import measured_tile
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep

# Without these, torch computes everything except hash grids, random numbers and histograms.
TWINS = (
    *("march.cpu", "ragged.cpu", "mlp.cpu", "table_adam.cpu", "render.cpu", "render.gradients"),
    *("march.cuda", "ragged.cuda", "mlp.cuda", "table_adam.cuda", "field.cuda", "render.cuda"),
)


@dataclass
class Bench:
    """What is measured, ready to run."""

    settings: TrainerSettings
    train_step: TrainStep
    data: RayDataModule
    optimizer: torch.optim.Optimizer
    plain_optimizer: torch.optim.Optimizer

    @property
    def batches(self) -> RayBatches:
        """The training rays."""
        return self.data.batches

    @cached_property
    def batch(self) -> Batch:
        """The batch for every kind, with the batch size of a trained model."""
        return self.batches.batch_at(0, self.batches.crop_rays(0)).to(self.settings.device)

    def train(self, steps: int) -> None:
        """Take steps on the one batch."""
        for _ in range(steps):
            self.train_on(self.batch)

    def train_on(self, batch: Batch) -> None:
        """Compute gradients and update; if training replays steps, take a whole one, of which the replay is most."""
        if self.train_step.gradients.replays:
            self.train_step(batch, self.optimizer)
        else:
            self._update(self.optimizer, lambda: self.train_step.gradients(batch, self.train_step.key))

    def train_one_by_one(self, steps: int) -> None:
        """Take steps on the one batch, without tiles as in a replay, launching kernels one by one."""
        self.train_step.tiles.points = None
        for _ in range(steps):
            self._update(self.optimizer, lambda: self.train_step.tiles(self.batch, key=0))
        self.train_step.tiles.points = self.settings.tile_points

    def train_plainly(self, steps: int) -> None:
        """Take steps on the one batch with the straightforward implementation."""
        with self._plainly():
            for _ in range(steps):
                self._update(self.plain_optimizer, lambda: self.train_step.tiles(self.batch, key=0))

    def _update(self, optimizer: torch.optim.Optimizer, gradients: Callable[[], object]) -> None:
        optimizer.zero_grad()
        gradients()
        optimizer.step()

    def take_step(self) -> None:
        """Take one step of training, including loading."""
        progress = self.batches.progress
        batch = self.batches.batch_at(progress.attempt, progress.rays_seen).to(self.settings.device)
        self.train_step(batch, self.optimizer)

    def render(self, num_rays: int, plain: bool = False) -> None:
        """Render rays of the one batch."""
        places = torch.arange(num_rays, device=self.settings.device) % self.batch.num_rays
        model, background = self.train_step.objective.model, self.train_step.objective.background
        with torch.no_grad():
            rays = self.train_step.objective.rays(self.batch.pixels[places])
            if not plain:  # like pictures
                render_rays(model, rays, background, self.settings.inference_tile_points)
                return
            with self._plainly():
                model(rays, background_colors(background, num_rays, rays.near.device, random=None), random=None)

    @contextmanager
    def _plainly(self) -> Iterator[None]:
        model = self.train_step.objective.model
        samplers = [level.sampler for level in model.modules() if isinstance(level, RaggedLevel)]
        former = [sampler.opaque_below for sampler in samplers]
        self.train_step.tiles.points = None
        set_precision(model, "float32")
        for sampler in samplers:
            sampler.opaque_below = 0.0
        self._release_gradients()
        with without(*TWINS):
            yield
        self.settings.prepare(model)
        self.train_step.tiles.points = self.settings.tile_points
        for sampler, value in zip(samplers, former, strict=True):
            sampler.opaque_below = value
        self._release_gradients()

    def _release_gradients(self) -> None:
        for parameter in self.train_step.objective.model.parameters():
            parameter.grad = None
            parameter.grad_in_place = False  # type: ignore[attr-defined]


def prepare(config: DictConfig, scene: Scene) -> Bench:
    """Build what is measured."""
    settings: TrainerSettings = build(config.trainer)
    settings.prepare_machine()
    progress = Progress()
    train_step = build_step(config, settings, scene, progress)
    train_step.objective.to(settings.device)
    train_step.num_steps = max(1, config.warmup_steps)
    settings.prepare(train_step.objective.model)
    data = build(config.data)(scene=scene, progress=progress, seed=config.seed, patch=train_step.objective.loss.patch)
    data.settle(settings.device)
    train_step.begin_recording()
    if not train_step.gradients.replays and settings.measures_tile:
        settings.tile_points = train_step.tiles.points = measured_tile(settings, train_step, data.batches)[0]
    optimizer, plain = train_step.new_optimizer(), torch.optim.Adam(train_step.objective.model.parameters(), lr=1e-6)
    return Bench(settings, train_step, data, optimizer, plain)
