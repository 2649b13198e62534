"""`nerf train final.page=true`: exports at the end of a run, and in its report; without them, the run stays."""

import json
import os
import re
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import create_autospec

import pytest
from support.running import FAST, refused, said
from support.shiny_ball import all_around, record_of

from nerf_lightning.commands.export import page_path
from nerf_lightning.commands.train_job import show
from nerf_lightning.commands.train_job.build import TrainJob
from nerf_lightning.doctor.check import Check
from nerf_lightning.extensions.splats.page import PageExport
from nerf_lightning.files.html import SCENE_PAGE
from nerf_lightning.runs.file_steps import read_steps
from nerf_lightning.video.paths.auto import AutoPath
from nerf_lightning.video.paths.keyframes import Keyframe, write_keyframes
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.paths.photograph_path import PhotographPath

LEAST = (*FAST, "logger=none", "final.video=false", "final.evaluate=false", "evaluation.num_pictures=0")


@pytest.fixture
def train(nerf, capture, tmp_path, monkeypatch):
    """Train with a page whose export is another."""

    def call(export, *arguments):
        with monkeypatch.context() as patched:
            patched.setattr(PageExport, "export", export)
            given = ("scene=npz", f"scene.path={capture}", *LEAST, f"paths.output_dir={tmp_path / 'run'}", *arguments)
            return nerf("train", *given)

    return call


def test_the_page_is_made_in_the_run_and_the_report_links_it(train, tmp_path):
    seen = {}

    def export(self, model, record, folder, tile_points, run):
        seen.update(run=run, degree=self.sh_degree, training=model.training)
        (folder / "page.html").write_bytes(SCENE_PAGE)
        return [folder / "page.html"]

    result = train(export, "final.page.sh_degree=1", "final.cameras=true", "final.report=true")
    assert result.code == 0, result.err
    exported = tmp_path / "run" / "export"
    assert f"page         {exported}/page.html" in result.out
    assert f"cameras      {exported}/transforms.json" in result.out
    report = (exported.parent / "report.html").read_text()
    assert 'href="./export/page.html">Open the 3D scene' in report
    assert 'href="./export/transforms.json">transforms.json (0.' in report
    assert "Exported at" not in report
    assert "steps.json" not in report
    assert read_steps(exported) == {"page.html": 4, "transforms.json": 4, "sparse": 4}
    *_, last, longer, view = result.out.splitlines()
    assert longer.startswith(f"train longer nerf train resume={exported.parent} ")
    assert re.fullmatch(rf"look at it   \S*nerf view ckpt={exported.parent}", view)
    found = rf"result +{exported.parent}/report.html: .*\b(\d+) of \1 photographs used. To improve it, .+\."
    assert re.fullmatch(found, last), last
    assert (seen["degree"], seen["training"]) == (1, False)
    assert len(seen["run"].photographs.view_names) == 10
    assert seen["run"].keyframes[-1]["time"] == pytest.approx(10.0)


FLAT, RISING = [20.0] * 40 + [25.0] * 60, [15.0 + 0.1 * row for row in range(100)]
MEMORIZED = [5.0 + value for value in RISING]  # the training views alone


@pytest.mark.parametrize(
    ("steps", "curve", "cure"),
    [
        (43, FLAT, "train longer: 300 s in all."),
        (4000, RISING, "train longer: 300 s in all."),
        (4000, FLAT, "take 6 more photographs."),
        (4000, MEMORIZED, "take 6 more photographs."),
    ],
)
def test_longer_training_is_advised_before_more_photographs_while_it_helps(monkeypatch, steps, curve, cure):
    monkeypatch.setattr(show, "read_curves", lambda folder: {"PSNR/train_fine": (range(100), curve)})
    job = create_autospec(
        TrainJob,
        instance=True,
        scene=SimpleNamespace(view_names=["a"] * 16, left_out=["b"], truth=None),
        config=SimpleNamespace(budget=SimpleNamespace(seconds=30), evaluation=SimpleNamespace(split="test")),
        checks=[Check("coverage", "look", "a gap", "Take 6 more photographs.")],
        system=SimpleNamespace(model=SimpleNamespace(level_names=("proposal", "fine"))),
    )
    line, length = show._result(job, Path("run"), 20.6, steps)
    assert length == ("budget.seconds=300" if "train" in cure else "")
    assert line.endswith(f"20.6 dB on test views; 16 of 17 photographs used. To improve it, {cure}")


