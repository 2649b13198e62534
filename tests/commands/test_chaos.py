"""What else may befall a command: killed in any phase, its folder deleted or renamed, stopped, started twice.

It ends well, or with one paragraph; the same command again has the result of one that nothing befell, and leaves
nothing beside it.
"""

import hashlib
import json
import os
import random
import shutil
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from PIL import Image
from support.captures import picture, pose
from support.running import FAST, said, start, start_code

from nerf_lightning.config.messages import paragraph
from nerf_lightning.messages.errors import InputError

QUIET = (
    "trainer.num_threads=1", "final.evaluate=false", "final.video=false", "logger=none",
    "callbacks.validation_pictures.every_steps=1000", "callbacks.ray_histograms.every_steps=1000",
)  # fmt: skip


@dataclass(frozen=True)
class Phase:
    """A command, the function whose run is the phase, and what is looked at afterwards."""

    function: str
    arguments: tuple[str, ...]
    results: str = "*"
    """Files that the command writes; the others of its folder only must not be more."""


PHASES = {
    "evaluating": Phase(
        "nerf_lightning.evaluation.evaluator:Scoring.score",
        ("eval", "ckpt={last}", "scene=npz", "scene.path={capture}", "trainer.num_threads=1"),
    ),
    "filming": Phase(
        "nerf_lightning.video.frames:FilmFrames.open",
        ("render", "ckpt={last}", "path.num_frames=4", "trainer.num_threads=1"),
    ),
    "filming frames": Phase(
        "nerf_lightning.video.frames:FilmFrames.open",
        ("render", "ckpt={last}", "path.num_frames=4", "format=frames", "trainer.num_threads=1"),
    ),
    "exporting images": Phase(
        "nerf_lightning.export.images:ImagesExport.export",
        ("export", "ckpt={last}", "what=images", "what.max_views=3", "trainer.num_threads=1"),
    ),
    "exporting points": Phase(
        "nerf_lightning.export.points:PointsExport.export",
        ("export", "ckpt={last}", "what=points", "what.min_opacity=0.0", "what.agreement=0", "trainer.num_threads=1"),
    ),
    "exporting a mesh": Phase(
        "nerf_lightning.export.mesh:MeshExport.export",
        ("export", "ckpt={last}", "what=mesh", "what.resolution=16", "what.threshold=1e-9", "what.seen_only=false",
         "trainer.num_threads=1"),
    ),
    "decoding": Phase(
        "nerf_lightning.data.pixels.mapped_store:_make",
        ("train", "scene=transforms", "scene.root={photographs}", "scene.cache_dir={out}/cache", *FAST, *QUIET,
         "trainer.max_steps=1", "resume=auto"),
        "cache/*",
    ),
    "rendering bricks": Phase(
        "nerf_lightning.data.bricks.reader:cached",
        ("train", "scene=bricks", "scene.resolution=8", "scene.num_train=1", "scene.num_val=1", "scene.num_test=1",
         "scene.cache_dir={out}/cache", *FAST, *QUIET, "trainer.max_steps=1", "resume=auto"),
        "cache/*",
    ),
    "finishing": Phase(
        "nerf_lightning.commands.train_job.evaluate_and_film:PostTraining.__call__",
        ("train", "scene=npz", "scene.path={capture}", *FAST, "trainer.num_threads=1", "logger=none", "resume=auto"),
    ),
}  # fmt: skip
# Each a kind of its own; the others share their ways of writing. Where a kill hits it amid a file, and a size (bytes)
# that its files exceed.
QUICK = {
    "evaluating": ("PIL.Image:Image.save", 2500),
    "filming": ("nerf_lightning.video.encoding:_counted", 1000),
    "exporting images": ("nerf_lightning.export.images:write_json", 1000),
    "decoding": ("nerf_lightning.data.pixels.mapped_store:_spots", 2500),
}


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


