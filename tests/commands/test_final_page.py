"""`nerf train final.page=true`: the page at the end of a run, and in its report; without it, the run stays."""

import json
import shutil

import pytest
from support.measured_runs import leave_measured_run
from support.running import FAST, said

from nerf_lightning.export.page import PageExport
from nerf_lightning.export.page_file import MARK

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

    def export(self, model, record, folder, tile_points):
        seen.update(beside=self.beside, quality=self.quality, training=model.training)
        (folder / "page.html").write_bytes(MARK)
        return [folder / "page.html"]

    result = train(export, "final.page=small", "final.report=true")
    assert result.code == 0, result.err
    run = tmp_path / "run"
    assert f"page         {run}/page.html" in result.out
    assert 'href="./page.html"' in (run / "report.html").read_text()
    assert (seen["quality"], seen["training"]) == ("small", False)
    assert len(seen["beside"].photographs.view_names) == 10
    assert seen["beside"].keyframes[-1]["time"] == pytest.approx(10.0)


def test_whatever_goes_wrong_costs_the_page_alone(train, tmp_path):
    def export(*_):
        raise OSError(28, "No space left on device")

    result = train(export, "final.page=true")
    assert result.code == 0, result.err
    run = tmp_path / "run"
    assert "The run is whole, but its page (final.page) could not be made: OSError: [Errno 28] No space" in result.err
    assert f"nerf export ckpt={run} what=page makes it" in result.err
    assert "Traceback" not in result.err
    assert json.loads((run / "run.json").read_text())["finished_at_step"] == 4


def test_what_cannot_become_a_page_is_said_before_the_training(train, tmp_path):
    said(train(PageExport.export, "final.page=huge"), "final.page=huge", "small, medium, large")
    assert not (tmp_path / "run").exists()


def test_the_report_links_the_newest_page_from_wherever_it_lies(nerf, tmp_path):
    run = leave_measured_run(tmp_path / 'a "run" <b>')
    target = tmp_path / "elsewhere" / "report.html"
    given = (run, "doctor=false", f"paths.output_dir={target.parent}")
    (run / "page.html").write_text("<html>somebody's own</html>")
    assert nerf("report", *given).code == 0
    assert 'id="scene"' not in target.read_text()
    (run / "export").mkdir()
    (run / "export" / "page.html").write_bytes(MARK)
    assert nerf("report", *given).code == 0
    assert 'href="./../a%20%22run%22%20%3Cb%3E/export/page.html"' in target.read_text()
    shutil.copy(run / "export" / "page.html", run / "page.html")
    assert nerf("report", *given).code == 0
    assert "%3Cb%3E/page.html" in target.read_text()
