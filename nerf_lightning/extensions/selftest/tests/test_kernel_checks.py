"""Kernels that are wrong on purpose are reported as wrong, those that are missing as not run."""

import pytest
import torch

from nerf_lightning.extensions.selftest.check import carried_out
from nerf_lightning.extensions.selftest.kernels import checks
from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.hash_grid import cpu as hash_grid_cpu
from nerf_lightning.nerf.kernels.march import cpu as march_cpu
from nerf_lightning.nerf.kernels.mlp import cpu as mlp_cpu
from nerf_lightning.nerf.kernels.ragged import cpu as ragged_cpu
from nerf_lightning.nerf.kernels.ragged import op as packed

CPU = torch.device("cpu")
CHECKS = {check.name: check for check in checks(CPU, ("float32", "bfloat16"))}


def larger(value):
    return tuple(map(larger, value)) if isinstance(value, tuple) else 1.01 * value


def off_by_one_percent(right):
    return lambda *given, **options: larger(right(*given, **options))


def table_gradient(right):
    return lambda into, points, grad, layout: right(into, points, 1.01 * grad, layout)


def marching(right):
    return lambda rays, state, lattice, grid, limit: right(rays, state, 1.01 * lattice, grid, limit)


def rounded(right):
    return lambda points, weights, keep: right(points.bfloat16().float(), weights, keep)


def weight_gradients(right):
    def wrong(*given):
        points, weights = right(*given)
        return points, [1.01 * weight for weight in weights]

    return wrong


MISTAKES = {
    "hash grid: features": (hash_grid_cpu, "forward", off_by_one_percent),
    "hash grid: gradient of the table": (hash_grid_cpu, "add_table_gradient", table_gradient),
    "hash grid: gradient of the points": (hash_grid_cpu, "point_gradient", off_by_one_percent),
    "march: rays with other intervals": (march_cpu, "march", marching),
    "ragged samples: value": (ragged_cpu, "integrate", off_by_one_percent),
    "ragged samples: gradients": (ragged_cpu, "integrate_gradient", off_by_one_percent),
    "perceptron, float32: value": (mlp_cpu, "forward", rounded),
    "perceptron, float32: gradients": (mlp_cpu, "backward", weight_gradients),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_a_kernel_that_is_off_by_one_percent_or_lowers_its_precision_is_wrong(name, monkeypatch):
    module, attribute, mistake = MISTAKES[name]
    monkeypatch.setattr(module, attribute, mistake(getattr(module, attribute)))
    assert carried_out(CHECKS[name]).outcome == "wrong"


@pytest.mark.parametrize(("device", "library"), [("cpu", "numba"), ("cuda", "triton")])
def test_a_kernel_that_does_not_compile_is_said_to_be_replaced(device, library, monkeypatch):
    monkeypatch.setattr(backends, "backend", lambda module: None)
    monkeypatch.setattr(backends, "why_not", lambda module: "ModuleNotFoundError: it is not there")
    found = [each for each in checks(torch.device(device), ("float32",)) if f"({library})" in each.name]
    rows = [carried_out(each) for each in found]
    assert {row.outcome for row in rows} == {"not run"}
    assert "ModuleNotFoundError: it is not there: plain torch does its work" in rows[0].note


def test_the_reference_does_not_go_through_what_it_checks(monkeypatch):
    """On the CPU the twins of march and ragged samples are numba's: the reference must be torch."""
    monkeypatch.setattr(packed, "backend_for", lambda *given: None)
    assert carried_out(CHECKS["ragged samples: value"]).outcome == "ok"
