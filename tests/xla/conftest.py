"""XLA's CPU device takes the TPU's place."""

import importlib.util
import os
import warnings

import pytest


@pytest.fixture(autouse=True)
def _xla_on_the_cpu(monkeypatch):
    if importlib.util.find_spec("torch_xla") is None:
        pytest.skip("torch_xla is not installed: make test-xla makes an environment that has it")
    os.environ["PJRT_DEVICE"] = "CPU"  # before the first import, and for good: XLA takes one device per process
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import torch_xla

        torch_xla.device()
    from support.xla_host import XLAHostAccelerator

    from nerf_lightning.compute import xla_device

    monkeypatch.setattr(xla_device, "ACCELERATOR", XLAHostAccelerator)
