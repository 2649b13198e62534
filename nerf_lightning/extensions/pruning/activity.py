"""Activity of each neuron, at the points where rays of the training views evaluate a model's fields."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.fields.base import Field
from nerf_lightning.nerf.geometry.cameras import rays_through_pixels
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.tiles import weighted_renderings
from nerf_lightning.nerf.randomness import batch_random, fold
from nerf_lightning.nerf.types.rays import PixelIndex, Points, RayBundle
from nerf_lightning.nerf.types.scene import SceneRecord

NUM_RAYS = 2048


@torch.no_grad()
def mean_activity(
    model: Model, fields: Mapping[str, Field], scene: SceneRecord, key: int, tile_points: int
) -> dict[str, list[Float[Tensor, "neurons"]]]:
    """Return the mean magnitude of each neuron's activation, by field, layer by layer (`Field.hidden_layers`).

    Args:
        model: on the CPU, in evaluation mode.
        fields: the fields of the model to measure.
        scene: the source of the training views' rays.
        key: of the random numbers.
        tile_points: maximum number of points that go through a field at once.

    Raises:
        InputError: a field is never evaluated.
    """
    queries: list[tuple[str, Points]] = []
    sums: dict[str, list[Tensor]] = {}
    counts = dict.fromkeys(fields, 0)
    tiles = weighted_renderings(model, _rays(scene, key), scene.background, key, tile_points)
    while True:
        with _written_down(fields, queries):
            if next(tiles, None) is None:
                break
        for name, points in queries:
            found = [layer.abs().flatten(0, -2) for layer in fields[name].hidden_activations(points)]
            parts = [layer.sum(dim=0, dtype=torch.float64) for layer in found]
            counts[name] += found[0].shape[0]
            sums[name] = [a + b for a, b in zip(sums[name], parts, strict=True)] if name in sums else parts
        queries.clear()
    unasked = [name for name, count in counts.items() if not count]
    if unasked:
        raise InputError(
            f"No ray of the training views evaluates model.{unasked[0]} at any point, so its neurons' activity is "
            "unknown. Choose by=importance."
        )
    return {name: [layer / counts[name] for layer in layers] for name, layers in sums.items()}


@contextmanager
def _written_down(fields: Mapping[str, Field], queries: list[tuple[str, Points]]) -> Iterator[None]:
    """Record the points at which fields are evaluated, for density alone or color."""
    hooks = []
    for name, field in fields.items():

        def density(points: Points, name: str = name, original: Any = field.density) -> Any:
            queries.append((name, points))
            return original(points)

        def before(_: Any, inputs: tuple[Any, ...], name: str = name) -> None:
            queries.append((name, inputs[0]))

        field.density = density  # type: ignore[method-assign]
        hooks.append(field.register_forward_pre_hook(before))
    try:
        yield
    finally:
        for field, hook in zip(fields.values(), hooks, strict=True):
            del field.density
            hook.remove()


def _rays(scene: SceneRecord, key: int) -> RayBundle:
    """Return rays through uniformly drawn pixels of the training views."""
    views = torch.tensor(scene.splits["train"])
    draws = batch_random(fold(key, "activity"), NUM_RAYS).uniform("pixel", 3).double()
    view = views[(draws[:, 0] * views.numel()).long()]
    x, y = (draws[:, 1] * scene.cameras.width[view]).long(), (draws[:, 2] * scene.cameras.height[view]).long()
    return rays_through_pixels(scene.cameras, PixelIndex(view, x, y), scene.near, scene.far)
