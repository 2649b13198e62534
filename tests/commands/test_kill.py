"""Killed with SIGKILL at any moment, a run goes on and ends with the same weights to the bit; two share nothing."""

import json
import random
import time

import pytest
import torch
from support.killed_runs import PLACES
from support.running import FAST, output_of, start_code
from support.systems import POSIX

pytestmark = POSIX
STEPS = 36
# A start of such a run lasts a second or so once everything is imported.
LONGEST = 1.2


def finish_after(plans, capture, folder):
    """Start, kill as planned, and start again until it ends; return the exit codes and what is left of the run."""
    arguments = (
        "train", "scene=npz", f"scene.path={capture}", *FAST, f"trainer.max_steps={STEPS}", "trainer.num_threads=1",
        "scene.background=random", "final.evaluate=false", "final.video=false", "resume=auto", "logger=none",
        "callbacks.validation_pictures.every_steps=1000", "callbacks.checkpoints.every_steps=4",
        "trainer.val_every_steps=12", f"paths.output_dir={folder}",
    )  # fmt: skip
    script = "import runpy; runpy.run_path('tests/support/killed_runs.py', run_name='__main__')"
    codes = output_of(start_code(script, json.dumps([*plans, None]), *arguments))
    said = (folder.parent / f"{folder.name}.txt").read_text()
    content = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    return json.loads(codes), said, content


def moments(count):
    """Half of them anywhere in time, half at chosen places of one of the first saves of a start."""
    order = random.Random(time.time_ns())
    in_time = [{"after": order.uniform(0.05, LONGEST)} for _ in range(count - count // 2)]
    at_places = [{"in": PLACES[number % len(PLACES)], "call": order.randint(1, 6)} for number in range(count // 2)]
    plans = in_time + at_places
    order.shuffle(plans)
    return plans


@pytest.fixture(scope="module")
def never_killed(capture, tmp_path_factory):
    codes, said, content = finish_after([], capture, tmp_path_factory.mktemp("never_killed") / "run")
    assert codes == [0], said
    return content


@pytest.mark.minutes
def test_a_run_that_is_killed_at_any_moment_ends_the_same(capture, tmp_path, never_killed):
    plans, folder = moments(4), tmp_path / "run"
    codes, said, content = finish_after(plans, capture, folder)
    story = f"{plans}\n{codes}\n{said}"
    assert codes[-1] == 0, story
    assert len(codes) == len(plans) + 1, story
    assert "Traceback" not in said, story
    assert content["global_step"] == never_killed["global_step"] == STEPS, story
    for key, value in never_killed["state_dict"].items():
        assert torch.equal(content["state_dict"][key], value), story
    for number, moments_ in never_killed["optimizer_states"][0]["state"].items():
        for name, value in moments_.items():
            assert torch.equal(content["optimizer_states"][0]["state"][number][name], value), story
    left = {path.name for path in (folder / "checkpoints").iterdir()}
    assert left == {"last.ckpt", "previous.ckpt", "best.ckpt"}, story


@pytest.mark.slow
def test_a_run_whose_disk_was_full_says_so_and_ends_the_same(capture, tmp_path, never_killed):
    """The failure of the writer beside it reaches the training; in a middle save, and in one of the last."""
    folder = tmp_path / "run"
    codes, said, content = finish_after([{"full": 3}, {"full": 6}], capture, folder)
    assert codes == [2, 2, 0], said
    assert said.count("nerf: The checkpoint") == 2, said
    assert "No space left on device" in said
    assert f"Free some space, then continue with resume={folder}." in said
    assert "Traceback" not in said
    assert all(torch.equal(content["state_dict"][key], value) for key, value in never_killed["state_dict"].items())
