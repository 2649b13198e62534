"""Small trainings: what is wrong on purpose is noticed, by the gradients or by the PSNR."""

import subprocess
import sys

import pytest
import torch
from support.self_tested import a_place, rows_of

from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.hash_grid import cpu as hash_grid_cpu
from nerf_lightning.nerf.kernels.mlp import cpu as mlp_cpu
from nerf_lightning.nerf.products import Linear
from nerf_lightning.selftest.checks import training
from nerf_lightning.selftest.models import METHODS


@pytest.mark.parametrize("method", METHODS)
def test_gradients_of_every_kind_of_model_are_right(method):
    rows = rows_of(training.checks(a_place()), f"{method}, float32: gradients", f"{method}, bfloat16: gradients")
    assert [row.outcome for row in rows] == ["ok", "ok"]
    assert 0 < rows[0].difference < 1e-5
    assert rows[1].difference > 1e-3


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", [name for name in METHODS if "capacity" not in name])
def test_whole_trainings_learn_and_end_alike(method):
    rows = rows_of(training.checks(a_place()), f"{method}, float32: PSNR", f"{method}, bfloat16: PSNR")
    assert [row.outcome for row in rows] == ["ok", "ok"]
    assert training._reference_psnr(method) > 13  # white alone gives 7 dB


def test_a_kernel_that_is_off_by_one_percent_shows_in_the_gradients(monkeypatch):
    right = hash_grid_cpu.forward
    monkeypatch.setattr(hash_grid_cpu, "forward", lambda *given: 1.01 * right(*given))
    words = [f"{method}, float32: gradients" for method in METHODS if "hash" in method]
    assert [row.outcome for row in rows_of(training.checks(a_place()), *words)] == ["wrong"] * 4


def test_a_precision_that_is_lowered_shows_in_the_gradients(monkeypatch):
    training._reference_gradients("coarse and fine MLP")  # kept from here on
    right = Linear.forward
    monkeypatch.setattr(Linear, "forward", lambda layer, features: right(layer, features.bfloat16().float()))
    rows = rows_of(training.checks(a_place()), "coarse and fine MLP, float32: gradients")
    assert rows[0].outcome == "wrong"


@pytest.mark.slow
def test_an_optimizer_that_is_wrong_shows_in_the_psnr(monkeypatch):
    from nerf_lightning.nerf.kernels.adam import cpu as adam_cpu

    training._reference_psnr("packed hash grid")
    right = adam_cpu.adam_step

    def sluggish(parameter, grad, first, second, step_size, *rest):
        right(parameter, grad, first, second, 0.9 * step_size, *rest)

    monkeypatch.setattr(adam_cpu, "adam_step", sluggish)
    assert rows_of(training.checks(a_place()), "packed hash grid, float32: PSNR")[0].outcome == "wrong"


def test_gradients_that_are_missing_are_named():
    with pytest.raises(ValueError, match="gradients of \\['b'\\]"):
        training.gradients_apart({"a": torch.ones(1)}, {"a": torch.ones(1), "b": torch.ones(1)})


def test_what_only_a_gpu_does_is_not_run_here_and_says_so():
    rows = rows_of(training.checks(a_place()), "compiled", "pixels on the device")
    assert [row.outcome for row in rows] == ["not run"] * 2
    assert "trainer.compile=true" in rows[0].note


def test_without_a_compiler_torch_compile_is_not_run(monkeypatch):
    monkeypatch.setattr(backends.shutil, "which", lambda name: None)
    (row,) = rows_of(training.checks(a_place(compiles=True)), "compiled")
    assert (row.outcome, row.note) == ("not run", "there is no C++ compiler, which torch.compile needs on the CPU")


COMPILED = """
import torch
from nerf_lightning.nerf.kernels import backends
from nerf_lightning.selftest.checks import training

compile_it = torch.nn.Module.compile
torch.nn.Module.compile = lambda field, **how: compile_it(field, backend="eager", **how)
for products in ("float32", "tf32", "bfloat16"):
    torch._dynamo.reset()
    made = training.Training("coarse and fine MLP", training.CPU, products, None)
    made.system.model.compile_fields()
    made.gradients()
print(dict(torch._dynamo.utils.counters["graph_break"]))
"""


@pytest.mark.exhaustive
def test_a_compiled_field_is_one_program():
    """In a process without the checks of shapes, which torch.compile does not look into."""
    result = subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True)
    assert result.stdout == "{}\n", result.stdout + result.stderr[-2000:]


def test_the_perceptrons_of_a_training_are_the_kernels(monkeypatch):
    right = mlp_cpu.forward

    def wrong(*given, **options):
        out, kept = right(*given, **options)
        return 1.01 * out, kept

    monkeypatch.setattr(mlp_cpu, "forward", wrong)
    assert rows_of(training.checks(a_place()), "masked hash grid, float32: gradients")[0].outcome == "wrong"
