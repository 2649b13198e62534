"""Windows and macOS, where nothing was ever run: what the stand-in shows of them."""

import csv
import os
import signal
import subprocess
import sys
import time

import pytest
from support import other_systems
from support.captures import write_npz
from support.command_fixtures import *  # noqa: F403
from support.running import FAST, FAST_SWEEP, REPOSITORY, finished, saved, start_cold

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Linux stands in for the others")


def run(system, folder, *commands):
    """Run commands one after the other in one process."""
    done = subprocess.run(
        [sys.executable, "tests/support/other_systems.py"], input="\n".join(commands), text=True, capture_output=True,
        cwd=REPOSITORY, env=other_systems.environment(system, folder),
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-5000:]


@pytest.mark.parametrize("system", ["win32", "darwin"])
@pytest.mark.minutes
def test_the_main_commands_do_their_work(system, tmp_path):
    """Among them training again over what is there: for Windows, files that are open stay where they are."""
    scene = f"scene=npz scene.path={write_npz(tmp_path / 'capture.npz')}"
    run(
        system, tmp_path,
        f"train {scene} {' '.join(FAST)} paths.output_dir={tmp_path}/run",
        f"train resume={tmp_path}/run trainer.max_steps=6",
        f"eval ckpt={tmp_path}/run paths.output_dir={tmp_path}/eval",
        f"render ckpt={tmp_path}/run path.num_frames=2 paths.output_dir={tmp_path}/film",
        f"export ckpt={tmp_path}/run what=points paths.output_dir={tmp_path}/points",
        f"doctor {scene} paths.output_dir={tmp_path}/doctor",
        f"table {tmp_path} paths.output_dir={tmp_path}/table",
        f"train -m {scene} {' '.join(FAST_SWEEP)} seed=1,2 final.video=false paths.output_dir={tmp_path}/sweep",
    )  # fmt: skip
    made = {path.name for path in tmp_path.rglob("*")}
    assert made >= {"last.ckpt", "metrics.json", "video.mp4", "doctor.json", "sweep.csv", "points.ply"}


@pytest.mark.minutes
def test_parallel_jobs_save_when_they_are_stopped_on_windows(capture, tmp_path):
    """The stop file alone tells them: SIGTERM would end them at once."""
    env = other_systems.environment("win32", tmp_path)
    jobs = (*FAST_SWEEP, "hydra/launcher=parallel", "seed=0,1,2", "final.video=false", "trainer.max_steps=100000")
    words = ("train", "-m", "scene=npz", f"scene.path={capture}", *jobs, f"paths.output_dir={tmp_path}/sweep")
    process = start_cold("nerf_lightning", *words, env=env, start_new_session=True)
    while process.poll() is None and len(list(tmp_path.glob("sweep/*/checkpoints/last.ckpt"))) < 2:
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    code, output = finished(process)
    assert code == 130, output
    rows = list(csv.DictReader((tmp_path / "sweep" / "sweep.csv").read_text().splitlines()))
    assert [row["state"] for row in rows] == ["stopped", "stopped"], output
    assert output.count("stopped at step") == 2
    for folder in (tmp_path / "sweep").glob("[01]_*"):
        assert f"stopped at step {saved(folder)['global_step']}" in output
    assert not (tmp_path / "sweep" / "2_seed=2" / "run.json").exists()
