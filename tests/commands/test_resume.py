"""A run stopped anywhere and resumed ends with the weights, bit for bit, of one that was never stopped."""

import json
import logging
import os
import shutil
import signal
import time

import pytest
import torch
from support.running import FAST, done, finished, output_of, saved, start
from support.systems import POSIX
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nerf_lightning.compute.slurm import requeue, slurm_job, was_requeued
from nerf_lightning.training.launch.preemption import preemptible, wants_restart

STEPS = 70


def arguments(capture, folder, steps=STEPS):
    return (
        "train", "scene=npz", f"scene.path={capture}", *FAST, f"trainer.max_steps={steps}", "trainer.num_threads=1",
        "scene.background=random", "final.evaluate=false", "final.video=false", "resume=auto",
        "callbacks.validation_pictures.every_steps=1000", "callbacks.checkpoints.every_steps=7",
        "trainer.val_every_steps=14", f"paths.output_dir={folder}",
    )  # fmt: skip


def state(folder):
    content = saved(folder)
    return content["global_step"], content["state_dict"], content["optimizer_states"][0]["state"]


@pytest.mark.slow
@POSIX
def test_a_run_is_resumed_by_its_folder_alone(capture, tmp_path):
    """The command that a stopped run prints: no override needs to be repeated. TensorBoard shows each step once."""
    folder = tmp_path / "run"
    process = start(*arguments(capture, folder))
    while process.poll() is None and saved(folder)["global_step"] < 14:
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    code, output = finished(process)
    assert code == 143, output
    assert f"resume with: nerf train resume={folder}" in output
    output = output_of(start("train", f"resume={folder}"))
    assert "resuming from step" in output
    output_of(start(*arguments(capture, tmp_path / "never_stopped")))
    torch.testing.assert_close(state(folder), state(tmp_path / "never_stopped"), rtol=0, atol=0)
    log = EventAccumulator(str(folder / "tensorboard")).Reload()
    assert [event.step for event in log.Scalars("Training loss/sum")] == list(range(5, STEPS + 1, 5))
    validated = [event.step for event in log.Scalars("PSNR/validation")]
    assert len(set(validated)) == len(validated)
    assert set(range(14, STEPS + 1, 14)) <= set(validated)  # and when it was stopped, or went on


@pytest.mark.parametrize(("planned", "asked", "end"), [(20, 8, 20), (24, 22, 24), (20, 22, 22)])
def test_a_run_is_not_made_shorter_than_it_was_to_be(nerf, finished_run, tmp_path, planned, asked, end):
    run = tmp_path / "run"
    shutil.copytree(finished_run, run)
    note = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(note | {"num_steps": planned}))
    quick = ("final.evaluate=false", "final.video=false")
    result = done(nerf("train", f"resume={run}", f"trainer.max_steps={asked}", *quick))
    assert (f"continues to step {planned}, not {asked}" in result.err) == (asked < planned)
    note = json.loads((run / "run.json").read_text())
    assert (note["num_steps"], note["finished_at_step"], state(run)[0]) == (end, end, end)


# What srun sets for a job of one task; by SLURM_NTASKS Lightning recognizes Slurm.
SLURM = {"JOB_ID": "4711", "JOB_NAME": "nerf", "NTASKS": "1", "PROCID": "0", "LOCALID": "0", "NODEID": "0"}
SLURM |= {"NODELIST": "localhost"}


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
        monkeypatch.setenv(f"SLURM_{name}", value)
    return lambda: asked.read_text().splitlines() if asked.exists() else []


def begin(capture, root, *more, **options):
    return start(
        "train", "scene=npz", f"scene.path={capture}", *FAST, "logger=none", "trainer.max_steps=70",
        "final.evaluate=false", "final.video=false", f"paths.root_dir={root}", *more, **options,
    )  # fmt: skip


def saved_below(root, step, process):
    while process.poll() is None:
        found = list(root.rglob("last.ckpt"))
        if found and torch.load(found[0], weights_only=True)["global_step"] >= step:
            return found[0].parent.parent
        time.sleep(0.05)
    raise AssertionError(process.communicate()[0])


def test_a_first_start_was_not_requeued_and_a_job_of_an_array_is_named_by_array_and_task(monkeypatch):
    assert not was_requeued()
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert not was_requeued(), "only Slurm restarts Slurm's jobs"
    monkeypatch.setenv("SLURM_JOB_ID", "13")
    assert was_requeued()
    monkeypatch.setenv("SLURM_RESTART_COUNT", "0")
    assert not was_requeued()
    monkeypatch.setenv("SLURM_JOB_ID", "13")
    assert slurm_job() == "13"
    monkeypatch.setenv("SLURM_ARRAY_JOB_ID", "12")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "3")
    assert slurm_job() == "12_3"


@POSIX
def test_usr1_requeues_and_sigterm_does_not(scontrol):
    for number, asked in ((signal.SIGTERM, []), (signal.SIGUSR1, ["requeue 4711"])):
        before = signal.getsignal(number)
        with pytest.raises(SystemExit) as stop, preemptible():
            signal.raise_signal(number)
        assert stop.value.code == 128 + number
        assert wants_restart(stop.value.code) == bool(asked)
        assert scontrol() == asked
        assert signal.getsignal(number) == before


def test_one_process_asks_for_all_and_a_refusal_by_slurm_is_told(scontrol, monkeypatch, tmp_path, caplog):
    monkeypatch.setenv("SLURM_PROCID", "1")
    requeue()
    assert scontrol() == []
    monkeypatch.setenv("SLURM_PROCID", "0")
    (tmp_path / "bin" / "scontrol").write_text("#!/bin/sh\necho 'Job may not be requeued' >&2\nexit 1\n")
    with caplog.at_level(logging.ERROR):
        requeue()
    assert "scontrol requeue 4711 failed: Job may not be requeued. Submit the job again by hand" in caplog.text


@POSIX
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


@pytest.mark.minutes
@POSIX
def test_a_slurm_job_whose_time_is_up_goes_on_in_its_folder_when_it_is_started_again(capture, tmp_path, scontrol):
    root = tmp_path / "runs"
    process = begin(capture, root)
    folder = saved_below(root, 10, process)
    process.send_signal(signal.SIGUSR1)
    code, output = finished(process)
    assert code == 128 + signal.SIGUSR1, output
    assert scontrol() == ["requeue 4711"]
    assert not list(root.rglob("hpc_ckpt*")), "Lightning's own requeueing is off"
    note = json.loads((folder / "run.json").read_text())
    assert (note["slurm_job"], note["preempted"]) == ("4711", True)
    output = output_of(begin(capture, root, env={"SLURM_RESTART_COUNT": "1"}))
    assert "resuming from step" in output
    assert len(list(root.rglob("run.json"))) == 1
    assert json.loads((folder / "run.json").read_text())["finished_at_step"] == 70
