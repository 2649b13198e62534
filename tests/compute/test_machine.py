"""Free memory and cores: the machine's, but no more than a container or a job of a cluster may take."""

import os

import psutil
import pytest

from nerf_lightning.compute import machine
from nerf_lightning.compute.cores import num_cores
from nerf_lightning.compute.machine import free_memory

UNLIMITED = 9223372036854771712
"""How version 1 says that there is no limit."""
HOLDS_FILES = "anon 700\ninactive_file 150\nactive_file 50\nslab 9\n"


@pytest.fixture(autouse=True)
def _a_machine_with_much_memory(monkeypatch, tmp_path):
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 10_000}))
    monkeypatch.setattr(machine, "CONTROL_GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(machine, "OWN_GROUPS", tmp_path / "own")


@pytest.fixture
def group(tmp_path):
    """Return a function that writes the files of a control group."""

    def write(path, **files):
        folder = tmp_path / "cgroup" / path
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / f"memory.{name}").write_text(f"{text}\n")

    return write


@pytest.fixture
def own(tmp_path):
    """Return a function that says which groups this process is in."""
    return (tmp_path / "own").write_text


def test_without_control_groups_or_a_limit_it_is_the_machines(own, group):
    assert free_memory() == 10_000
    own("4:memory:/\n0::/\n")
    group("memory", limit_in_bytes=UNLIMITED, usage_in_bytes=900, stat="")
    group("", max="max", current=900, stat="")
    assert free_memory() == 10_000


def test_a_container_of_version_2_has_its_limit_if_that_can_be_read(own, group):
    own("0::/\n")
    group("", max=1000, current=900, stat=HOLDS_FILES)
    assert free_memory() == 1000 - 900 + 150 + 50
    group("", max=1000, current=1100, stat="")
    assert free_memory() == 0
    own("0::/\nnonsense\n")
    group("", max="", current="many", stat="")
    assert free_memory() == 10_000


@pytest.mark.parametrize("path", ["docker/1f", "not/mounted"])
def test_a_container_of_version_1_has_its_limit_wherever_its_group_is_mounted(own, group, path):
    own(f"9:cpu,cpuacct:/docker/1f\n4:memory:/{path}\n0::/docker/1f\n")
    files = "total_inactive_file 150\ntotal_active_file 50\ninactive_file 1\nactive_file 1"
    group("memory" + ("/docker/1f" if path == "docker/1f" else ""), limit_in_bytes=1000, usage_in_bytes=900, stat=files)
    assert free_memory() == 300


def test_the_narrowest_of_the_groups_around_a_job_counts(own, group):
    own("0::/slurm/job_7/step_0\n")
    group("slurm", max="max", current=5000, stat="")
    group("slurm/job_7", max=2000, current=1500, stat="")
    group("slurm/job_7/step_0", max=4000, current=1500, stat="")
    assert free_memory() == 500


@pytest.fixture(autouse=True)
def _eight(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    for name in ("SLURM_CPUS_PER_TASK", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)


def test_all_that_the_process_may_run_on_are_ours_but_no_more_than_slurm_gave(monkeypatch):
    assert num_cores() == 8
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "4")
    assert num_cores() == 4
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "16")
    assert num_cores() == 8


@pytest.mark.parametrize(("share", "cores"), [("3", 3), ("2,1", 2), ("", 8), ("0", 1), ("many", 8)])
def test_no_more_than_the_share_beside_other_jobs(monkeypatch, share, cores):
    monkeypatch.setenv("OMP_NUM_THREADS", share)
    assert num_cores() == cores
