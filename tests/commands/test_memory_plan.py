"""The memory plan against the memory that a run really takes, measured in a process of its own."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

MEASURE = """
import ctypes, json, sys

sys.path.insert(0, sys.argv[1])
import torch
from configs import composed
from scenes import ball_scene

from nerf_lightning.commands.build import build, build_system
from nerf_lightning.commands.memory_trial import try_out
from nerf_lightning.data.ray_batches import Progress
from nerf_lightning.evaluation.metrics import image_metrics
from nerf_lightning.models.pictures import render_picture

TILE = int(sys.argv[3])


def status(name):
    with open("/proc/self/status") as file:
        return 1024 * int(next(line for line in file if line.startswith(name)).split()[1])


def most(work):
    "Bytes that the work adds to what is there."
    ctypes.CDLL("libc.so.6").malloc_trim(0)  # what was freed before would be taken again
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")  # the peak is what there is now
    before = status("VmRSS")
    work()
    return status("VmHWM") - before


def built():
    progress = Progress()
    system = build_system(config, settings, scene, progress, 10, {})
    system.initialize()
    system.tile_points = TILE
    optimizer = system.configure_optimizers()
    system.optimizers, system.manual_backward = lambda: optimizer, lambda loss: loss.backward()
    return system, build(config.data)(scene=scene, progress=progress, seed=0, num_steps=10).batches


def warm(system, batches):
    "Load libraries and kernels, which are in no plan."
    few = batches.at(0, 0)[:8]
    system.accumulate_gradients(few, lambda loss: loss.backward())
    with settings.inference():
        system.model(few.rays, None, None)
        image_metrics(torch.rand(16, 16, 3), torch.rand(16, 16, 3))
    system.forget_measurements()
    system.learn_points_per_ray()


def train():
    for _ in range(2):
        batches.progress.batch_rays = batches.progress.largest_batch
        with settings.autocast():
            system.training_step(batches.at(0, batches.progress.rays_seen), 0)


def evaluate():
    with settings.inference():
        picture = render_picture(system.model, scene.cameras, 0, scene.near, scene.far, "white", TILE)
        image_metrics(picture.rgb, picture.rgb)


config = composed("train", f"model={sys.argv[2]}", "trainer.accelerator=cpu", "trainer.num_threads=1", *sys.argv[4:])
settings = build(config.trainer)
settings.prepare_machine()
scene = ball_scene(num_views=6, size=400, background="random")
system, batches = built()
warm(system, batches)
measured = [most(evaluate), most(train)]
trial = try_out(settings, *built(), TILE)
print(json.dumps([measured, [trial.picture, trial.gradients + trial.optimizer + trial.batch + trial.activations]]))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of the resident memory is read from /proc")
@pytest.mark.parametrize(
    ("model", "tile", "overrides"),
    [
        ("nerf_tiny", 131_072, ["data.batch_rays=4096"]),
        ("fast_small", 131_072, []),
        ("fast_proposal", 131_072, []),
    ],
)
def test_the_plan_is_right_to_a_fifth(model, tile, overrides):
    tests = str(Path(__file__).parents[1])
    command = [sys.executable, "-c", MEASURE, tests, model, str(tile), *overrides]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    measured, planned = json.loads(run.stdout.splitlines()[-1])
    for what, ours, theirs in zip(("picture", "step"), planned, measured, strict=True):
        print(f"{model}, {what}: planned {ours / 1e6:.1f} MB, measured {theirs / 1e6:.1f} MB")
    assert all(0.8 * theirs < ours < 1.2 * theirs for ours, theirs in zip(planned, measured, strict=True))
