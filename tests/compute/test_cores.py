import os

import pytest

from nerf_lightning.compute.cores import num_cores


@pytest.fixture(autouse=True)
def _eight(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    for name in ("SLURM_CPUS_PER_TASK", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)


def test_all_that_the_process_may_run_on_are_ours():
    assert num_cores() == 8


def test_no_more_than_slurm_gave(monkeypatch):
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "4")
    assert num_cores() == 4
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "16")
    assert num_cores() == 8


@pytest.mark.parametrize(("share", "cores"), [("3", 3), ("2,1", 2), ("", 8), ("0", 1), ("many", 8)])
def test_no_more_than_the_share_beside_other_jobs(monkeypatch, share, cores):
    monkeypatch.setenv("OMP_NUM_THREADS", share)
    assert num_cores() == cores
