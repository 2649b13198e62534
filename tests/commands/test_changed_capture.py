"""A run goes on with the capture that it has learned from, wherever it is started: another one is refused."""

import json
import shutil

import numpy as np
import pytest
from support.posed_captures import Known, ring, write_colmap
from support.running import FAST, done, said


@pytest.mark.minutes
def test_a_changed_capture_is_not_gone_on_with_unless_that_is_asked_for(nerf, capture, tmp_path):
    """What is named of each change: tests/checkpoints/test_same_capture.py."""
    shutil.copy(capture, tmp_path / "ball.npz")
    command = (
        "train", "scene=npz", f"scene.path={tmp_path}/ball.npz", *FAST, "final.evaluate=false", "final.video=false",
        f"paths.output_dir={tmp_path}/run", "correction=exposure",
    )  # fmt: skip
    done(nerf(*command, "trainer.max_steps=6"))
    content, what = dict(np.load(capture)), "the pose of 1 of 10 photographs (3)"
    content["poses"][3, 0, 3] += 0.5
    np.savez(tmp_path / "ball.npz", **content)
    again = (*command, "trainer.max_steps=12", "resume=auto")
    result = nerf(*again)
    assert result.code == 2, result.err
    assert what in result.err.splitlines()[-1]
    assert "resume_changed_capture=true" in result.err.splitlines()[-1]
    result = nerf(*again, "resume_changed_capture=true")  # the refusal has left the run as it was
    assert result.code == 0, result.err
    assert what in result.out + result.err
    assert "resuming from step 6" in result.out + result.err


def test_eval_finds_a_relative_capture_from_another_folder(nerf, tmp_path, monkeypatch):
    home, elsewhere = tmp_path / "a home", tmp_path / "elsewhere"
    elsewhere.mkdir()
    write_colmap(home / "it's mine", Known(c2w=ring()))
    least = ("final.video=false", "logger=none", "evaluation.num_pictures=0", f"scene.cache_dir={tmp_path}/cache")
    monkeypatch.chdir(home)
    done(nerf("train", "scene=colmap", "scene.root='it\\'s mine'", *FAST, *least, "paths.output_dir=run"))
    monkeypatch.chdir(elsewhere)
    done(nerf("eval", "ckpt='../a home/run/checkpoints/last.ckpt'", "paths.output_dir=.", "evaluation.max_views=2"))
    trained, measured = (json.loads((folder / "metrics.json").read_text()) for folder in (home / "run", elsewhere))
    assert measured["psnr"] == trained["psnr"]
    assert measured["protocol"]["split_hash"] == trained["protocol"]["split_hash"]


def test_what_is_nowhere_is_named_as_it_was_given(nerf, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = nerf("train", "scene=colmap", "scene.root=absent", "paths.output_dir=run")
    said(result, f"The folder absent does not exist in {tmp_path}, where relative ones are looked for")
