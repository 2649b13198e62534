"""nerf selftest, the command: its table, its file, its exit code."""

import json

import pytest
from support.self_tested import Finished

from nerf_lightning.commands import selftest
from nerf_lightning.nerf.kernels.hash_grid import cpu as hash_grid_cpu
from nerf_lightning.selftest import place
from nerf_lightning.selftest.checks import kernels


@pytest.fixture
def kernels_alone(monkeypatch):
    """Without the trainings and the command line, which take most of the time."""
    monkeypatch.setattr(place, "Runs", lambda folder, overrides: Finished(folder))
    monkeypatch.setattr(selftest, "find_checks", kernels.checks)


def test_a_machine_that_computes_right(nerf, kernels_alone, tmp_path):
    result = nerf("selftest", "trainer=cpu", f"paths.output_dir={tmp_path}/out")
    assert result.code == 0, result.err
    assert "hash grid: gradient of the table" in result.out
    assert "not run: hash_grid (triton): it is for GPUs" in result.out
    assert " 0 wrong, " in result.out
    assert "processor: " in result.out
    written = json.loads((tmp_path / "out" / "selftest.json").read_text())
    assert written["right"] is True
    assert {row["outcome"] for row in written["checks"]} == {"ok", "not run"}
    assert {"torch", "numba", "cpu_flags", "threads", "nerf_lightning"} <= set(written["machine"])


def test_a_machine_whose_kernel_is_off_by_one_percent(nerf, kernels_alone, monkeypatch, tmp_path):
    right = hash_grid_cpu.forward
    monkeypatch.setattr(hash_grid_cpu, "forward", lambda *given: 1.01 * right(*given))
    result = nerf("selftest", "trainer=cpu", f"paths.output_dir={tmp_path}/out")
    assert result.code == 1
    assert "WRONG: hash grid: features: 0.01 exceeds 9.54e-07 (8 corners" in result.out
    written = json.loads((tmp_path / "out" / "selftest.json").read_text())
    assert written["right"] is False
    assert [row["name"] for row in written["checks"] if row["outcome"] == "wrong"] == ["hash grid: features"]


def test_a_kernel_that_raises_is_wrong_and_the_rest_goes_on(nerf, kernels_alone, monkeypatch, tmp_path):
    def broken(*given):
        raise SystemError("unknown opcode")

    monkeypatch.setattr(hash_grid_cpu, "point_gradient", broken)
    result = nerf("selftest", "trainer=cpu", f"paths.output_dir={tmp_path}/out")
    assert result.code == 1
    assert "WRONG: hash grid: gradient of the points: SystemError: unknown opcode" in result.out
    assert "perceptron, float32: value" in result.out


def test_other_devices_are_refused_in_one_paragraph(nerf, monkeypatch):
    monkeypatch.setattr(place, "TRAINERS", {})
    result = nerf("selftest", "trainer=cpu")
    assert result.code == 2
    assert "nerf selftest knows CPUs and NVIDIA GPUs" in result.err


@pytest.mark.exhaustive
def test_the_whole_of_it(nerf, tmp_path):
    result = nerf("selftest", "trainer=cpu", f"paths.output_dir={tmp_path}/out")
    assert result.code == 0, result.out
    rows = json.loads((tmp_path / "out" / "selftest.json").read_text())["checks"]
    for words in ("hash grid", "PSNR after", "resume at step", "read back", "film: two frames"):
        assert any(words in row["name"] and row["outcome"] == "ok" for row in rows), words
