"""What GPUs do with ragged samples, without one: a fixed capacity, no number read, nothing sent there within a step.

On the meta device nothing has a value, so whatever reads one is refused; and what goes from the host to it is seen.
"""

import pytest
import torch
from support.configs import composed
from support.scenes import ball_scene
from torch.utils._python_dispatch import TorchDispatchMode

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.kernels.backends import without
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.selftest.training import METHODS
from nerf_lightning.training.build_step import build_step
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.step import TrainStep

FIXED = "fast_small, fixed capacity"
STATIC = (
    "model.levels.fine.sampler._target_=support.static_models.StaticSampler",
    "+model.levels.fine.sampler.capacity=32768",
)
# fast_small asks how much it found, as the CPU does.
ON_DEVICES = [*(name for name in METHODS if name != "fast_small"), FIXED]
STEP = 3


@pytest.fixture(autouse=True)
def _samples_are_packed():
    """Without the CPU's kernels that render whole rays: GPUs have none."""
    with without("render.cpu", "render.gradients"):
        yield


class FromTheHost(TorchDispatchMode):
    """Write down what goes from the host to the device."""

    def __init__(self):
        super().__init__()
        self.seen: list[str] = []

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        out = operation(*args, **(kwargs or {}))
        given = {x.device.type for x in args if isinstance(x, torch.Tensor) and x.dim()}
        if isinstance(out, torch.Tensor) and out.device.type == "meta" and "cpu" in given:
            self.seen.append(str(operation))
        return out


def a_step(name: str, scene, progress: Progress, loss=None) -> TrainStep:
    changes = [*METHODS[name.partition(",")[0]], *(STATIC if name == FIXED else ())]
    if name == "nerf_tiny":
        changes.append("optimizer.fused=false")  # torch's fused Adam does not know the device
    config = composed("train", f"model={name.partition(',')[0]}", *changes)
    settings = TrainerSettings(max_steps=100, accelerator="cpu", precision="32-true")
    step = build_step(config, settings, scene, progress, loss=loss)
    step.num_steps = 100
    return step


def sent_within_a_step(name, monkeypatch, loss=None):
    scene, progress = ball_scene(num_views=8, size=16, background="random"), Progress()
    loader, step = RayBatches(scene, progress, 0, 64), a_step(name, scene, progress, loss)
    # What is read once in a run (switches, lattices) or at each update of the grid is read on the host.
    step(loader.at(0, 0), step.new_optimizer())
    optimizer = step.to(torch.device("meta")).new_optimizer()
    step.guard.counts, step.guard.place = None, None
    batch, make, made = loader.at(0, 0).to("meta"), torch.tensor, []

    def tensor(*given, **options):
        made.append(str(options.get("device", "cpu")))
        return make(*given, **options)

    for progress.step in (STEP, STEP + 1):  # kept numbers are sent in the first
        made.clear()
        with FromTheHost() as watch, monkeypatch.context() as patch:
            patch.setattr(torch, "tensor", tensor)
            step(batch, optimizer)
    return watch.seen + [device for device in made if "meta" in device]


@pytest.mark.parametrize("name", ON_DEVICES)
def test_a_step_reads_no_number_and_sends_nothing_to_the_device(name, monkeypatch):
    assert sent_within_a_step(name, monkeypatch) == []


class Planted(MeanSquaredError):
    def __init__(self, fault):
        super().__init__()
        self.fault = fault

    def forward(self, renderings, target):
        self.fault(renderings[-1].opacity)
        return super().forward(renderings, target)


@pytest.mark.parametrize(
    "fault",
    [
        lambda opacity: torch.arange(3.0).to(opacity.device),
        lambda opacity: torch.tensor([1.0, 2.0], device=opacity.device),
    ],
)
def test_what_is_sent_there_is_noticed(fault, monkeypatch):
    assert sent_within_a_step(FIXED, monkeypatch, Planted(fault)) != []


@pytest.mark.parametrize("fault", [lambda opacity: opacity.mean().item(), lambda opacity: opacity.nonzero()])
def test_what_is_read_there_is_refused(fault, monkeypatch):
    with pytest.raises((RuntimeError, NotImplementedError), match=r"[Mm]eta"):
        sent_within_a_step(FIXED, monkeypatch, Planted(fault))


def test_with_room_for_all_samples_the_capacity_changes_nothing_but_rounding():
    losses, dropped = [], []
    for name in ("fast_small", FIXED):
        scene, progress = ball_scene(num_views=8, size=16, background="random"), Progress()
        step, loader = a_step(name, scene, progress), RayBatches(scene, progress, 0, 64)
        optimizer = step.new_optimizer()
        for _ in range(20):
            seen = step(loader.at(0, progress.rays_seen), optimizer)
        losses.append(seen.losses)
        dropped.append(step.model.statistics()["train/dropped_samples"])
    torch.testing.assert_close(losses[0], losses[1], rtol=1e-3, atol=0)
    assert dropped == [0, 0]


def test_without_room_samples_are_dropped_and_counted():
    scene, progress = ball_scene(num_views=8, size=16, background="random"), Progress()
    step = a_step(FIXED, scene, progress)
    step.model.last.sampler.capacity = 500
    loader, optimizer = RayBatches(scene, progress, 0, 64), step.new_optimizer()
    for _ in range(3):
        step(loader.at(0, progress.rays_seen), optimizer)
    assert step.model.statistics()["train/dropped_samples"] > 500
    assert step.guard.skipped == 0
