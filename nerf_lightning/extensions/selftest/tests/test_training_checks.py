"""Small trainings: what is wrong on purpose is noticed, by the gradients or by the PSNR."""

import pytest
import torch

from nerf_lightning.extensions.selftest import training
from nerf_lightning.extensions.selftest.check import carried_out
from nerf_lightning.extensions.selftest.training import METHODS
from nerf_lightning.nerf.kernels.hash_grid import cpu as hash_grid_cpu
from nerf_lightning.nerf.kernels.mlp import cpu as mlp_cpu
from nerf_lightning.nerf.kernels.render import dense as dense_rays_cpu
from nerf_lightning.nerf.kernels.table_adam import cpu as adam_cpu
from nerf_lightning.nerf.matmul_precision import Linear

CHECKS = {check.name: check for check in training.checks(training.CPU, ("float32", "bfloat16"))}
PSNR = f"PSNR after {training.STEPS} steps, dB"


@pytest.mark.parametrize("method", METHODS)
def test_gradients_of_every_kind_of_model_are_right(method):
    rows = [carried_out(CHECKS[f"{method}, {each}: gradients of a batch"]) for each in ("float32", "bfloat16")]
    assert [row.outcome for row in rows] == ["ok", "ok"]
    assert 0 < rows[0].difference < 1e-5
    assert rows[1].difference > 1e-3


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", METHODS)
def test_whole_trainings_learn_and_end_alike(method):
    assert {carried_out(CHECKS[f"{method}, {each}: {PSNR}"]).outcome for each in ("float32", "bfloat16")} == {"ok"}
    assert training.reference_psnr(method) > 13  # white alone gives 7 dB


def off_by_one_percent(right):
    def wrong(*given, **options):
        out = right(*given, **options)
        return (1.01 * out[0], *out[1:]) if isinstance(out, tuple) else 1.01 * out

    return wrong


def lowered(right):
    return lambda layer, features: right(layer, features.bfloat16().float())


MISTAKES = [
    ("fast_dense", hash_grid_cpu, "forward", off_by_one_percent),
    ("fast_proposal", dense_rays_cpu, "render", off_by_one_percent),
    ("nerf_tiny", Linear, "forward", lowered),
    ("fast_dense", mlp_cpu, "forward", off_by_one_percent),
]


@pytest.mark.parametrize(("method", "module", "attribute", "mistake"), MISTAKES)
def test_what_is_off_by_one_percent_shows_in_the_gradients(method, module, attribute, mistake, monkeypatch):
    training.reference_gradients(method)  # kept from here on
    monkeypatch.setattr(module, attribute, mistake(getattr(module, attribute)))
    assert carried_out(CHECKS[f"{method}, float32: gradients of a batch"]).outcome == "wrong"


@pytest.mark.slow
def test_an_optimizer_that_is_wrong_shows_in_the_psnr(monkeypatch):
    training.reference_psnr("fast_small")
    right = adam_cpu.adam_step

    def sluggish(parameter, grad, first, second, step_size, *rest):
        right(parameter, grad, first, second, 0.9 * step_size, *rest)

    monkeypatch.setattr(adam_cpu, "adam_step", sluggish)
    assert carried_out(CHECKS[f"fast_small, float32: {PSNR}"]).outcome == "wrong"


def test_gradients_that_are_missing_are_named():
    with pytest.raises(ValueError, match="gradients of \\['b'\\]"):
        training.gradients_apart({"a": torch.ones(1)}, {"a": torch.ones(1), "b": torch.ones(1)})
