"""Captures whose place was given relative to where a run was started, evaluated from elsewhere."""

import json

import pytest
from support.posed_captures import Known, ring, write_colmap, write_llff, write_transforms
from support.running import FAST

WRITERS = {"colmap": write_colmap, "llff": write_llff, "transforms": write_transforms}
LEAST = ("final.video=false", "logger=none", "evaluation.num_pictures=0")


@pytest.mark.parametrize("kind", WRITERS)
def test_eval_finds_a_relative_capture_from_another_folder(nerf, tmp_path, monkeypatch, kind):
    home, elsewhere = tmp_path / "a home", tmp_path / "elsewhere"
    elsewhere.mkdir()
    WRITERS[kind](home / "it's mine", Known(c2w=ring()))
    kept = f"scene.cache_dir={tmp_path}/cache"
    monkeypatch.chdir(home)
    result = nerf(
        "train", f"scene={kind}", "scene.root='it\\'s mine'", kept, *FAST, *LEAST, "paths.output_dir=run"
    )  # fmt: skip
    assert result.code == 0, result.err
    monkeypatch.chdir(elsewhere)
    result = nerf("eval", "ckpt='../a home/run/checkpoints/last.ckpt'", "paths.output_dir=.", "evaluation.max_views=2")
    assert result.code == 0, result.err
    trained, measured = (json.loads((folder / "metrics.json").read_text()) for folder in (home / "run", elsewhere))
    assert measured["psnr"] == trained["psnr"]
    assert measured["protocol"]["split_hash"] == trained["protocol"]["split_hash"]


def test_what_is_nowhere_is_named_as_it_was_given(nerf, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = nerf("train", "scene=colmap", "scene.root=absent", "paths.output_dir=run")
    assert result.code == 2
    assert f"The folder absent does not exist in {tmp_path}, where relative ones are looked for" in result.err
