"""Windows and macOS, where nothing was ever run: what the stand-in shows of them."""

import os
import subprocess
import sys

import pytest
from support.captures import write_npz
from support.running import FAST, REPOSITORY

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Linux stands in for the others")
SYSTEMS = pytest.mark.parametrize("system", ["win32", "darwin"])
COLLECT = """
import sys
sys.path[:0] = ["tests", "."]
from support import other_systems
other_systems.install(sys.argv[1])
import pytest
sys.exit(pytest.main(["--collect-only", "-q", "-m", "", "-p", "no:cacheprovider"]))
"""


@SYSTEMS
@pytest.mark.minutes
def test_every_test_is_collected(system):
    """An error at one import would end the whole run."""
    done = subprocess.run([sys.executable, "-c", COLLECT, system], cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]


@SYSTEMS
@pytest.mark.minutes
def test_the_main_commands_do_their_work(system, tmp_path):
    """Among them training again over what is there: for Windows, files that are open stay where they are."""
    scene = f"scene=npz scene.path={write_npz(tmp_path / 'capture.npz')}"
    commands = (
        f"train {scene} {' '.join(FAST)} paths.output_dir={tmp_path}/run",
        f"train resume={tmp_path}/run trainer.max_steps=6",
        f"eval ckpt={tmp_path}/run paths.output_dir={tmp_path}/eval",
        f"render ckpt={tmp_path}/run path.num_frames=2 paths.output_dir={tmp_path}/film",
        f"export ckpt={tmp_path}/run what=points paths.output_dir={tmp_path}/points",
        f"doctor {scene} paths.output_dir={tmp_path}/doctor",
        f"table {tmp_path} paths.output_dir={tmp_path}/table",
        f"train -m {scene} {' '.join(FAST)} seed=1,2 final.video=false paths.output_dir={tmp_path}/sweep",
    )
    done = subprocess.run(
        [sys.executable, "tests/support/other_systems.py", system, str(tmp_path)], cwd=REPOSITORY, capture_output=True,
        input="\n".join(commands), text=True, env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-5000:]
    made = {path.name for path in tmp_path.rglob("*")}
    assert made >= {"last.ckpt", "metrics.json", "video.mp4", "doctor.json", "sweep.csv", "points.ply"}
