"""A step for compilers like XLA's, tried without one: on the meta device, where nothing has a value, only a shape.

There whatever reads a number or makes a shape of one is refused, and the operations of a step can be written down.
"""

import pytest
import torch
from support.scenes import ball_scene
from support.static_models import MODELS, fast_model, static_system
from torch.utils._python_dispatch import TorchDispatchMode

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.part import StepContext, begin_step
from nerf_lightning.nerf.types.progress import Progress


class Operations(TorchDispatchMode):
    """Write down each operation that makes or changes a tensor of the device, with its shapes."""

    def __init__(self):
        super().__init__()
        self.seen: list[tuple] = []

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        out = operation(*args, **(kwargs or {}))
        if isinstance(out, torch.Tensor) and out.device.type == "meta":
            shapes = tuple(tuple(x.shape) for x in args if isinstance(x, torch.Tensor))
            self.seen.append((str(operation), shapes, tuple(out.shape)))
        return out


def operations_of_steps(name, steps, model=None):
    scene, progress = ball_scene(num_views=8, size=16, background="random"), Progress()
    train_step = static_system(name, scene, progress, 100, model).train_step
    loader = RayBatches(scene, progress, 0, 64)
    # What is read once in a run (switches, the grid's content) is read on the host.
    begin_step(train_step.objective.model, StepContext(0.0, 4, 0))
    train_step.objective.model(train_step.objective.rays(loader.batch_at(0, 0).pixels), torch.zeros(64, 3), None)
    train_step.objective.to("meta")
    optimizer = train_step.new_optimizer()
    lists = []
    for progress.step in steps:
        with Operations() as operations:
            train_step(loader.batch_at(0, progress.rays_seen).to("meta"), optimizer)
        lists.append(operations.seen)
    return lists


@pytest.mark.parametrize("name", MODELS)
def test_a_step_reads_no_number_and_is_the_same_program_each_time(name):
    _, second, third, fourth = operations_of_steps(name, [1, 2, 3, 5])  # the optimizer's state is made in the first
    assert len(second) > 100
    assert second == third == fourth
    assert not [seen for seen in second if "searchsorted" in seen[0]]


def test_the_grid_is_updated_without_reading_a_number():
    plain, _, update, same_cells = operations_of_steps("fast_dense", [5, 8, 16, 24])
    assert len(update) > len(plain)
    assert update == same_cells


def test_the_packed_form_is_refused():
    with pytest.raises((RuntimeError, NotImplementedError), match="meta"):
        operations_of_steps("fast_dense", [2], model=fast_model(RaggedLevel))
