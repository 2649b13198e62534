"""Kernels that are wrong on purpose are reported as wrong, those that are missing as not run."""

import pytest
import torch
from support.self_tested import a_place, rows_of

from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.adam import cpu as adam_cpu
from nerf_lightning.nerf.kernels.hash_grid import cpu as hash_grid_cpu
from nerf_lightning.nerf.kernels.march import cpu as march_cpu
from nerf_lightning.nerf.kernels.mlp import cpu as mlp_cpu
from nerf_lightning.nerf.kernels.packed import cpu as packed_cpu
from nerf_lightning.nerf.kernels.packed import integrate as packed
from nerf_lightning.selftest.checks import kernels


def test_all_kernels_of_this_machine_are_right():
    rows = rows_of(kernels.checks(a_place()), "")
    assert {row.outcome for row in rows} == {"ok", "not run"}
    assert {row.name for row in rows if row.outcome == "not run"} == {"hash_grid (triton)", "perceptron, tf32"}
    for row in rows:
        # A bound that is far above what rounding does would let mistakes through.
        assert row.difference is None or row.bound <= 0.25


def larger(value):
    return 1.01 * value


def off_by_one_percent(module, name):
    right = getattr(module, name)

    def wrong(*given, **options):
        out = right(*given, **options)
        return tuple(map(larger, out)) if isinstance(out, tuple) else larger(out)

    return wrong


def table_gradient(into, points, grad, layout):
    RIGHT_TABLE_GRADIENT(into, points, 1.01 * grad, layout)


def adam(parameter, grad, first, second, step_size, root_scale, betas, eps):
    RIGHT_ADAM(parameter, grad, first, second, 1.01 * step_size, root_scale, betas, eps)


def marching(rays, state, lattice, grid, limit):
    return RIGHT_MARCH(rays, state, 1.01 * lattice, grid, limit)


def rounded(points, weights, keep):
    out, kept = RIGHT_MLP(points.bfloat16().float(), weights, keep)
    return out, kept


RIGHT_TABLE_GRADIENT, RIGHT_ADAM = hash_grid_cpu.add_table_gradient, adam_cpu.adam_step
RIGHT_MARCH, RIGHT_MLP = march_cpu.march, mlp_cpu.forward
MISTAKES = {
    "hash grid: features": (hash_grid_cpu, "forward", off_by_one_percent(hash_grid_cpu, "forward")),
    "hash grid: gradient of the table": (hash_grid_cpu, "add_table_gradient", table_gradient),
    "hash grid: gradient of the points": (
        hash_grid_cpu, "point_gradient", off_by_one_percent(hash_grid_cpu, "point_gradient"),
    ),
    "march: rays": (march_cpu, "march", marching),
    "packed samples: light": (packed_cpu, "integrate", off_by_one_percent(packed_cpu, "integrate")),
    "packed samples: gradients": (
        packed_cpu, "integrate_gradient", off_by_one_percent(packed_cpu, "integrate_gradient"),
    ),
    "packed samples: where": (packed_cpu, "num_visible", lambda density, samples, least: samples.bounds.diff()),
    "adam: weights": (adam_cpu, "adam_step", adam),
    "search": (kernels, "search", lambda ordered, numbers, right: (ordered[..., None, :] < numbers[..., None]).sum(-1)),
    "perceptron, float32: value": (mlp_cpu, "forward", rounded),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_a_kernel_that_is_off_by_one_percent_or_lowers_its_precision_is_wrong(name, monkeypatch):
    assert [row.outcome for row in rows_of(kernels.checks(a_place()), name)] == ["ok"]
    module, attribute, mistake = MISTAKES[name]
    monkeypatch.setattr(module, attribute, mistake)
    assert [row.outcome for row in rows_of(kernels.checks(a_place()), name)] == ["wrong"]


def test_the_capacity_path_is_checked_too(monkeypatch):
    right = torch.nonzero_static
    monkeypatch.setattr(torch, "nonzero_static", lambda flat, **options: right(flat, **options).flip(0))
    assert [row.outcome for row in rows_of(kernels.checks(a_place()), "fixed capacity")] == ["wrong"]


def test_gradients_of_the_perceptron_are_checked_too(monkeypatch):
    right = mlp_cpu.backward

    def wrong(*given):
        points, weights = right(*given)
        return points, [1.01 * weight for weight in weights]

    monkeypatch.setattr(mlp_cpu, "backward", wrong)
    rows = rows_of(kernels.checks(a_place()), "perceptron, float32")
    assert [row.outcome for row in rows] == ["ok", "wrong"]


def test_a_kernel_that_does_not_compile_is_said_to_be_replaced_and_the_others_go_on(monkeypatch):
    for place, library in ((a_place(), "numba"), (a_place(device="cuda"), "triton")):
        monkeypatch.setattr(backends, "twin", lambda module: None)
        monkeypatch.setattr(backends, "why_not", lambda module: "ModuleNotFoundError: it is not there")
        rows = rows_of(kernels.checks(place), f"({library}): compiles")
        assert {row.outcome for row in rows} == {"not run"}
        assert "ModuleNotFoundError: it is not there: plain torch does its work" in rows[0].note
    assert [row.outcome for row in rows_of(kernels.checks(a_place()), "hash grid: features", "march: rays")] == [
        "ok"
    ] * 2


def test_on_a_gpu_triton_and_tf32_are_checked():
    names = [check.name for check in kernels.checks(a_place(device="cuda", products=("float32", "tf32", "bfloat16")))]
    assert "hash_grid (triton): compiles and runs" in names
    assert "perceptron, tf32: gradients" in names
    assert not [name for name in names if "numba" in name]


def test_the_reference_does_not_go_through_what_it_checks(monkeypatch):
    """On the CPU the twins of march and packed samples are numba's: the reference must be torch."""
    monkeypatch.setattr(packed, "cpu_twin", lambda *given: None)
    assert [row.outcome for row in rows_of(kernels.checks(a_place()), "packed samples")] == ["ok"] * 3
