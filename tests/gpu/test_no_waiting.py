"""Within a step the host never waits for the GPU: no synchronisation, no copy to the host.

What is read on the host, and when, by name: `RaggedLevel.on_step` every 16 steps (how many samples rays had, by which
the tiles of the next step are cut; at its first time, which cells there are), `MaskedLevel.on_step` at its first time,
`CollapseGuard` every 25 steps, `Monitor` every 50, `NanGuard` every 100.
"""

import warnings
from contextlib import contextmanager

import pytest
import torch
from lightning.pytorch import Callback
from support.configs import options
from support.gpu_training import default_callbacks, step_by_step
from support.scenes import ball_scene

from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.nerf.models.masked_level import MaskedLevel
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.system import RadianceFieldSystem

training = pytest.importorskip("nerf_lightning.extensions.selftest.training")
pytestmark = [
    pytest.mark.gpu,
    pytest.mark.filterwarnings("ignore:Synchronization debug mode", "ignore:Warning. Profiler clears events"),
]
STEPS = 104  # of a run, which is no short one to `Monitor` from 100 on
WARM = 2  # the optimizer's state, numbers kept on the device, compiled kernels


@contextmanager
def never_waiting(device):
    """Raise where the host waits for the device; where there is no GPU, do nothing."""
    if device.type != "cuda":
        yield
        return
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def updates(run) -> set[int]:
    """The steps in which a grid is updated, and read (one of `MaskedLevel` at its first time alone)."""
    levels = [level for level in run.training.objective.model.modules() if isinstance(level, RaggedLevel | MaskedLevel)]
    every = min((level.sampler.update_every for level in levels), default=1 << 30)
    return {1, *range(0, 1000, every)}


# Which photographs a step looks at, and how many, is known to the host alone.
NEVER_WAIT = [model for model in options("model") if not model.startswith("view_transformer")]


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
@pytest.mark.parametrize("model", NEVER_WAIT)
def test_no_step_waits(model, precision, device):
    """Making the batch from resident pixels included."""
    run = step_by_step(model, device, precision)
    for step in range(20):
        if step < WARM or step in updates(run):
            run.step()
        else:
            with never_waiting(device):
                run.step()
    assert bool(run.all_losses().isfinite().all())


@pytest.mark.parametrize("model", ["nerf_tiny", "fast_small", "fast_proposal"])
def test_nothing_is_copied_to_the_host_within_a_step(model, cuda):
    from torch.profiler import ProfilerActivity, profile

    run = step_by_step(model, cuda)
    for _ in range(3):
        run.step()
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as seen:
        for _ in range(8):
            run.step()
    names = [event.name for event in seen.events()]
    assert not [name for name in names if "DtoH" in name]
    # Only the numbers of the batch's pixels go there, by way of pinned memory.
    assert not [name for name in names if "HtoD" in name and "Pinned" not in name]


class Watch(Callback):
    """Write down how often the host waited, from the end of one step to the end of the next; to stand last."""

    def __init__(self, device):
        self.device, self.caught, self.waits = device, [], {}

    def on_train_start(self, trainer, pl_module):
        if self.device.type == "cuda":
            torch.cuda.set_sync_debug_mode("warn")

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        found = [str(each.message) for each in self.caught if "called a synchronizing" in str(each.message)]
        self.waits[trainer.global_step] = len(found)
        self.caught.clear()

    def on_train_end(self, trainer, pl_module):
        if self.device.type == "cuda":
            torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("method", training.METHODS)
@pytest.mark.parametrize("resident", [True, False])
def test_a_run_with_all_its_callbacks_waits_only_where_it_says_so(method, resident, device, tmp_path):
    train_step = step_by_step(method, torch.device("cpu"), "32-true", 8192, *training.METHODS[method]).training
    settings = TrainerSettings(
        max_steps=STEPS, accelerator="gpu" if device.type == "cuda" else "cpu", val_every_steps=STEPS
    )
    system = RadianceFieldSystem(train_step, {})
    settings.prepare(train_step.objective.model)
    watch = Watch(device)
    quiet = [each for each in default_callbacks() if type(each).__name__ in ("CollapseGuard", "NanGuard", "Monitor")]
    trainer = settings.build(tmp_path, STEPS, [*quiet, watch], [])
    budget = "auto" if resident else 0
    data = RayDataModule(
        ball_scene(10, 20, background="random"),
        train_step.progress,
        0,
        batch_rays=96,
        val_rays=96,
        device_budget=budget,
    )
    with warnings.catch_warnings(record=True) as watch.caught:
        warnings.simplefilter("always")
        trainer.fit(system, data)
    assert len(watch.waits) == STEPS
    # A grid is updated at the beginning of the step that makes these counts one more.
    named = {1, 2, *(step + 1 for step in range(0, STEPS, 8)), *range(0, STEPS, 16), *range(0, STEPS, 25), STEPS}
    waited = {step: count for step, count in watch.waits.items() if count and step not in named}
    assert not waited
    if device.type == "cuda":
        assert watch.waits[25], "the collapse guard reads the device there: the watch must have seen it"
