"""Sweeps by every launcher and sweeper: what their table says, and how they go on after a stop."""

import csv
import json
import os
import signal
import time
from subprocess import STDOUT

import pytest
import torch
from omegaconf import OmegaConf
from support.running import FAST_SWEEP, done, finished, output_of, start, start_code
from support.systems import POSIX

from nerf_lightning.compute.cores import num_cores
from nerf_lightning.runs import sweep

ALL_CORES = """
import os, sys
os.environ.pop("OMP_NUM_THREADS", None)
sys.argv = argv
from nerf_lightning.cli.process import main
main()
"""
QUICK = (*FAST_SWEEP, "logger=none", "final.video=false", "callbacks.checkpoints.every_steps=5")


def arguments(capture, folder, *more):
    return ("train", "-m", "scene=npz", f"scene.path={capture}", *QUICK, f"paths.output_dir={folder}", *more)


def table(folder):
    return list(csv.DictReader((folder / "sweep.csv").read_text().splitlines()))


def wait_for_step(folder, step, process):
    last = folder / "checkpoints" / "last.ckpt"
    while process.poll() is None:
        if last.exists() and torch.load(last, weights_only=True)["global_step"] >= step:
            return
        time.sleep(0.05)
    raise AssertionError(process.communicate()[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "launcher",
    [
        *("basic", pytest.param("parallel", marks=pytest.mark.minutes)),
        *(pytest.param(name, marks=pytest.mark.exhaustive) for name in ("joblib", "slurm_here")),
    ],
)
def test_every_launcher_runs_the_jobs_and_makes_a_table_the_best_first(capture, tmp_path, launcher):
    sweep = arguments(capture, tmp_path, f"hydra/launcher={launcher}", "seed=0,1")
    # Jobs that share the cores share all of them, however many the tests leave to each other.
    output = output_of(start_code(f"argv = {['nerf', *sweep]}\n{ALL_CORES}", stderr=STDOUT))
    assert "Warning" not in output
    rows = table(tmp_path)
    psnr = [float(row["PSNR"]) for row in rows]
    assert psnr == sorted(psnr, reverse=True)
    assert {row["folder"] for row in rows} == {"0_seed=0", "1_seed=1"}
    assert list(rows[0]) == ["job", "seed", "PSNR", "SSIM", "steps", "seconds", "state", "folder"]
    for row in rows:
        metrics = json.loads((tmp_path / row["folder"] / "metrics.json").read_text())
        assert (float(row["PSNR"]), float(row["SSIM"])) == (metrics["psnr"], metrics["ssim"])
        assert (row["steps"], row["state"]) == ("4", "finished")
        assert float(row["seconds"]) > 0
    lines = (tmp_path / "sweep.md").read_text().splitlines()
    assert len(lines) == 4
    assert f"{psnr[0]:.2f}" in lines[2]
    assert f"{psnr[0]:.2f}" in output
    if launcher == "parallel":
        count = max(1, num_cores() // 2)
        assert output.count(f"cpu, {count} thread{'s' * (count != 1)} (") == 2
        for number in (0, 1):
            assert f"[{number + 1}/2 seed={number}] test PSNR" in output
            assert f"INFO  [{number + 1}/2 seed={number}] run folder" in output


def test_jobs_side_by_side_have_the_cores_that_slurm_gave(monkeypatch):
    """What joblib is told; it divides them."""
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "1")
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "")
    monkeypatch.delenv("LOKY_MAX_CPU_COUNT")
    sweep._share_cores("hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher", OmegaConf.create())
    assert os.environ["LOKY_MAX_CPU_COUNT"] == "1"


@pytest.mark.minutes
def test_a_search_maximises_the_psnr_and_goes_on_where_it_was(capture, tmp_path):
    search = ("hydra/sweeper=search", "optimizer.lr=tag(log, interval(1e-4, 1e-2))")
    output_of(start(*arguments(capture, tmp_path, *search, "hydra.sweeper.n_trials=2")))
    first = table(tmp_path)
    assert len(first) == 2
    best = (tmp_path / "optimization_results.yaml").read_text()
    assert f"best_value: {first[0]['PSNR']}" in best
    output_of(start("train", "-m", "sweep.resume=true", f"paths.output_dir={tmp_path}", "hydra.sweeper.n_trials=3"))
    again = table(tmp_path)
    assert sorted(row["state"] for row in again) == ["finished", "finished before", "finished before"]
    assert {row["optimizer.lr"] for row in first} < {row["optimizer.lr"] for row in again}