def test_whatever_goes_wrong_costs_the_page_alone(train, tmp_path):
    def export(*_):
        raise OSError(28, "No space left on device")

    result = train(export, "final.page=true")
    assert result.code == 0, result.err
    run = tmp_path / "run"
    assert "The run is complete, but final.page failed: OSError: [Errno 28] No space" in result.err
    assert f"nerf export ckpt={run} what=page writes it" in result.err
    assert not (run / "export").exists()
    assert "Traceback" not in result.err
    assert json.loads((run / "run.json").read_text())["finished_at_step"] == 4


@pytest.mark.parametrize(
    ("argument", "parts"),
    [
        ("final.page=huge", ("final.page=huge: give true, or settings", "final.page.KEY=VALUE")),
        ("final.page.seconds=-1.0", ("final.page: what.seconds=-1.0", "0 or more")),
        ("final.page.size=3", ("final.page: nerf export has no setting what.size",)),
        ("final.pages=true", ("nerf train has no setting final.pages",)),
    ],
)
def test_what_cannot_be_exported_is_said_before_the_training(train, tmp_path, argument, parts):
    said(train(PageExport.export, argument), *parts)
    assert not (tmp_path / "run").exists()


def record(folder, name, age, x):
    folder.mkdir(exist_ok=True)
    places = (Keyframe((x + i, 0.0, 1.0), look_at=(0.0, 0.0, 0.0), time=float(i)) for i in range(2))
    write_keyframes(folder / name, list(places))
    os.utime(folder / name, (1e9 - age, 1e9 - age))


def test_what_was_recorded_last_is_played_unless_another_path_is_asked_for(tmp_path):
    scene = record_of(all_around())
    assert len(page_path(AutoPath(), scene, tmp_path)) == 25  # a circle
    record(tmp_path / "viewer", "camera_path_001.yaml", 20, 3.0)
    record(tmp_path / "viewer", "camera_path_002.yaml", 10, 5.0)
    assert [each["position"][0] for each in page_path(AutoPath(), scene, tmp_path)] == [5.0, 6.0]
    assert len(page_path(Orbit(), scene, tmp_path)) == 25


def test_what_cannot_be_played_is_said_and_a_path_is_made(tmp_path, caplog):
    scene = record_of(all_around())
    record(tmp_path / "viewer", "camera_path_001.yaml", 10, 5.0)
    (tmp_path / "viewer" / "camera_path_001.yaml").write_text("keyframes: 3")
    assert len(page_path(AutoPath(), scene, tmp_path)) == 25
    assert "does not play the path that was recorded last" in caplog.text
    refused(page_path, PhotographPath(views=["absent"]), scene, tmp_path, parts=("absent",))


def test_nothing_is_taken_through_a_link(tmp_path):
    record(tmp_path / "elsewhere", "camera_path_001.yaml", 10, 5.0)
    run = tmp_path / "run"
    run.mkdir()
    (run / "viewer").symlink_to(tmp_path / "elsewhere")
    assert len(page_path(AutoPath(), record_of(all_around()), run)) == 25


def test_a_page_shows_the_photographs_and_what_is_known_of_the_run(nerf, finished_run, tmp_path):
    where = f"paths.output_dir={tmp_path}"
    result = nerf(
        "export", f"ckpt={finished_run}", "what.num_splats=200", "what.max_views=1", "what.seconds=0.2", where
    )
    if result.code:  # 20 steps may leave a field without anything in it
        said(result, "There is no surface to put splats on")
        return
    assert "dB on 1 test view; the model, compared in the same way" in result.out
    assert f"{tmp_path}/page.html" in result.out
    text = (tmp_path / "page.html").read_text()
    parameters = json.loads((finished_run / "metrics.json").read_text())["origin"]["parameters"]
    assert f"<th>parameters</th><td>{parameters:,}</td>" in text
    assert text.count('alt="ball_') + text.count('<button type="button" data-view') >= 8
    (tmp_path / "page.html").write_text("something else")
    said(
        nerf("export", f"ckpt={finished_run}", "what=page", where), "page.html", "would be lost", "paths.output_dir=DIR"
    )
