"""`nerf export` of meshes, points and volumes from end to end."""

import sys

import numpy as np
import pytest
import trimesh
from support.running import said

from nerf_lightning.cli import main as cli


@pytest.fixture(scope="module")
def last(finished_run):
    return finished_run / "checkpoints" / "last.ckpt"


def test_every_kind_of_export_writes_what_it_says(nerf, last, tmp_path):
    settings = {
        "mesh": ("what.resolution=16", "what.threshold=1e-9", "what.seen_only=false", "what.format=obj"),
        "points": ("min_opacity=0.0", "what.agreement=0", "what.max_views=2"),
        "volume": ("what.resolution=8",),
    }
    for what, more in settings.items():
        result = nerf("export", f"ckpt={last}", f"what={what}", *more, f"paths.output_dir={tmp_path / what}")
        if what == "mesh" and result.code:  # 20 steps may leave a field without any surface in it
            said(result, "There is no surface")
            continue
        assert result.code == 0, result.err
        written = [line for line in result.out.strip().splitlines() if str(tmp_path) in line]
        assert written
        for line in written:
            assert (tmp_path / what).joinpath(line.rpartition("/")[2]).exists(), line
    assert len(trimesh.load(tmp_path / "points" / "points.ply").vertices) == 2 * 16 * 16
    assert np.load(tmp_path / "volume" / "volume.npz")["density"].shape == (9, 9, 9)


def test_bad_input_is_one_paragraph(nerf, last, tmp_path):
    given = ("export", f"ckpt={last}", "what=mesh", f"paths.output_dir={tmp_path}")
    said(nerf(*given, "what.format=3mf"), "what.format=3mf is not valid", "ply, obj, glb, stl")
    said(nerf(*given, "what.resolution=30000"), "what.resolution=30000", "GB", "would fit")
    empty = nerf(*given, "what.threshold=1e9", "what.resolution=32")
    said(empty, "There is no surface", "range from", "1e+09")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("what", "name"), [("mesh", "mesh.ply"), ("points", "points.ply"), ("volume", "volume.npz")])
def test_a_folder_where_a_file_is_to_be_written_is_said_before_the_work(nerf, last, tmp_path, what, name):
    (tmp_path / name).mkdir()
    said(nerf("export", f"ckpt={last}", f"what={what}", f"paths.output_dir={tmp_path}"), name, "is a folder", "DIR")
    assert list(tmp_path.iterdir()) == [tmp_path / name]


def test_a_full_disk_is_one_paragraph_and_leaves_nothing(nerf, last, tmp_path, monkeypatch):
    def full(file, **arrays):
        file.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(np, "savez_compressed", full)
        arguments = ["export", f"ckpt={last}", "what=volume", "what.resolution=8", f"paths.output_dir={tmp_path}"]
        patched.setattr(sys, "argv", ["nerf", *arguments])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    assert stop.value.code == 2
    assert not list(tmp_path.iterdir())
