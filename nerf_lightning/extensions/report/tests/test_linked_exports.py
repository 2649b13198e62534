"""Exports of a run are linked from its report, with the step that they show."""

import os
from urllib.parse import unquote_to_bytes

import pytest
from support.measured_runs import leave_measured_run

from nerf_lightning.extensions.report.page import Report
from nerf_lightning.extensions.report.read_run import _add_exports, address_from
from nerf_lightning.files.html import SCENE_PAGE
from nerf_lightning.runs.file_steps import record_steps


@pytest.mark.parametrize(
    ("shown", "last", "age"),
    [
        (200, 1270, "Exported at step 200; training has reached step 1,270."),
        *((270, 270, ""), (None, 270, ""), (200, None, "")),
    ],
)
def test_the_report_says_which_step_an_export_shows_if_that_is_known_and_not_the_last(tmp_path, shown, last, age):
    files = [tmp_path / "export" / name for name in ("page.html", "points.ply")]
    files[0].parent.mkdir()
    for file, content in zip(files, (SCENE_PAGE, b""), strict=True):
        file.write_bytes(content)
    if shown is not None:
        record_steps(files[0].parent, files, shown)
    report = Report("a run")
    _add_exports(report, tmp_path / "export", tmp_path, last)
    assert (report.scene_page, report.scene_page_age) == ("./export/page.html", age)
    assert report.exports == [(f"points.ply (0 MB{age and ', step 200 of 1,270'})", "./export/points.ply")]


def test_the_report_links_the_page_from_wherever_it_lies(nerf, tmp_path):
    run = leave_measured_run(tmp_path / 'a "run" <b>')
    target = tmp_path / "elsewhere" / "report.html"
    given = (run, "doctor=false", f"paths.output_dir={target.parent}")
    (run / "export").mkdir()
    (run / "export" / "page.html").write_text("<html>somebody's own</html>")
    assert nerf("report", *given).code == 0
    assert "page.html" not in target.read_text()
    (run / "export" / "page.html").write_bytes(SCENE_PAGE)
    assert nerf("report", *given).code == 0
    assert 'href="./../a%20%22run%22%20%3Cb%3E/export/page.html"' in target.read_text()


def test_a_page_is_linked_whatever_its_run_is_called(tmp_path):
    run = tmp_path / os.fsdecode(b"r\xff")
    address = address_from(run / "export" / "page.html", tmp_path)
    assert address == "./r%FF/export/page.html"
    assert tmp_path / os.fsdecode(unquote_to_bytes(address)) == run / "export" / "page.html"
