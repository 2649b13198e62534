"""Several processes train one run: the same batch, the same weights, one folder; and they stop and resume together."""

import json
import signal
import time

import psutil
import pytest
import torch
from support.ports import unused_port
from support.running import FAST_PATH, FAST_SWEEP, finished, output_of, said, saved, start, start_code, start_cold
from support.systems import POSIX

from nerf_lightning.messages.errors import InputError
from nerf_lightning.training.launch import processes
from nerf_lightning.training.launch.processes import num_processes

STEPS = 20
# Two processes take 51 and 50 of 101 rays, of 32 points each. One process that is given tiles of so many points cuts
# the batch in the same place. Then both make the same products, in whatever precision, and what is left between them is
# the order of sums in float32: of tiles in one, of processes in the other. With other tiles, gradients that are rounded
# to bfloat16 tile by tile would differ by 2^-9 of themselves, and Adam would make of each difference of sign a step.
TILES = "trainer.tile_points=1650"
TWO = ("trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2")


def arguments(capture, *extra):
    return (
        "train", "scene=npz", f"scene.path={capture}", *FAST_SWEEP, "data.batch_rays=101", "scheduler=constant",
        f"trainer.max_steps={STEPS}", TILES, "scene.background=random", "final.video=false", "path.num_frames=3",
        "evaluation.max_views=3", "callbacks.validation_pictures.every_steps=1000", *extra,
    )  # fmt: skip


def assert_close(folder, other):
    ours, theirs = saved(folder), saved(other)
    assert ours["global_step"] == theirs["global_step"] == STEPS
    for name, weight in theirs["state_dict"].items():
        assert torch.allclose(ours["state_dict"][name].float(), weight.float(), atol=1e-4), name
    ours, theirs = (json.loads((place / "metrics.json").read_text()) for place in (folder, other))
    assert [row["name"] for row in ours["per_image"]] == [row["name"] for row in theirs["per_image"]]
    assert ours["psnr"] == pytest.approx(theirs["psnr"], abs=0.02)


