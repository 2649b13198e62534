"""How much memory a step and a picture take: a few small ones are tried and counted, and scaled up.

What a step holds is linear in the rays of the batch and in those of a tile, and what a picture holds is linear in its
pixels, where it has more than a chunk of them, and in the rays of a tile, so a few trials say all. A sum over the
outputs of all layers, with gradients and the optimizer's state, is 0.6 of that for `fast_small` and 2.1 for `nerf`.
"""

import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from nerf_lightning.compute.machine import torch_threads
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.evaluation.metrics import image_metrics
from nerf_lightning.nerf.encoders.base import matrices_of
from nerf_lightning.nerf.kernels.threads import threads_on
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ragged_level import average_counts
from nerf_lightning.nerf.models.render_image import Picture
from nerf_lightning.nerf.models.tiles import tile_rays_for
from nerf_lightning.nerf.part import reset_statistics
from nerf_lightning.nerf.rendering.background import background_colors
from nerf_lightning.nerf.row_chunks import CHUNK_PIXELS
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep
from nerf_lightning.visualization.pictures import mosaic, panels

# So many that rays of different lengths make a mean, and so few that it takes a second at most.
TRIAL_POINTS, FEWEST_RAYS = 2048, 4
TRIAL_SIDE = 512
EXAMPLE = 1024


@dataclass(frozen=True)
class Trial:
    """Bytes of a run on its device."""

    gradients: int
    optimizer: int
    """What the optimizer remembers."""
    batch: int
    """What grows with the rays of a step."""
    activations: int
    """What grows with the rays of a tile, and temporary copies of gradients."""
    picture: int
    """Rendering the largest picture, or measuring and showing it."""


def try_out(settings: TrainerSettings, train_step: TrainStep, batches: RayBatches, tile: int | None) -> Trial:
    """Return what the run will hold, by trials that leave nothing behind; a `tile` of None: whole batches."""
    train_step.objective.to(settings.device)
    trainable = [parameter for parameter in train_step.objective.model.parameters() if parameter.requires_grad]
    gradients = sum(parameter.nbytes for parameter in trainable)
    beside = threads_on(settings.device)
    # Tiles go one after the other: what other threads allocate is not seen, and is counted by their number.
    with _untouched(train_step), torch_threads(1):
        batch, activations = _step(settings, train_step, batches, tile, gradients, beside)
        picture = _picture(settings, train_step, batches, tile, beside)
    return Trial(gradients, _optimizer_bytes(train_step, trainable), batch, activations, picture)


@contextmanager
def _untouched(train_step: TrainStep) -> Iterator[None]:
    """Put everything back that trial steps change; no trial changes weights."""
    buffers = list(train_step.objective.model.buffers())
    former = [buffer.clone() for buffer in buffers]
    tile = train_step.tiles.points
    try:
        yield
    finally:
        train_step.tiles.points = tile
        train_step.objective.zero_grad(set_to_none=True)
        reset_statistics(train_step.objective)
        for buffer, value in zip(buffers, former, strict=True):
            buffer.copy_(value)


def _step(
    settings: TrainerSettings, train_step: TrainStep, batches: RayBatches, tile: int | None, gradients: int, beside: int
) -> tuple[int, int]:
    """Return what grows with the batch, and what grows with the tiles, of which so many are beside each other."""
    model, optimizer = train_step.objective.model, train_step.new_optimizer()
    batch = batches.at(0, batches.crop_rays(0)).to(settings.device)
    num_rays = batch.num_rays

    def held(tile_rays: int, parts: int) -> int:
        points = model.points_per_ray(training=True)
        train_step.tiles.points = int((tile_rays + 0.5) * points)
        some = batch[torch.arange(parts * tile_rays, device=settings.device) % num_rays]

        def work() -> None:
            optimizer.zero_grad()
            train_step.gradients(some, train_step.key)

        model.zero_grad(set_to_none=True)
        return peak_bytes(work, settings.device)

    held(_few_rays(model, training=True), 1)  # compiles kernels
    average_counts(model)  # how many samples rays have is known from here on
    few = _few_rays(model, training=True)
    two, four, larger = held(few, 2), held(few, 4), held(2 * few, 2)
    per_batch_ray, per_tile_ray = (four - two) / (2 * few), (larger - four) / few
    copies = max(0.0, two - few * (2 * per_batch_ray + per_tile_ray) - gradients)
    tile_rays = num_rays if tile is None else min(num_rays, tile / model.points_per_ray(training=True))
    if tile is not None and beside > 1:  # each tile's gradients of the matrices are kept, and added up in order
        copies += num_rays / tile_rays * sum(matrix.nbytes for matrix in matrices_of(model))
        tile_rays = min(num_rays, beside * tile_rays)
    tensors = _tensors_in([batch.rgba, batch.weight, vars(batch.pixels)])
    loaded = sum(tensor.nbytes for tensor in tensors) * (2 if batches.prefetch_for is not None else 1)
    return int(loaded + num_rays * per_batch_ray), int(copies + tile_rays * per_tile_ray)


