"""What else may befall a command: killed in any phase, its folder deleted or renamed, stopped, started twice.

It ends well, or with one paragraph; the same command again has the result of one that nothing befell, and leaves
nothing beside it.
"""

import hashlib
import json
import os
import random
import re
import shutil
import signal
import time
from dataclasses import dataclass

import numpy as np
import pytest
from captures import picture, pose
from PIL import Image
from running import FAST, said, start, start_code

from commands.conftest import Result

QUIET = (
    "trainer.num_threads=1", "final.evaluate=false", "final.video=false", "callbacks.validation_pictures.every_steps=1000",
    "callbacks.ray_histograms.every_steps=1000", "logger=none",
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
        "nerf_lightning.commands.scoring:Scoring.score",
        ("eval", "ckpt={last}", "scene=npz", "scene.path={capture}", "trainer.num_threads=1"),
    ),
    "filming": Phase(
        "nerf_lightning.commands.film_frames:FilmFrames.open",
        ("render", "ckpt={last}", "path.num_frames=4", "trainer.num_threads=1"),
    ),
    "filming frames": Phase(
        "nerf_lightning.commands.film_frames:FilmFrames.open",
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
        "nerf_lightning.data.pixel_file:_make",
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
        "nerf_lightning.commands.finish:Finish.__call__",
        ("train", "scene=npz", "scene.path={capture}", *FAST, "trainer.num_threads=1", "logger=none", "resume=auto"),
    ),
}  # fmt: skip
# Each a kind of its own; the others share their ways of writing.
QUICK = ("evaluating", "filming", "exporting images", "decoding")


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
    script = "import runpy; runpy.run_path('tests/killed_runs.py', run_name='__main__')"
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


def assert_the_same_end(phase, kills, places, folder):
    """Kill a command at random moments of a phase, once for each try, and start it again; return how many were hit."""
    codes, told = run_as_planned(phase, [{"phase": phase.function}], places, folder / "never")
    assert codes == [0], told
    wanted, longest = content(phase, folder / "never"), float((folder / "never.seconds").read_text())
    if "decoding" in phase.arguments or phase.results != "*":
        longest /= 10  # what follows the phase takes longer
    killed = 0
    for number in range(kills):
        out, after = folder / f"killed_{number}", random.uniform(0, longest)
        codes, told = run_as_planned(phase, [{"phase": phase.function, "after": after}, None], places, out)
        story = f"{after:.6f} s into the phase\n{told}"
        assert codes[0] in (0, -signal.SIGALRM), story
        assert codes[1] == 0, story
        assert "Traceback" not in told, story
        assert content(phase, out) == wanted, story
        killed += codes[0] != 0
    return killed


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_a_command_that_is_killed_ends_the_same_when_it_is_given_again(name, places, tmp_path):
    assert_the_same_end(PHASES[name], 1, places, tmp_path)


@pytest.mark.slow
@pytest.mark.exhaustive
@pytest.mark.parametrize("name", PHASES)
def test_a_command_that_is_killed_at_50_moments_ends_the_same(name, places, tmp_path):
    killed = assert_the_same_end(PHASES[name], 50, places, tmp_path)
    print(f"{name}: {killed} kills")
    assert killed >= 10
