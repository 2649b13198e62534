"""A run stopped anywhere and resumed ends with the weights, bit for bit, of one that was never stopped."""

import json
import random
import shutil
import signal
import time

import pytest
import torch
from support.running import FAST, start
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

STEPS = 110
FEWER_STEPS = 70  # where it is stopped once


def arguments(capture, folder, steps=STEPS, threads=1):
    return (
        "train", "scene=npz", f"scene.path={capture}", *FAST, f"trainer.max_steps={steps}",
        f"trainer.num_threads={threads}",
        "scene.background=random", "final.evaluate=false", "final.video=false", "resume=auto",
        "callbacks.validation_pictures.every_steps=1000", "callbacks.checkpoints.every_steps=7",
        "trainer.val_every_steps=14", f"paths.output_dir={folder}",
    )  # fmt: skip


def state(folder):
    content = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    return content["global_step"], content["state_dict"], content["optimizer_states"][0]["state"]


def assert_same_to_the_bit(ours, theirs):
    assert ours[0] == theirs[0]
    assert all(torch.equal(ours[1][key], theirs[1][key]) for key in theirs[1])
    for parameter, moments in theirs[2].items():
        assert all(torch.equal(ours[2][parameter][name], value) for name, value in moments.items())


def steps_saved(folder):
    last = folder / "checkpoints" / "last.ckpt"
    return torch.load(last, weights_only=True)["global_step"] if last.exists() else 0


def never_stopped_on(threads, capture, tmp_path_factory, steps=STEPS):
    folder = tmp_path_factory.mktemp("never_stopped") / "run"
    process = start(*arguments(capture, folder, steps, threads))
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    return state(folder)


@pytest.fixture(scope="module")
def never_stopped(capture, tmp_path_factory):
    return never_stopped_on(1, capture, tmp_path_factory)


@pytest.fixture(scope="module")
def never_stopped_soon_over(capture, tmp_path_factory):
    return never_stopped_on(1, capture, tmp_path_factory, FEWER_STEPS)


@pytest.fixture(scope="module")
def never_stopped_on_two_threads(capture, tmp_path_factory):
    return never_stopped_on(2, capture, tmp_path_factory)


def run_and_stop(capture, folder, how, after_step, threads=1, steps=STEPS):
    """Start or resume; stop as soon as `after_step` is saved; return what was said and the exit code."""
    after_step = max(after_step, steps_saved(folder) + 7)
    process = start(*arguments(capture, folder, steps, threads))
    while process.poll() is None and steps_saved(folder) < after_step:
        time.sleep(0.02)
    if process.poll() is None:
        process.send_signal(how)
    output, _ = process.communicate(timeout=300)
    return process.returncode, output


def assert_the_same_end(capture, folder, never_stopped, threads):
    order = random.Random(time.time_ns())
    points = sorted(order.sample(range(7, STEPS - 60), 3))
    for point, how in zip(points, [signal.SIGKILL, signal.SIGTERM, signal.SIGINT], strict=True):
        code, output = run_and_stop(capture, folder, how, point, threads)
        assert code in (-how, 128 + how), (points, output)
        if how == signal.SIGKILL:
            killed_at = steps_saved(folder)
        else:
            assert "go on with: nerf train" in output
            assert f"resume={folder}" in output
    process = start(*arguments(capture, folder, threads=threads))
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    assert "going on from step" in output
    assert_same_to_the_bit(state(folder), never_stopped)
    steps = [
        event.step for event in EventAccumulator(str(folder / "tensorboard")).Reload().Scalars("Training loss/sum")
    ]
    assert steps == list(range(5, STEPS + 1, 5)), "TensorBoard shows each step once"
    validated = [
        event.step for event in EventAccumulator(str(folder / "tensorboard")).Reload().Scalars("PSNR/validation")
    ]
    assert len(set(validated)) == len(validated)
    # Killed between a save and the validation of the same step, it has lost that one.
    assert {14 * number for number in range(1, STEPS // 14)} - {killed_at} <= set(validated)


@pytest.mark.slow
@pytest.mark.exhaustive  # killed once: test_kill.py; the packed model, killed and stopped: test_fast_path.py
def test_a_run_that_is_killed_and_stopped_again_and_again_ends_the_same(capture, tmp_path, never_stopped):
    assert_the_same_end(capture, tmp_path / "run", never_stopped, 1)


@pytest.mark.slow
@pytest.mark.exhaustive
def test_a_run_on_two_threads_ends_the_same(capture, tmp_path, never_stopped_on_two_threads):
    assert_the_same_end(capture, tmp_path / "run", never_stopped_on_two_threads, 2)


@pytest.mark.slow
def test_a_run_is_resumed_by_its_folder_alone(capture, tmp_path, never_stopped_soon_over):
    """The command that a stopped run prints: no override needs to be repeated."""
    folder = tmp_path / "run"
    code, output = run_and_stop(capture, folder, signal.SIGTERM, 14, steps=FEWER_STEPS)
    assert code == 143, output
    assert f"go on with: nerf train resume={folder}" in output
    process = start("train", f"resume={folder}")
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    assert_same_to_the_bit(state(folder), never_stopped_soon_over)


@pytest.mark.parametrize(("planned", "asked", "end"), [(20, 8, 20), (24, 22, 24), (20, 22, 22)])
def test_a_run_is_not_made_shorter_than_it_was_to_be(nerf, finished_run, tmp_path, planned, asked, end):
    run = tmp_path / "run"
    shutil.copytree(finished_run, run)
    note = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(note | {"num_steps": planned}))
    quick = ("final.evaluate=false", "final.video=false")
    result = nerf("train", f"resume={run}", f"trainer.max_steps={asked}", *quick)
    assert result.code == 0, result.err
    assert (f"goes on to step {planned}, not to {asked}" in result.err) == (asked < planned)
    note = json.loads((run / "run.json").read_text())
    assert (note["num_steps"], note["finished_at_step"], state(run)[0]) == (end, end, end)


@pytest.mark.slow
def test_a_finished_run_can_be_extended_and_equals_a_long_one(capture, tmp_path, never_stopped_soon_over):
    folder = tmp_path / "run"
    for steps in (30, FEWER_STEPS):
        extra = (f"scheduler.decay_steps={FEWER_STEPS}",)  # null stretches the schedule over the new length
        process = start(*arguments(capture, folder, steps), *extra)
        output, _ = process.communicate(timeout=300)
        assert process.returncode == 0, output
    assert_same_to_the_bit(state(folder), never_stopped_soon_over)
