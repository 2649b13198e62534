"""nerf selftest, the command: its table, its file, its exit code."""

import json

import pytest
from support.running import done, said

from nerf_lightning.extensions.selftest import training
from nerf_lightning.extensions.selftest.commands import selftest
from nerf_lightning.nerf.kernels.hash_grid import cpu as hash_grid_cpu
from nerf_lightning.nerf.kernels.mlp import cpu as mlp_cpu


@pytest.fixture
def kernels_alone(monkeypatch):
    """Without the trainings, which take most of the time."""
    monkeypatch.setattr(training, "checks", lambda *given: [])


@pytest.mark.minutes
def test_a_machine_that_computes_right(nerf, kernels_alone, tmp_path):
    result = done(nerf("selftest", "trainer=cpu", f"paths.output_dir={tmp_path}/out"))
    assert "hash grid: gradient of the table" in result.out
    assert " 0 wrong, " in result.out
    assert "processor: " in result.out
    written = json.loads((tmp_path / "out" / "selftest.json").read_text())
    assert written["right"] is True
    assert {row["outcome"] for row in written["checks"]} == {"ok"}
    # One that is far above what rounding does would let mistakes through.
    assert max(row["bound"] for row in written["checks"]) <= 0.25
    assert {"torch", "numba", "cpu_flags", "threads", "nerf_lightning"} <= set(written["machine"])


def test_kernels_that_are_off_by_one_percent_or_raise_are_wrong_and_the_rest_goes_on(
    nerf, kernels_alone, monkeypatch, tmp_path
):
    def broken(*given):
        raise SystemError("unknown opcode")

    right = hash_grid_cpu.forward
    monkeypatch.setattr(hash_grid_cpu, "forward", lambda *given: 1.01 * right(*given))
    monkeypatch.setattr(mlp_cpu, "backward", broken)
    result = nerf("selftest", "trainer=cpu", f"paths.output_dir={tmp_path}/out")
    assert result.code == 1
    assert "WRONG: hash grid: features: 0.01 exceeds 9.54e-07 (16 roundings" in result.out
    assert "WRONG: perceptron, float32: gradients: SystemError: unknown opcode" in result.out
    assert "ragged samples: gradients" in result.out
    assert json.loads((tmp_path / "out" / "selftest.json").read_text())["right"] is False


def test_other_devices_are_refused_in_one_paragraph(nerf, monkeypatch):
    monkeypatch.setattr(selftest, "DEVICES", ())
    said(nerf("selftest", "trainer=cpu"), "nerf selftest supports CPUs and NVIDIA GPUs")
