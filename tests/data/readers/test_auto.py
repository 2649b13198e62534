"""Folders whose files tell their format."""

import pytest
import torch
from support.captures import write_blender, write_npz
from support.posed_captures import Known, read, write_colmap, write_llff, write_transforms

from nerf_lightning.data.readers.auto import AutoReader
from nerf_lightning.messages.errors import InputError

WRITERS = {
    "colmap": lambda root: write_colmap(root, Known()),
    "colmap in text": lambda root: write_colmap(root, Known(), kind=".txt", where="sparse"),
    "llff": lambda root: write_llff(root, Known()),
    "transforms": lambda root: write_transforms(root, Known()),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_format_is_recognised_and_read_as_by_its_own_reader(tmp_path, caplog, name):
    caplog.set_level("INFO")
    WRITERS[name](tmp_path)
    kind = name.partition(" ")[0]
    ours, theirs = AutoReader(root=str(tmp_path)).read(), read(kind, tmp_path)
    assert torch.equal(ours.cameras.c2w, theirs.cameras.c2w)
    assert ours.background == theirs.background
    assert f"read as scene={kind}, because it has " in caplog.text


def test_the_blender_format_keeps_its_own_defaults(tmp_path):
    write_blender(tmp_path, {"train": 10, "test": 2})
    scene = AutoReader(root=str(tmp_path)).read()
    assert scene.background == "white"
    assert scene.pixels.has_transparency
    assert AutoReader(root=str(tmp_path), background="random").read().background == "random"


def test_settings_go_through_and_those_that_a_format_lacks_are_refused_by_name(tmp_path):
    write_colmap(tmp_path / "colmap", Known())
    assert AutoReader(root=str(tmp_path / "colmap"), hold_every=3).read().splits == (
        read("colmap", tmp_path / "colmap", hold_every=3).splits
    )
    write_blender(tmp_path / "blender", {"train": 10})
    with pytest.raises(InputError, match=r"scene\.hold_every: scene=blender, which .* has no such setting"):
        AutoReader(root=str(tmp_path / "blender"), hold_every=3).read()


def test_a_folder_of_no_known_format_is_told_what_is_looked_for(tmp_path):
    write_npz(tmp_path / "tiny.npz")
    with pytest.raises(InputError, match=r"known format \(blender, .*\): it holds tiny\.npz.*scene=photos"):
        AutoReader(root=str(tmp_path)).read()