def _few_rays(model: Model, training: bool) -> int:
    return max(FEWEST_RAYS, int(TRIAL_POINTS / model.points_per_ray(training)))


def _picture(
    settings: TrainerSettings, train_step: TrainStep, batches: RayBatches, tile: int | None, beside: int
) -> int:
    """Return what the largest picture of the scene holds while it is rendered, or measured and shown."""
    model, device = train_step.objective.model, settings.device
    few = _few_rays(model, training=False)
    pixels = batches.at(0, batches.crop_rays(0)).pixels.to(device)

    def rendered(count: int) -> int:
        some = pixels[torch.arange(count, device=device) % pixels.view.numel()]
        with torch.no_grad():
            behind = background_colors(train_step.objective.background, count, device, None)
            return peak_bytes(lambda: model(train_step.objective.rays(some), behind, None), device)

    per_ray = (rendered(2 * few) - rendered(few)) / few
    num_pixels = int((batches.scene.pixels.width * batches.scene.pixels.height).max())
    tile_points = settings.inference_tile_points if tile is None else tile
    tile_rays = min(num_pixels, beside * tile_rays_for(model, tile_points))

    def held(height: int, work: Callable[[Picture], object]) -> int:
        def whole() -> None:
            depth = torch.zeros(height, width)
            rgb = torch.zeros(height, width, 3)
            first = None if model.first_picture is None else torch.zeros_like(rgb)
            work(Picture(rgb, depth, torch.zeros_like(depth), first))

        return peak_bytes(whole, device)

    def of_largest(work: Callable[[Picture], object]) -> float:
        """Beyond two chunks, bytes grow with the rows alone."""
        if height <= 3 * chunk:
            return float(held(height, work))
        two, three = held(2 * chunk, work), held(3 * chunk, work)
        return three + (three - two) * (height / chunk - 3)

    width = min(TRIAL_SIDE, num_pixels)
    height, chunk = -(-num_pixels // width), CHUNK_PIXELS // width
    return int(max(of_largest(lambda picture: None) + tile_rays * per_ray, of_largest(_measured_and_shown)))


def _measured_and_shown(picture: Picture) -> None:
    truth = torch.zeros_like(picture.rgb)
    image_metrics(picture.rgb, truth)
    mosaic(panels(truth, picture.rgb, 1.0 * picture.depth, picture.opacity))


def _optimizer_bytes(train_step: TrainStep, trainable: list[nn.Parameter]) -> int:
    """Return what the optimizer will remember: as much per weight as it does of a small example."""
    example = nn.Parameter(torch.zeros(EXAMPLE, device=trainable[0].device))
    optimizer = train_step.build_optimizer([{"params": [example]}])
    example.grad = torch.zeros_like(example)
    optimizer.step()
    kept = sum(value.numel() for value in optimizer.state[example].values() if isinstance(value, Tensor))
    return kept // EXAMPLE * sum(parameter.nbytes for parameter in trainable)


class PeakBytes(TorchDispatchMode):
    """Watch what is allocated under it on a kind of device, and freed again; what was there before does not count."""

    def __init__(self, device_type: str):
        super().__init__()
        self.device_type = device_type
        self.held, self.most = 0, 0
        self.watched: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation, and look at what came out."""
        kwargs = kwargs or {}
        out = func(*args, **kwargs)
        for tensor in _tensors_in(out):
            self._watch(tensor, (args, kwargs))
        return out

    def _watch(self, tensor: Tensor, taken: Any) -> None:
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key in self.watched or storage.device.type != self.device_type:
            return
        if any(key == each.untyped_storage()._cdata for each in _tensors_in(taken)):
            return  # a view of what was there before
        size = storage.nbytes()
        self.watched.add(key)
        self.held += size
        self.most = max(self.most, self.held)
        weakref.finalize(storage, self._forget, key, size)

    def _forget(self, key: int, size: int) -> None:
        self.watched.discard(key)
        self.held -= size


def peak_bytes(work: Callable[[], Any], device: torch.device) -> int:
    """Do the work and return the most bytes that it held on the device at once, beyond what was there before."""
    with PeakBytes(device.type) as counter:
        work()
    return counter.most


def _tensors_in(tree: Any) -> list[Tensor]:
    # What operations take and return is nested no deeper than lists; torch's own flattening takes longer.
    if isinstance(tree, Tensor):
        return [tree]
    if isinstance(tree, dict):
        tree = list(tree.values())
    return [tensor for part in tree for tensor in _tensors_in(part)] if isinstance(tree, (tuple, list)) else []