@pytest.fixture(scope="module")
def alone(capture, tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone") / "run"
    output_of(start(*arguments(capture, f"paths.output_dir={folder}")))
    return folder


@pytest.mark.minutes
def test_two_processes_follow_one(capture, tmp_path, alone):
    """Uneven shares of 101 rays, random backgrounds; views of the evaluation and frames of the film are dealt out."""
    output = output_of(start(*arguments(capture, *TWO, "final.video=true", f"paths.output_dir={tmp_path}")))
    assert_close(tmp_path, alone)
    assert output.count("test PSNR") == 1, "one process speaks"
    assert output.count("2 processes") == 1
    assert (tmp_path / "video.mp4").is_file()
    assert json.loads((tmp_path / "run.json").read_text())["finished_at_step"] == STEPS


@pytest.mark.exhaustive
def test_two_machines_under_torchrun_follow_one_process(capture, tmp_path, alone):
    port = unused_port()
    machines = [
        start_cold(
            "torch.distributed.run", "--nnodes", 2, "--nproc-per-node", 1, "--node-rank", number,
            "--master-addr", "127.0.0.1", "--master-port", port, "-m", "nerf_lightning",
            *arguments(capture, "trainer=torchrun", "trainer.accelerator=cpu", f"paths.output_dir={tmp_path}"),
        )
        for number in range(2)
    ]  # fmt: skip
    results = [finished(machine) for machine in machines]
    assert [code for code, _ in results] == [0, 0], results
    assert_close(tmp_path, alone)


@pytest.mark.exhaustive
@POSIX
def test_a_run_of_two_processes_is_stopped_and_goes_on_in_one(capture, tmp_path, alone):
    process = start(*arguments(capture, *TWO, f"paths.output_dir={tmp_path}"))
    while process.poll() is None and saved(tmp_path)["global_step"] < STEPS // 2:
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    code, output = finished(process)
    assert code == 128 + signal.SIGTERM, output
    assert STEPS // 2 <= saved(tmp_path)["global_step"] < STEPS
    output_of(start("train", f"resume={tmp_path}", "trainer=cpu", f"trainer.max_steps={STEPS}"))
    assert_close(tmp_path, alone)


def is_alive(process):
    # In a container, nobody may ask what became of an orphan.
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


ORPHANED = """
import os, time
from nerf_lightning.training.launch.processes import end_with

launcher, worker = os.getpid(), os.fork()
end_with(launcher) if worker == 0 else print(worker, flush=True)
time.sleep(60)
"""


@POSIX
def test_a_worker_ends_with_the_process_that_has_started_it():
    with start_code(ORPHANED) as process:
        worker = psutil.Process(int(process.stdout.readline()))
        process.send_signal(signal.SIGKILL)
        deadline = time.monotonic() + 30
        while is_alive(worker) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not is_alive(worker)


@pytest.mark.exhaustive
def test_the_fast_model_adapts_its_batches_alike_in_two_processes(capture, tmp_path):
    for name, extra in (("one", ()), ("two", TWO)):
        output_of(start(*arguments(capture, *FAST_PATH, *extra, f"paths.output_dir={tmp_path / name}")))
    one, two = saved(tmp_path / "one")["nerf_lightning"], saved(tmp_path / "two")["nerf_lightning"]
    assert one["progress"] == two["progress"]
    assert one["progress"]["batch_rays"] < 256
    # Its optimizer divides by roots of tiny gradients, so that rounding grows within steps: the pictures must agree.
    one, two = (json.loads((tmp_path / name / "metrics.json").read_text())["psnr"] for name in ("one", "two"))
    assert two == pytest.approx(one, abs=0.2)


TORCHRUN = {"TORCHELASTIC_RUN_ID": "1"}
SLURM = {"JOB_ID": "1", "JOB_NAME": "wrap", "NTASKS": "4", "PROCID": "0", "LOCALID": "0", "NODELIST": "localhost"}
SLURM = {f"SLURM_{name}": value for name, value in SLURM.items()}


@pytest.mark.parametrize(
    ("environment", "more", "words"),
    [
        ({}, ["trainer=torchrun"], ("trainer=torchrun: this process was not started by",)),
        ({}, ["trainer=slurm"], ("trainer=slurm: this process was not started by",)),
        (TORCHRUN, [], ("Add trainer=torchrun",)),
        (SLURM, [], ("4 tasks (SLURM_NTASKS=4)", "srun nerf train", "--ntasks-per-node=1")),
        (SLURM, ["trainer=slurm"], ("not started by Slurm's srun",)),
        (SLURM | {"SLURM_STEP_ID": "0"}, ["trainer=slurm"], ("4 tasks (SLURM_NTASKS=4)", "--ntasks-per-node=N")),
    ],
)
def test_processes_that_would_not_train_together_are_refused(
    nerf, capture, monkeypatch, tmp_path, environment, more, words
):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    said(nerf(*arguments(capture, f"paths.output_dir={tmp_path}/run", *more)), *words)
    assert not (tmp_path / "run").exists()


def test_a_sweep_under_torchrun_is_refused(nerf, capture, monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "1")
    result = nerf(*arguments(capture, "trainer=torchrun", "-m", "seed=0,1", f"paths.output_dir={tmp_path}"))
    assert result.code == 2
    assert "each of the processes would run the sweep by itself" in result.err


def test_a_process_needs_a_device_and_the_first_failure_of_its_own_is_the_exit_code(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    assert num_processes("auto", "cuda") == 4
    assert num_processes(2, "cuda") == 2
    assert num_processes(3, "cpu") == 3
    for devices, device_type, words in ((8, "cuda", "there are 4 devices"), ("auto", "cpu", "trainer.devices=2")):
        with pytest.raises(InputError, match=words):
            num_processes(devices, device_type)
    assert processes._exit_code([-15, 2]) == 2
    assert processes._exit_code([143, 143]) == 143
