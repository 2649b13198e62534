"""What tests on a GPU share: the device, a capture, and how they are tried where there is none.

`pytest -m gpu tests/gpu` on a machine with a GPU. NERF_LIGHTNING_GPU_TESTS_ON=cpu takes the CPU for the device, so that
the tests themselves can be tried; what only a GPU can be asked (synchronisation, copies, memory) is skipped there.
"""

import os

import numpy as np
import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.compute.devices import prepare_machine

CHOSEN = os.environ.get("NERF_LIGHTNING_GPU_TESTS_ON", "cuda")


@pytest.fixture(autouse=True)
def device():
    """The device that is tested."""
    if CHOSEN == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device, and torch sees none (NERF_LIGHTNING_GPU_TESTS_ON=cpu tries without one)")
    prepare_machine(None)
    return torch.device(CHOSEN)


@pytest.fixture
def cuda(device):
    """The device, where it is a GPU: for what cannot be asked of a CPU."""
    if device.type != "cuda":
        pytest.skip("only a GPU can be asked this")
    return device


@pytest.fixture
def trainer(device):
    """The override that chooses the device."""
    return "trainer=gpu" if device.type == "cuda" else "trainer=cpu"


@pytest.fixture(scope="session")
def ball(tmp_path_factory):
    """The ball in front of black as an npz file."""
    path, scene = tmp_path_factory.mktemp("capture") / "ball.npz", ball_scene(10, 20)
    rgba = torch.stack([scene.pixels.view(view) for view in range(10)]).float() / 255
    poses = torch.eye(4).repeat(10, 1, 1)
    poses[:, :3] = scene.cameras.c2w
    np.savez(path, images=(rgba[..., :3] * rgba[..., 3:]).numpy(), poses=poses.numpy(), focal=32.0)
    return path
