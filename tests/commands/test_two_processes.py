"""Two processes at once: one run folder is held by one, one cache is built by one."""

import subprocess

import pytest
from support.running import FAST, start, start_code

BUILD_BRICKS = """
import sys
import nerf_lightning.data.bricks.reader as module
from nerf_lightning.data.bricks import cache

count, plain = 0, cache._save


def counted(path, rendered):
    global count
    count += 1
    return plain(path, rendered)


cache._save = counted
reader = module.BricksReader(resolution=8, num_train=2, num_val=1, num_test=1, cache_dir=sys.argv[1])
print("ready", flush=True)
sys.stdin.read()
scene = reader.read()
print(count, int(scene.pixels.rgba.long().sum()))
"""


def test_two_processes_build_one_scene_once(tmp_path):
    builders = [start_code(BUILD_BRICKS, tmp_path, stdin=subprocess.PIPE, stderr=None) for _ in range(2)]
    assert [builder.stdout.readline() for builder in builders] == ["ready\n"] * 2
    for builder in builders:
        builder.stdin.close()
    results = []
    for builder in builders:
        with builder:
            results.append([int(number) for number in builder.stdout.read().split()])
        assert builder.returncode == 0
    assert sorted(count for count, _ in results) == [0, 1]
    assert results[0][1] == results[1][1] > 0
    assert len(list(tmp_path.glob("*.npz"))) == 1


@pytest.mark.slow
def test_two_runs_never_write_into_one_folder(capture, tmp_path):
    arguments = (
        "train", "scene=npz", f"scene.path={capture}", *FAST, "trainer.max_steps=150", "final.evaluate=false",
        "final.video=false", "resume=auto", "logger=none", f"paths.output_dir={tmp_path}/run",
    )  # fmt: skip
    runs = [start(*arguments) for _ in range(2)]
    said = {}
    for run in runs:
        output, _ = run.communicate(timeout=300)
        said[run.returncode] = output
    assert sorted(said) == [0, 2], said
    assert f"{tmp_path}/run is in use by another process" in said[2]
    assert "Traceback" not in said[2]
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").is_file()
