"""Kernels compiled ahead: what a training takes, in several processes, once."""

import os
import subprocess
import sys

import pytest

from nerf_lightning.compute import compile_kernels
from nerf_lightning.nerf.kernels import ahead, backends
from nerf_lightning.nerf.kernels.backends import CPU_BACKENDS, KERNELS
from nerf_lightning.notebook.run import build_run

SMALL = ("scene=bricks", "scene.resolution=16", "scene.num_train=3", "scene.num_val=1", "scene.num_test=1")
IN_TWO = """
from nerf_lightning.nerf.kernels.ahead import compile_ahead, to_compile
modules = [f"nerf_lightning.nerf.kernels.{name}" for name in ("table_adam.cpu", "random.cpu")]
print(len(to_compile(modules)), len(list(compile_ahead([*modules, "no_such.module"], 2))), len(to_compile(modules)))
"""


@pytest.mark.parametrize("model", ["fast_small", "fast_proposal"])
def test_a_training_takes_no_kernels_but_those_that_its_model_names(model, monkeypatch):
    asked, found = set(), backends.backend
    monkeypatch.setattr(backends, "backend", lambda module: asked.add(module) or found(module))
    monkeypatch.setattr(compile_kernels, "to_compile", lambda modules: [])
    # In bfloat16, which few CPUs multiply, other kernels follow.
    run = build_run(*SMALL, f"model={model}", "data.batch_rays=64", "trainer.precision=32-true")
    list(run.steps(2))
    assert {f"{KERNELS}.mlp.cpu", f"{KERNELS}.table_adam.cpu"} <= asked
    assert asked <= {f"{KERNELS}.{name}" for name in run.system.model.kernels()}
    assert set(run.system.model.kernels()) <= set(CPU_BACKENDS)


@pytest.mark.minutes
def test_several_processes_compile_into_the_cache_and_none_that_fails_stops_the_others(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    tmp_path.chmod(0o700)
    done = subprocess.run([sys.executable, "-c", IN_TWO], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["2", "3", "0"]


def test_it_is_said_only_where_something_is_compiled(monkeypatch, caplog):
    caplog.set_level("INFO")
    monkeypatch.setattr(ahead, "backend", lambda module: None)
    monkeypatch.setattr(compile_kernels, "num_cores", lambda: 1)
    for missing in ([], ["a.cpu", "b.cpu"]):
        monkeypatch.setattr(compile_kernels, "to_compile", lambda modules, missing=missing: missing)
        compile_kernels.compile_kernels(["a.cpu", "b.cpu"])
        assert ("compiling kernels for this CPU, once" in caplog.text) == bool(missing)