@pytest.mark.slow
def test_a_job_that_fails_costs_only_itself(capture, tmp_path):
    code, output = finished(start(*arguments(capture, tmp_path, "data.batch_rays=-1,64", "optimizer.lr=1e-3")))
    assert code == 2, output
    assert "Traceback" not in output
    complaint = "1 of 2 jobs failed. 0_data.batch_rays=-1: data.batch_rays=-1: at least one ray is needed."
    assert complaint in output
    assert [(row["data.batch_rays"], row["state"]) for row in table(tmp_path)] == [("64", "finished"), ("-1", "failed")]


@pytest.mark.minutes
@POSIX
def test_a_sweep_killed_in_its_second_job_goes_on(capture, tmp_path):
    longer = ("seed=0,1", "trainer.max_steps=50")
    process = start(*arguments(capture, tmp_path, *longer))
    wait_for_step(tmp_path / "1_seed=1", 10, process)
    process.kill()
    code, output = finished(process)
    assert code == -signal.SIGKILL
    told = next(line for line in output.splitlines() if "if it stops, resume with" in line)
    command = told.partition("resume with: nerf ")[2].split()
    assert command == ["train", "-m", "sweep.resume=true", f"paths.output_dir={tmp_path}", "logger=none"]
    before = json.loads((tmp_path / "0_seed=0" / "run.json").read_text())
    output = output_of(start(*command))
    assert "job 0 has finished before" in output
    assert "resuming from step" in output
    assert json.loads((tmp_path / "0_seed=0" / "run.json").read_text()) == before
    assert {row["state"] for row in table(tmp_path)} == {"finished before", "finished"}
    assert {row["steps"] for row in table(tmp_path)} == {"50"}


@pytest.mark.slow
@POSIX
def test_sigterm_stops_the_sweep_and_not_only_its_job(capture, tmp_path):
    process = start(*arguments(capture, tmp_path, "seed=0,1", "trainer.max_steps=100000"))
    wait_for_step(tmp_path / "0_seed=0", 10, process)
    process.terminate()
    code, output = finished(process)
    assert code == 143, output
    assert [row["state"] for row in table(tmp_path)] == ["stopped"]
    assert not (tmp_path / "1_seed=1").exists()


def test_a_sweep_that_is_refused_leaves_nothing(nerf, tmp_path):
    words = ("train", "-m", "scene=transforms", "scene.root=nowhere", f"paths.root_dir={tmp_path}/outputs")
    refused = nerf(*words, "model=nerf_tiny,nerf_small")
    assert refused.code == 2
    assert "2 of 2 jobs failed. 0_model=nerf_tiny, 1_model=nerf_small: The folder nowhere does not exist" in refused.err
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "own").mkdir()
    assert nerf(*words, "seed=0,1", f"paths.output_dir={tmp_path}/own").code == 2
    assert [path.name for path in tmp_path.rglob("*")] == ["own"], "what was there before stays"


@pytest.mark.minutes
def test_a_sweep_is_not_begun_where_one_has_been_but_can_be_extended(nerf, capture, tmp_path):
    assert nerf(*arguments(capture, tmp_path, "seed=0")).code == 0
    refused = nerf(*arguments(capture, tmp_path, "seed=0,1"))
    assert refused.code == 2
    assert "already holds runs of a sweep. Add sweep.resume=true" in refused.err
    done(nerf("train", "-m", "seed=1,0", "sweep.resume=true", f"paths.output_dir={tmp_path}"))
    states = {row["seed"]: row["state"] for row in table(tmp_path)}
    assert states == {"0": "finished before", "1": "finished"}
    done(nerf("train", "-m", "seed=0", "evaluation.max_views=1", "sweep.resume=true", f"paths.output_dir={tmp_path}"))
    assert table(tmp_path)[0]["state"] == "finished", "another evaluation is not the same job"