def run_as_planned(phase, plans, places, out):
    """Run a phase's command once for each plan; return the exit codes and what was said."""
    arguments = [argument.format(out=out, **places) for argument in phase.arguments]
    script = "import runpy; runpy.run_path('tests/support/killed_runs.py', run_name='__main__')"
    process = start_code(script, json.dumps(plans), *arguments, f"paths.output_dir={out}")
    codes, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
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


def never_killed(phase, places, out):
    """Return what a command writes that nothing befalls, and the seconds from the beginning of the phase to the end."""
    codes, told = run_as_planned(phase, [{"phase": phase.function}], places, out)
    assert codes == [0], told
    return content(phase, out), float(out.with_name(f"{out.name}.seconds").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_a_command_that_is_killed_or_cannot_write_ends_the_same_when_it_is_given_again(name, places, tmp_path):
    phase, out, (amid, largest) = PHASES[name], tmp_path / "out", QUICK[name]
    wanted, _ = never_killed(phase, places, tmp_path / "never")
    codes, told = run_as_planned(phase, [{"largest": largest}, {"phase": amid, "after": 0}, None], places, out)
    assert codes == [2, -signal.SIGALRM, 0], told
    assert "Traceback" not in told
    (paragraph,) = [line for line in told.splitlines() if line.startswith("nerf: ")]
    assert str(out) in paragraph
    assert "File too large" in paragraph or "ffmpeg failed" in paragraph
    assert content(phase, out) == wanted, told


@pytest.mark.slow
@pytest.mark.exhaustive
@pytest.mark.parametrize("name", PHASES)
def test_a_command_that_is_killed_at_50_moments_ends_the_same(name, places, tmp_path):
    phase, killed = PHASES[name], 0
    wanted, seconds = never_killed(phase, places, tmp_path / "never")
    for number in range(500):
        # Training follows, where the phase is an early one: more of the moments lie at the beginning.
        out, after = tmp_path / f"killed_{number}", seconds * random.random() ** 3
        codes, told = run_as_planned(phase, [{"phase": phase.function, "after": after}, None], places, out)
        story = f"{after:.6f} s into the phase\n{told}"
        assert codes[0] in (0, -signal.SIGALRM), story
        assert codes[1] == 0, story
        assert "Traceback" not in told, story
        assert content(phase, out) == wanted, story
        killed += codes[0] != 0
        if killed == 50:
            return
    pytest.fail(f"only {killed} of 500 planned kills came before the end")


def train(capture, folder, steps, *more):
    return start(
        "train", "scene=npz", f"scene.path={capture}", *FAST, "trainer.num_threads=1", "final.evaluate=false",
        "final.video=false", "callbacks.validation_pictures.every_steps=7", "resume=auto",
        f"trainer.max_steps={steps}", f"paths.output_dir={folder}", *more,
    )  # fmt: skip


def ended(process):
    output, _ = process.communicate(timeout=300)
    assert "Traceback" not in output, output
    return process.returncode, output


def once_saved(process, folder):
    """Wait until a run has saved, and a random while more."""
    while process.poll() is None and not (folder / "checkpoints" / "last.ckpt").exists():
        time.sleep(0.01)
    time.sleep(random.uniform(0, 0.2))


@pytest.mark.slow
@pytest.mark.parametrize("logger", ["tensorboard", pytest.param("none", marks=pytest.mark.exhaustive)])
def test_a_run_whose_folder_is_renamed_stops_and_goes_on_there(logger, capture, tmp_path):
    process = train(capture, tmp_path / "run", 2000, f"logger={logger}")
    once_saved(process, tmp_path / "run")
    os.rename(tmp_path / "run", tmp_path / "moved")
    code, output = ended(process)
    assert code == 2, output
    (paragraph,) = [line for line in output.splitlines() if line.startswith("nerf: ")]
    assert f"{tmp_path / 'run'} was deleted, moved or renamed while the run was going on" in paragraph
    assert not (tmp_path / "run" / "run.json").exists()
    saved = torch.load(tmp_path / "moved" / "checkpoints" / "last.ckpt", weights_only=True)["global_step"]
    code, output = ended(train(capture, tmp_path / "moved", saved + 1, f"logger={logger}"))
    assert code == 0, output
    assert f"going on from step {saved}" in output


@pytest.mark.slow
@pytest.mark.exhaustive
@pytest.mark.parametrize("number", range(10))
def test_a_run_whose_folder_is_deleted_stops(number, capture, tmp_path):
    process = train(capture, tmp_path / "run", 2000)
    once_saved(process, tmp_path / "run")
    while (tmp_path / "run" / "run.json").exists():  # what is written meanwhile is in the way of the deletion
        shutil.rmtree(tmp_path / "run", ignore_errors=True)
    code, output = ended(process)
    assert code == 2, output
    assert len([line for line in output.splitlines() if line.startswith("nerf: ")]) == 1, output


BACK = """
import sys, time
from nerf_lightning.cli import main as cli

shift, real, calls = float(sys.argv.pop(1)), time.time, []

def shifted():
    calls.append(1)
    return real() + (shift if len(calls) > 20 else 0)

time.time = shifted
cli.main()
"""


@pytest.mark.slow
@pytest.mark.exhaustive
@pytest.mark.parametrize("days", [-1, 400])
def test_a_clock_that_is_set_while_a_run_goes_on_changes_nothing(days, capture, tmp_path):
    weights = []
    for shift in (0, 86400 * days):
        folder = tmp_path / str(shift)
        arguments = (
            "train", "scene=npz", f"scene.path={capture}", *FAST, "trainer.num_threads=1", "trainer.max_steps=20",
            "final.video=false", f"paths.output_dir={folder}",
        )  # fmt: skip
        code, output = ended(start_code(BACK, str(shift), *arguments))
        assert code == 0, output
        assert 0 < json.loads((folder / "run.json").read_text())["seconds"] < 1000
        weights.append(torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"])
    assert all(torch.equal(weights[1][name], value) for name, value in weights[0].items())


@pytest.mark.slow
@pytest.mark.exhaustive
def test_runs_from_the_future_and_the_past_are_gone_on_with(capture, nerf, tmp_path):
    settings = (
        "train", "scene=npz", f"scene.path={capture}", *FAST, *QUIET, f"paths.root_dir={tmp_path}", "resume=auto",
    )  # fmt: skip
    assert nerf(*settings, "trainer.max_steps=5").code == 0
    (note,) = tmp_path.rglob("run.json")
    for steps, when in ((6, 2.0**32), (7, -(2.0**30))):
        for file in tmp_path.rglob("*"):
            os.utime(file, (when, when))
        result = nerf(*settings, f"trainer.max_steps={steps}")
        assert result.code == 0, result.err
        assert json.loads(note.read_text())["finished_at_step"] == steps
    assert list(tmp_path.rglob("run.json")) == [note]


@pytest.mark.skipif(not Path("/proc").exists(), reason="needs a place where nobody can write")
def test_a_cache_that_cannot_be_written_is_one_paragraph(nerf, photographs, tmp_path, monkeypatch):
    settings = ("train", "scene=transforms", f"scene.root={photographs}", *FAST, *QUIET)
    said(
        nerf(*settings, "scene.cache_dir=/proc/self/cache", f"paths.output_dir={tmp_path / 'run'}"),
        "cannot be kept in /proc/self/cache", "scene.cache_dir",
    )  # fmt: skip
    assert not (tmp_path / "run").exists()


def test_errors_that_follow_each_other_in_a_circle_are_one_paragraph(tmp_path):
    """The failure that a thread keeps is raised again and again, also while the errors that it caused are handled."""
    first, second = OSError(28, "No space left on device", str(tmp_path)), RuntimeError("closed")
    first.__context__, second.__context__ = second, first
    assert paragraph(first, "train") == (
        f"{tmp_path}: No space left on device. See that the place exists, can be written, and has space left."
    )
    second.__context__ = InputError("The run folder is gone.")
    assert paragraph(first, "train") == "The run folder is gone."
