"""`nerf export` from end to end: what it writes, and what it says of bad input."""

import json
from pathlib import Path

import numpy as np
import pytest
from support import extensions
from support.running import done, said


@pytest.fixture(scope="module")
def last(finished_run):
    return finished_run / "checkpoints" / "last.ckpt"


def test_the_checkpoint_alone_is_exported_beside_it_or_where_it_is_said(nerf, last, finished_run, tmp_path):
    result = done(nerf("export", f"ckpt={last}", "what=cameras"))
    assert (finished_run / "export" / "transforms.json").is_file()
    assert (finished_run / "export" / "sparse" / "0" / "images.txt").is_file()
    assert str(finished_run / "export" / "transforms.json") in result.out
    result = done(nerf("export", f"ckpt={last}", "what=images", "what.max_views=2", f"paths.output_dir={tmp_path}"))
    written = [line for line in result.out.strip().splitlines() if str(tmp_path) in line]
    assert written
    for line in written:
        assert (tmp_path / line.rpartition("/")[2]).exists(), line
    assert len(json.loads((tmp_path / "images.json").read_text())["views"]) == 2


def test_an_exporter_of_ones_own_gets_the_photographs_that_it_needs_where_there_are_any(nerf, last, capture, tmp_path):
    searched = f"hydra.searchpath=[file://{Path(extensions.__file__).parent / 'conf'}]"
    given = ("export", searched, f"ckpt={last}", "what=mean_colors", f"paths.output_dir={tmp_path}")
    assert nerf(*given).code == 0
    found = json.loads((tmp_path / "mean_colors.json").read_text())
    images = np.load(capture)["images"]
    assert found
    for name, (photographed, _) in found.items():
        np.testing.assert_allclose(photographed, images[int(name)].mean(axis=(0, 1)), atol=3e-3)
    for without, told in (("photographs=false", ""), (f"scene.path={tmp_path}/gone.npz", "gone.npz does not exist")):
        (tmp_path / "mean_colors.json").unlink()
        result = done(nerf(*given, without))
        assert told in result.err
        assert json.loads((tmp_path / "mean_colors.json").read_text()) == {}


def test_bad_input_is_one_paragraph(nerf, last, tmp_path):
    where = f"paths.output_dir={tmp_path}"
    said(nerf("export", f"ckpt={tmp_path}/absent.ckpt", "what=images", where), "There is no checkpoint at")
    unwritten = nerf("export", f"ckpt={last}", "what=images", "paths.output_dir=/dev/null/x")
    said(unwritten, "The output folder /dev/null/x cannot be written", "paths.output_dir=DIR")
    said(nerf("export", f"ckpt={last}", "what=sculpture", where), "sculpture", "cameras")
    several = nerf("export", f"ckpt={last}", "what=images", "what.max_views=many", where)
    said(several, "what.max_views=many is not valid")
    whole = nerf("export", f"ckpt={last}", "what=cameras", "crop=[[-1,-1,-1],[1,1,1]]", where)
    said(whole, "crop: this exporter writes the whole scene")
    said(nerf("export", f"ckpt={last}", "what=cameras", "crop=3", where), "crop=3: give the lower and the upper corner")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("what", "name", "kind"),
    [("cameras", "sparse", "file"), ("images", "normals", "file"), ("images", "images.json", "folder")],
)
def test_what_lies_where_something_is_to_be_written_is_said_before_the_work(nerf, last, tmp_path, what, name, kind):
    place = tmp_path / name
    place.mkdir() if kind == "folder" else place.write_text("something")
    said(nerf("export", f"ckpt={last}", f"what={what}", f"paths.output_dir={tmp_path}"), name, f"is a {kind}", "DIR")
    assert list(tmp_path.iterdir()) == [place]
