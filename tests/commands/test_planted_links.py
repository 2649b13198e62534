"""Links and files of others in an output folder that a person names: nothing is written or removed through them."""

import sys

import pytest
import torch
from support.planted import write_checkpoint
from support.running import said

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need rights there")

RENDER = ("path.num_frames=1", "path.width=8")


@pytest.fixture
def thesis(tmp_path):
    """A folder of somebody's, with the names that this program gives its own files."""
    folder = tmp_path / "thesis"
    for name in ("chapters/1.tex", "video/frame_0000.png", "0/cameras.txt", "film.json", "last.ckpt"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("precious")
    return folder


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("command", "link"),
    [
        (("render", "format=animation", *RENDER), ".frames"),
        (("render", "format=frames", *RENDER), ".frames"),
        (("render", "format=frames", *RENDER), "video"),
        (("export", "what=cameras"), "sparse"),
        (("export", "what=images", "what.max_views=1"), "depth"),
        (("export", "what=images", "what.max_views=1"), "normals"),
        (("prune",), "checkpoints"),
    ],
)
def test_links_in_a_named_folder_are_refused_and_what_they_lead_to_stays(nerf, tmp_path, thesis, command, link):
    checkpoint, before = write_checkpoint(tmp_path / "a.ckpt"), content(thesis)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / link).symlink_to(thesis)
    result = nerf(command[0], f"ckpt={checkpoint}", *command[1:], f"paths.output_dir={tmp_path}/out")
    said(result, f"{tmp_path}/out/{link} is a symbolic link to {thesis}", "Remove the link", "paths.output_dir=DIR")
    assert content(thesis) == before


def test_pictures_of_an_evaluation_go_through_no_link(nerf, finished_run, tmp_path, thesis):
    before = content(thesis)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "images").symlink_to(thesis)
    given = (f"ckpt={finished_run}", "evaluation.max_views=1", f"paths.output_dir={tmp_path}/out")
    said(nerf("eval", *given), "images is a symbolic link to")
    assert content(thesis) == before


def test_the_named_folder_itself_may_be_a_link(nerf, tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk")
    checkpoint = write_checkpoint(tmp_path / "a.ckpt")
    assert nerf("export", f"ckpt={checkpoint}", "what=cameras", f"paths.output_dir={tmp_path}/out").code == 0
    assert (tmp_path / "disk" / "sparse" / "0" / "cameras.txt").is_file()


def test_pruning_writes_over_its_own_file_alone(nerf, tmp_path):
    checkpoint, out = write_checkpoint(tmp_path / "a.ckpt"), tmp_path / "out"
    given = ("prune", f"ckpt={checkpoint}", f"paths.output_dir={out}")
    assert nerf(*given).code == 0
    assert nerf(*given, "by=random").code == 0
    target = out / "checkpoints" / "last.ckpt"
    foreign = torch.load(target, weights_only=True) | {"optimizer_states": [{"state": {}, "param_groups": [{}]}]}
    for theirs in (lambda: target.write_text("precious"), lambda: torch.save(foreign, target)):
        theirs()
        before = content(out)
        said(nerf(*given), f"{target} was not written by nerf prune", "paths.output_dir=DIR")
        assert content(out) == before
