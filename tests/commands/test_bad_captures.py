"""What a person reads when a capture is broken: one paragraph, exit code 2, and no run folder."""

import pytest
from support.posed_captures import Known, write_colmap, write_llff, write_transforms
from support.running import FAST, said

BROKEN = {
    "colmap": ("sparse/0/images.bin", ("images.bin ends after 100 bytes", "cut short", "nerf poses images=DIR")),
    "llff": ("poses_bounds.npy", ("poses_bounds.npy is not an array of numbers", "imgs2poses", "scene=colmap")),
    "transforms": ("transforms.json", ("transforms.json is not valid json", "line 1", "Export it again")),
}
WRITERS = {"colmap": write_colmap, "llff": write_llff, "transforms": write_transforms}


def train(nerf, tmp_path, kind, *settings):
    where = (f"scene.root={tmp_path}/capture", f"scene.cache_dir={tmp_path}/cache", f"paths.output_dir={tmp_path}/run")
    return nerf("train", f"scene={kind}", *where, *FAST, *settings)


def refused(result, tmp_path, *parts):
    said(result, *parts)
    assert not (tmp_path / "run").exists()
    assert not list((tmp_path / "cache").glob("*.pixels")) if (tmp_path / "cache").exists() else True


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_capture_is_one_paragraph_and_leaves_nothing(nerf, tmp_path, kind):
    WRITERS[kind](tmp_path / "capture", Known())
    name, parts = BROKEN[kind]
    path = tmp_path / "capture" / name
    path.write_bytes(path.read_bytes()[:100])
    refused(train(nerf, tmp_path, kind), tmp_path, *parts)


def test_an_unknown_space_is_no_silent_auto(nerf, tmp_path):
    write_colmap(tmp_path / "capture", Known())
    refused(
        train(nerf, tmp_path, "colmap", "scene.space=unbounded"), tmp_path, "space", "auto", "bounded", "contracted"
    )


def test_a_root_that_is_a_number(nerf, tmp_path):
    refused(train(nerf, tmp_path, "colmap", "scene.root=123"), tmp_path, "root")


def test_a_downscale_that_is_not_whole(nerf, tmp_path):
    write_colmap(tmp_path / "capture", Known())
    refused(train(nerf, tmp_path, "colmap", "scene.downscale=1.5"), tmp_path, "downscale", "1.5")
