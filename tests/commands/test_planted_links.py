"""Links and files of others in an output folder that a person names: nothing is written or removed through them."""

import sys
from pathlib import Path

import pytest
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
    "command",
    [
        ("render", "format=frames", *RENDER),
        ("export", "what=images", "what.max_views=1"),
        ("eval", "evaluation.max_views=1", "evaluation.num_pictures=1"),
    ],
    ids=" ".join,
)
def test_each_folder_that_a_command_makes_is_refused_where_it_is_a_link(
    nerf, finished_run, tmp_path, thesis, monkeypatch, command
):
    """One that vanishes in the end, too; and what the link leads to stays as it is."""
    made, mkdir, before = set(), Path.mkdir, content(thesis)

    def noted(folder, *arguments, **options):
        made.add(folder)
        mkdir(folder, *arguments, **options)

    def written_to(out):
        return nerf(command[0], f"ckpt={finished_run}", *command[1:], f"paths.output_dir={out}")

    with monkeypatch.context() as watched:
        watched.setattr(Path, "mkdir", noted)
        assert written_to(tmp_path / "clean").code == 0
    names = {folder.relative_to(tmp_path / "clean") for folder in made if folder.is_relative_to(tmp_path / "clean")}
    names = sorted({each for name in names for each in (name, *name.parents)} - {Path()})
    assert names
    for number, name in enumerate(names):
        link = tmp_path / str(number) / name
        link.parent.mkdir(parents=True)
        link.symlink_to(thesis)
        result = written_to(tmp_path / str(number))
        # A scratch folder that nobody has marked is refused for whatever it holds.
        said(result, str(link.parent), name.name, "paths.output_dir=DIR")
        assert content(thesis) == before


def test_the_named_folder_itself_may_be_a_link_and_one_that_nobody_named_may_not(nerf, tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk")
    checkpoint = write_checkpoint(tmp_path / "a.ckpt")
    assert nerf("export", f"ckpt={checkpoint}", "what=cameras", f"paths.output_dir={tmp_path}/out").code == 0
    assert (tmp_path / "disk" / "sparse" / "0" / "cameras.txt").is_file()
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    checkpoint = checkpoint.rename(tmp_path / "run" / "checkpoints" / "last.ckpt")
    (tmp_path / "run" / "export").symlink_to(tmp_path / "disk")
    said(nerf("export", f"ckpt={checkpoint}", "what=cameras"), "export is a symbolic link to", "paths.output_dir=DIR")
