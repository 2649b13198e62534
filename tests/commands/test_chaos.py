"""What may befall a command: killed at any moment, no room on its disk, its folder renamed.

It ends well, or with one paragraph; the same command again has the result of one that nothing befell, and leaves
nothing beside it.
"""

import hashlib
import json
import os
import random
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from PIL import Image
from support.captures import picture, pose
from support.killed_runs import PLACES
from support.running import FAST, finished, output_of, said, start, start_code
from support.systems import POSIX

from nerf_lightning.config.error_messages import paragraph
from nerf_lightning.messages.errors import InputError

QUIET = (
    "trainer.num_threads=1", "final.evaluate=false", "final.video=false", "logger=none",
    "callbacks.validation_pictures.every_steps=1000", "callbacks.ray_histograms.every_steps=1000",
)  # fmt: skip


@dataclass(frozen=True)
class Phase:
    """A command, the function where a kill hits it amid a file, and a size (bytes) that its files exceed."""

    function: str
    largest: int
    arguments: tuple[str, ...]
    results: str = "*"
    """Files that the command writes; the others of its folder only must not be more."""

    def given(self, **places):
        return [argument.format(**places) for argument in self.arguments]


# Each a way of writing of its own.
PHASES = {
    "evaluating": Phase(
        "PIL.Image:Image.save",
        2500,
        ("eval", "ckpt={last}", "scene=npz", "scene.path={capture}", "trainer.num_threads=1"),
    ),
    "filming": Phase(
        "nerf_lightning.video.encoding:_counted",
        1000,
        ("render", "ckpt={last}", "path.num_frames=4", "trainer.num_threads=1"),
    ),
    "exporting images": Phase(
        "nerf_lightning.export.images:write_json",
        1000,
        ("export", "ckpt={last}", "what=images", "what.max_views=3", "trainer.num_threads=1"),
    ),
    "decoding": Phase(
        "nerf_lightning.data.pixels.mapped_store:_spots",
        2500,
        ("train", "scene=transforms", "scene.root={photographs}", "scene.cache_dir={out}/cache", *FAST, *QUIET,
         "trainer.max_steps=1", "resume=auto"),
        "cache/*",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A capture whose photographs are decoded into the pixel cache."""
    root = tmp_path_factory.mktemp("photographs")
    (root / "images").mkdir()
    for view in range(12):
        Image.fromarray(picture(view, 96, 96)[..., :3]).save(root / "images" / f"{view}.png")
    frames = [{"file_path": f"images/{view}.png", "transform_matrix": pose(view)} for view in range(12)]
    (root / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    return root


@pytest.fixture
def places(capture, finished_run, photographs):
    return {"capture": capture, "photographs": photographs, "last": finished_run / "checkpoints" / "last.ckpt"}


def run_as_planned(plans, arguments, out):
    """Run a command once for each plan; return the exit codes and what was said."""
    script = "import runpy; runpy.run_path('tests/support/killed_runs.py', run_name='__main__')"
    codes = output_of(start_code(script, json.dumps(plans), *arguments, f"paths.output_dir={out}"))
    return json.loads(codes), out.with_name(f"{out.name}.txt").read_text()


def content(phase, out):
    """Return the files of a folder: what is in those that hold results, None for those that hold times."""
    files = {str(file.relative_to(out)): file for file in out.rglob("*") if not file.is_dir()}
    results = {file for file in out.glob(phase.results) if file.is_file()} | {
        file for file in files.values() if phase.results == "*"
    }
    return {name: _read(file) if file in results else None for name, file in files.items()}


def _read(file):
    if file.name == "metrics.json":
        return [{**row, "seconds": None} for row in json.loads(file.read_text())["per_image"]]
    with_times = file.suffix in (".csv", ".log", ".ckpt", ".yaml") or file.name in ("run.json", "lock")
    return None if with_times else hashlib.sha256(file.read_bytes()).hexdigest()


@pytest.mark.minutes
@pytest.mark.parametrize("phase", PHASES.values(), ids=PHASES)
@POSIX
def test_a_command_that_is_killed_or_cannot_write_ends_the_same_when_it_is_given_again(phase, places, tmp_path):
    never, out = tmp_path / "never", tmp_path / "out"
    codes, told = run_as_planned([None], phase.given(out=never, **places), never)
    assert codes == [0], told
    wanted = content(phase, never)
    plans = [{"largest": phase.largest}, {"in": phase.function}, None]
    codes, told = run_as_planned(plans, phase.given(out=out, **places), out)
    assert codes == [2, -signal.SIGKILL, 0], told
    assert "Traceback" not in told
    (paragraph,) = [line for line in told.splitlines() if line.startswith("nerf: ")]
    assert str(out) in paragraph
    assert "File too large" in paragraph or "ffmpeg failed" in paragraph
    assert content(phase, out) == wanted, told


@pytest.mark.minutes
@POSIX
def test_a_run_whose_folder_is_renamed_stops(capture, tmp_path):
    process = start(
        "train", "scene=npz", f"scene.path={capture}", *FAST, "trainer.num_threads=1", "trainer.max_steps=2000",
        "callbacks.validation_pictures.every_steps=7", f"paths.output_dir={tmp_path / 'run'}",
    )  # fmt: skip
    while process.poll() is None and not (tmp_path / "run" / "checkpoints" / "last.ckpt").exists():
        time.sleep(0.01)
    time.sleep(random.uniform(0, 0.2))
    os.rename(tmp_path / "run", tmp_path / "moved")
    code, output = finished(process)
    assert (code, "Traceback" in output) == (2, False), output
    (paragraph,) = [line for line in output.splitlines() if line.startswith("nerf: ")]
    assert f"{tmp_path / 'run'} was deleted, moved or renamed during the run" in paragraph
    assert not (tmp_path / "run" / "run.json").exists()


@pytest.mark.skipif(not Path("/proc").exists(), reason="needs a place where nobody can write")
def test_a_cache_that_cannot_be_written_is_one_paragraph(nerf, photographs, tmp_path, monkeypatch):
    settings = ("train", "scene=transforms", f"scene.root={photographs}", *FAST, *QUIET)
    said(
        nerf(*settings, "scene.cache_dir=/proc/self/cache", f"paths.output_dir={tmp_path / 'run'}"),
        "cannot be cached in /proc/self/cache", "scene.cache_dir",
    )  # fmt: skip
    assert not (tmp_path / "run").exists()


def test_errors_that_follow_each_other_in_a_circle_are_one_paragraph(tmp_path):
    """The failure that a thread keeps is raised again and again, also while the errors that it caused are handled."""
    first, second = OSError(28, "No space left on device", str(tmp_path)), RuntimeError("closed")
    first.__context__, second.__context__ = second, first
    assert paragraph(first, "train") == (
        f"{tmp_path}: No space left on device. Check that the folder exists, is writable, and has free space."
    )
    second.__context__ = InputError("The run folder is gone.")
    assert paragraph(first, "train") == "The run folder is gone."


STEPS = 36
# A start of such a run lasts a second or so once everything is imported.
LONGEST = 1.2


def finish_after(plans, capture, folder):
    """Start, kill as planned, and start again until it ends; return the exit codes and what is left of the run."""
    settings = (
        "train", "scene=npz", f"scene.path={capture}", *FAST, f"trainer.max_steps={STEPS}", "trainer.num_threads=1",
        "scene.background=random", "final.evaluate=false", "final.video=false", "resume=auto", "logger=none",
        "callbacks.validation_pictures.every_steps=1000", "callbacks.checkpoints.every_steps=4",
        "trainer.val_every_steps=12",
    )  # fmt: skip
    codes, told = run_as_planned([*plans, None], settings, folder)
    return codes, told, torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


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
    codes, told, saved = finish_after([], capture, tmp_path_factory.mktemp("never_killed") / "run")
    assert codes == [0], told
    return saved


@pytest.mark.minutes
@POSIX
def test_a_run_that_is_killed_at_any_moment_ends_the_same(capture, tmp_path, never_killed):
    plans, folder = moments(4), tmp_path / "run"
    codes, told, saved = finish_after(plans, capture, folder)
    story = f"{plans}\n{codes}\n{told}"
    assert codes[-1] == 0, story
    assert len(codes) == len(plans) + 1, story
    assert "Traceback" not in told, story
    assert saved["global_step"] == never_killed["global_step"] == STEPS, story
    for key, value in never_killed["state_dict"].items():
        assert torch.equal(saved["state_dict"][key], value), story
    for number, moments_ in never_killed["optimizer_states"][0]["state"].items():
        for name, value in moments_.items():
            assert torch.equal(saved["optimizer_states"][0]["state"][number][name], value), story
    left = {path.name for path in (folder / "checkpoints").iterdir()}
    assert left == {"last.ckpt", "previous.ckpt", "best.ckpt"}, story


@pytest.mark.minutes
@POSIX
def test_a_run_whose_disk_was_full_says_so_and_ends_the_same(capture, tmp_path, never_killed):
    """The failure of the writer beside it reaches the training; in a middle save, and in one of the last."""
    folder = tmp_path / "run"
    codes, told, saved = finish_after([{"full": 3}, {"full": 6}], capture, folder)
    assert codes == [2, 2, 0], told
    assert told.count("nerf: The checkpoint") == 2, told
    assert "No space left on device" in told
    assert f"Free some space, then continue with resume={folder}." in told
    assert "Traceback" not in told
    assert all(torch.equal(saved["state_dict"][key], value) for key, value in never_killed["state_dict"].items())
