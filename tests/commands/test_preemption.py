"""Schedulers ask a run to leave: it saves, is queued again, and goes on by itself."""

import json
import logging
import os
import signal
import time

import pytest
import torch
from support.running import FAST, start

from nerf_lightning.compute.slurm import requeue, slurm_job, was_requeued
from nerf_lightning.training.launch.preemption import preemptible, wants_restart

# What srun sets for a job of one task; by SLURM_NTASKS Lightning recognises Slurm.
SLURM = {
    "SLURM_JOB_ID": "4711",
    "SLURM_JOB_NAME": "nerf",
    "SLURM_NTASKS": "1",
    "SLURM_PROCID": "0",
    "SLURM_LOCALID": "0",
    "SLURM_NODEID": "0",
    "SLURM_NODELIST": "localhost",
}


@pytest.fixture
def scontrol(tmp_path, monkeypatch):
    """A Slurm job whose scontrol writes down what it is asked; returns what it was asked."""
    asked = tmp_path / "asked"
    fake = tmp_path / "bin" / "scontrol"
    fake.parent.mkdir()
    fake.write_text(f'#!/bin/sh\necho "$@" >> {asked}\n')
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", f"{fake.parent}{os.pathsep}{os.environ['PATH']}")
    for name, value in SLURM.items():
        monkeypatch.setenv(name, value)
    return lambda: asked.read_text().splitlines() if asked.exists() else []


def begin(capture, root, *more, **options):
    return start(
        "train", "scene=npz", f"scene.path={capture}", *FAST, "logger=none", "trainer.max_steps=150",
        "final.video=false", f"paths.root_dir={root}", *more, **options,
    )  # fmt: skip


def wait_for_step(root, step, process):
    while process.poll() is None:
        found = list(root.rglob("last.ckpt"))
        if found and torch.load(found[0], weights_only=True)["global_step"] >= step:
            return found[0].parent.parent
        time.sleep(0.05)
    raise AssertionError(process.communicate()[0])


def finish(process):
    output, _ = process.communicate(timeout=300)
    return process.returncode, output


def test_a_job_of_an_array_is_named_by_array_and_task(monkeypatch):
    monkeypatch.setenv("SLURM_JOB_ID", "13")
    assert slurm_job() == "13"
    monkeypatch.setenv("SLURM_ARRAY_JOB_ID", "12")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "3")
    assert slurm_job() == "12_3"


def test_a_first_start_was_not_requeued(monkeypatch):
    assert not was_requeued()
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert not was_requeued(), "only Slurm restarts Slurm's jobs"
    monkeypatch.setenv("SLURM_JOB_ID", "13")
    assert was_requeued()
    monkeypatch.setenv("SLURM_RESTART_COUNT", "0")
    assert not was_requeued()


def test_usr1_requeues_and_sigterm_does_not(scontrol):
    for number, asked in ((signal.SIGTERM, []), (signal.SIGUSR1, ["requeue 4711"])):
        before = signal.getsignal(number)
        with pytest.raises(SystemExit) as stop, preemptible():
            signal.raise_signal(number)
        assert stop.value.code == 128 + number
        assert wants_restart(stop.value.code) == bool(asked)
        assert scontrol() == asked
        assert signal.getsignal(number) == before


def test_one_process_asks_for_all(scontrol, monkeypatch):
    monkeypatch.setenv("SLURM_PROCID", "1")
    requeue()
    assert scontrol() == []


def test_a_refusal_by_slurm_is_told(scontrol, tmp_path, caplog):
    (tmp_path / "bin" / "scontrol").write_text("#!/bin/sh\necho 'Job may not be requeued' >&2\nexit 1\n")
    with caplog.at_level(logging.ERROR):
        requeue()
    assert "scontrol requeue 4711 failed: Job may not be requeued. Submit the job again by hand" in caplog.text


def test_submitits_own_handler_is_called_after_the_run_has_saved(monkeypatch):
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "slurm")
    called = []
    before = signal.signal(signal.SIGUSR2, lambda number, frame: called.append(number))
    try:
        with pytest.raises(SystemExit), preemptible():
            signal.raise_signal(signal.SIGUSR2)
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert called == [signal.SIGUSR2]


@pytest.mark.slow
def test_a_slurm_job_whose_time_is_up_goes_on_in_its_folder_when_it_is_started_again(capture, tmp_path, scontrol):
    root = tmp_path / "runs"
    process = begin(capture, root)
    folder = wait_for_step(root, 10, process)
    process.send_signal(signal.SIGUSR1)
    code, output = finish(process)
    assert code == 128 + signal.SIGUSR1, output
    assert scontrol() == ["requeue 4711"]
    assert not list(root.rglob("hpc_ckpt*")), "Lightning's own requeueing is off"
    note = json.loads((folder / "run.json").read_text())
    assert (note["slurm_job"], note["preempted"]) == ("4711", True)
    code, output = finish(begin(capture, root, env={"SLURM_RESTART_COUNT": "1"}))
    assert code == 0, output
    assert "going on from step" in output
    assert len(list(root.rglob("run.json"))) == 1
    assert json.loads((folder / "run.json").read_text())["finished_at_step"] == 150


@pytest.mark.exhaustive
def test_a_job_of_submitit_saves_is_started_again_and_goes_on(capture, tmp_path):
    folder = tmp_path / "sweep"
    process = begin(
        capture, tmp_path, "-m", "hydra/launcher=slurm_here", "seed=0", "hydra.sweep.dir=" + str(folder),
        "hydra.launcher.timeout_min=10",
    )  # fmt: skip
    run = wait_for_step(folder, 10, process)
    record = json.loads((folder / ".hydra" / "jobs" / "0.json").read_text())
    os.kill(record["process"], signal.SIGUSR2)
    code, output = finish(process)
    assert code == 0, output
    (log,) = folder.glob(".submitit/*/*_log.err")
    assert "going on from step" in log.read_text()
    assert json.loads((run / "run.json").read_text())["finished_at_step"] == 150
    assert json.loads((folder / ".hydra" / "jobs" / "0.json").read_text())["state"] == "finished"
