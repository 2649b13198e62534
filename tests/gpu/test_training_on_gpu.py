"""Training on the GPU: every model yaml follows the CPU, every precision learns, compiled fields are the same."""

import pytest
import torch
from support.configs import options
from support.gpu_training import step_by_step
from support.tape import replay_steps

from nerf_lightning.nerf.kernels.backends import CPU_BACKENDS, without
from nerf_lightning.training.gradients.recorded import CudaGraphs

training = pytest.importorskip("nerf_lightning.extensions.selftest.training")
check = pytest.importorskip("nerf_lightning.extensions.selftest.check")
pytestmark = [pytest.mark.gpu, pytest.mark.slow]
STEPS, TILE_POINTS = 50, 8192
CPU = torch.device("cpu")
# Of the difference that another order of sums makes on the CPU: how much more a GPU's may make, which adds in another
# order in each run, and fuses products with sums.
MORE = 30.0
LEAST = 1e-4  # relative; the order of sums of a step's some ten thousand samples, 2^-24 each, at worst: 6e-4


def losses(model, device, tile_points=None):
    run = step_by_step(model, device, tile_points=tile_points)
    for _ in range(STEPS):
        run.step()
    assert run.training.guard.skipped == 0
    return run.all_losses()


@pytest.mark.parametrize("model", options("model"))
def test_every_model_follows_the_cpu(model, device):
    """For 50 steps, within thirty times what another order of sums does to the CPU's own losses up to that step."""
    expected = losses(model, CPU)
    with without(*CPU_BACKENDS):
        otherwise = losses(model, CPU, TILE_POINTS)
    found = losses(model, device, TILE_POINTS)
    apart = ((otherwise - expected).abs() / expected).cummax(0).values
    bound = MORE * apart.clamp(min=LEAST)
    gone = (found - expected).abs() / expected
    assert bool((gone <= bound).all()), f"apart by {gone.tolist()}, bound {bound.tolist()}"
    assert float(expected[-10:].mean()) < float(expected[:3].mean())


@pytest.mark.parametrize("matmul_precision", ["float32", "tf32", "bfloat16"])
@pytest.mark.parametrize("method", training.METHODS)
def test_every_precision_learns_what_the_cpu_learns(method, matmul_precision, device):
    chosen = training.checks(device, (matmul_precision,))
    rows = [check.carried_out(each) for each in chosen if each.name.startswith(f"{method}, {matmul_precision}: ")]
    assert [row.outcome for row in rows] == ["ok", "ok"], rows


# torch's, of itself, and of what checks types in tests.
@pytest.mark.filterwarnings("ignore:.*torch.jit.script_method.*:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:Dynamo does not know how to trace:UserWarning")
def test_compiled_fields_compute_the_same(cuda):
    made = training.Training("nerf_tiny", cuda, "float32", None)
    assert made.train_step.objective.model.compile_fields()
    apart = training.gradients_apart(made.gradients(), training.reference_gradients("nerf_tiny"))
    assert apart < check.gradient_bound("float32", training.LAYERS)


@pytest.mark.parametrize("model", ["fast", "fast_small", "fast_large"])
def test_replayed_steps_learn_what_steps_learn(model, cuda):
    """But for the order of sums, which a GPU leaves to chance."""
    runs = [step_by_step(model, cuda) for _ in range(2)]
    replay_steps(runs[1].training, CudaGraphs())
    for run in runs:
        for _ in range(STEPS):
            run.step()
    torch.testing.assert_close(runs[1].all_losses(), runs[0].all_losses(), rtol=1e-2, atol=0)


def test_tf32_is_really_used_and_float32_is_not_lowered(cuda):
    from nerf_lightning.nerf.matmul_precision import linear

    features, weight = torch.randn(512, 512, device=cuda), torch.randn(512, 512, device=cuda)
    exact = features.double() @ weight.double().t()
    errors = {p: float((linear(features, weight, None, p) - exact).norm() / exact.norm()) for p in ("float32", "tf32")}
    assert errors["float32"] < 1e-6
    assert 1e-5 < errors["tf32"] < 2e-3


def test_a_step_without_memory_is_repeated_in_smaller_tiles(cuda, caplog):
    torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(cuda).total_memory
    run = step_by_step("nerf", cuda, tile_points=1 << 20)
    run.step()
    torch.cuda.empty_cache()
    torch.cuda.set_per_process_memory_fraction((torch.cuda.memory_reserved() + 60_000_000) / total)
    try:
        for _ in range(2):
            run.step()
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)
    assert "out of memory: reducing tiles" in caplog.text
    assert bool(run.all_losses().isfinite().all())


def test_memory_does_not_grow_from_step_to_step(cuda):
    run = step_by_step("fast_small", cuda)
    held = []
    for number in range(60):
        run.step()
        run.losses.clear()
        if number % 20 == 19:
            held.append(torch.cuda.memory_allocated())
    assert max(held[1:]) - held[0] < 1_000_000, held
