"""One valid file of each kind, damaged: what it is, or one paragraph. Never a traceback, a hang, or full memory."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from support.captures import npz_content, write_blender
from support.configs import composed
from support.fuzzing import fuzzed, harmless
from support.measured_runs import leave_measured_run
from support.mutations import damaged, mutated
from support.planted import write_checkpoint
from support.posed_captures import Known, read, ring, write_colmap, write_llff, write_transforms
from support.scenes import ball_scene
from torch.utils.tensorboard import SummaryWriter

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.checkpoints.record import make_record
from nerf_lightning.config.load_model import load_model
from nerf_lightning.config.scene_overrides import scene_overrides
from nerf_lightning.data.pixels.picture_files import image_size, read_rgba
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.nerf.geometry.cameras import coarse_pixels, rays_through_pixels
from nerf_lightning.runs.curves import read_curves
from nerf_lightning.runs.saved_overrides import former_overrides, former_sweep
from nerf_lightning.runs.sweep_record import SweepRecord, sweep_record
from nerf_lightning.video.paths.base import frame_of
from nerf_lightning.video.paths.keyframe_path import KeyframePath

OVERRIDES = ("scene=blender", "model=fast", "optimizer.lr=2e-3", "scene.root='my data'")
KEYFRAMES = [{"position": [4.0, 0.0, 1.0], "look_at": [0.0, 0.0, 0.5], "fov": 40.0},
             {"position": [0.0, 4.0, 2.0], "look_at": [0.0, 0.0, 0.5]}]  # fmt: skip


@dataclass
class Kind:
    """Files of one kind: sound ones, and who reads them from the folder in which they lie."""

    write: Callable[[Path], Any]
    read: Callable[[Path], Any]
    files: tuple[str, ...]
    cases: int = 30


def usable(scene):
    """Expect that a checkpoint can keep a scene, and that its rays are rays."""
    make_record(scene, "", {})
    rays = rays_through_pixels(scene.cameras, coarse_pixels(scene.cameras), scene.near, scene.far)
    assert bool(torch.isfinite(rays.origins).all() and torch.isfinite(rays.directions).all())


def rendered(folder):
    scene_overrides(str(folder / "a.ckpt"))
    checkpoint = read_checkpoint(folder / "a.ckpt")
    model, scene = load_model(checkpoint), checkpoint.scene
    rays = rays_through_pixels(scene.cameras, coarse_pixels(scene.cameras), scene.near, scene.far)
    assert bool(torch.isfinite(model(rays.map(lambda x: x.flatten(0, 1)[:3]), None, random=None)[-1].rgb).all())


def write_run(folder):
    run = leave_measured_run(folder / "runs" / "a", overrides=OVERRIDES)
    (run / ".hydra" / "config.yaml").write_text(yaml.safe_dump({"scene": {"root": "data"}, "seed": 0}))


def tabled(folder):
    from nerf_lightning.extensions.table.commands import table

    table.run(composed("table", f"runs={folder / 'runs'}", f"paths.output_dir={folder / 'out'}", "force=true"))
    assert "<script" not in (folder / "out" / "table.md").read_text()


def reported(folder):
    from nerf_lightning.extensions.report.commands import report

    settings = (f"run={folder / 'runs' / 'a'}", f"paths.output_dir={folder / 'page'}", "doctor=false")
    report.run(composed("report", *settings))
    assert "<script>alert" not in (folder / "page" / "report.html").read_text()


def charted(folder):
    from nerf_lightning.extensions.report.charts import drawn

    return drawn(read_curves(folder))


def write_events(folder):
    with SummaryWriter(str(folder)) as writer:
        for step in range(5):
            writer.add_scalar("train/psnr_fine", 20.0 + step, step)
    next(folder.iterdir()).rename(folder / "events.out.tfevents.1")


def tame(lines):
    assert not [line for line in lines if "_target_" in line or "${" in line]


def filmed(folder):
    scene = ball_scene()
    cameras = KeyframePath(str(folder / "keys.yaml"), num_frames=5).cameras(frame_of(scene.cameras, scene.aabb))
    assert bool(torch.isfinite(cameras.c2w).all() and (cameras.focal > 0).all())


def decoded(name):
    def decode(folder):
        size, rgba = image_size(folder / name), read_rgba(folder / name)
        assert rgba.shape == (*size[::-1], 4)

    return decode


def capture(kind):
    return lambda folder: usable(read(kind, folder / "capture"))


PICTURE = Image.fromarray(np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8))
KNOWN, MODEL = Known(c2w=ring(4)), ("cameras", "images", "points3D")
OF_A_RUN = ("runs/a/metrics.json", "runs/a/run.json")
KINDS = {
    "checkpoint": Kind(lambda f: write_checkpoint(f / "a.ckpt"), rendered, ("a.ckpt",), 40),
    "transforms": Kind(
        lambda f: write_transforms(f / "capture", KNOWN), capture("transforms"), ("capture/transforms.json",), 40
    ),
    "blender": Kind(
        lambda f: write_blender(f / "capture", {"train": 3, "val": 1, "test": 1}),
        lambda f: usable(BlenderReader(str(f / "capture"), cache_dir=str(f / "cache")).read()),
        ("capture/transforms_train.json", "capture/train/r_1.png"),
    ),
    "colmap": Kind(
        lambda f: write_colmap(f / "capture", KNOWN),
        capture("colmap"),
        tuple(f"capture/sparse/0/{m}.bin" for m in MODEL),
    ),
    "colmap's texts": Kind(
        lambda f: write_colmap(f / "capture", KNOWN, ".txt"),
        capture("colmap"),
        tuple(f"capture/sparse/0/{m}.txt" for m in MODEL),
    ),
    "llff": Kind(lambda f: write_llff(f / "capture", KNOWN), capture("llff"), ("capture/poses_bounds.npy",)),
    "npz": Kind(
        lambda f: np.savez(f / "a.npz", **npz_content(count=4)),
        lambda f: usable(NpzReader(str(f / "a.npz"), cache_dir=str(f / "cache")).read()),
        ("a.npz",),
    ),
    **{
        name: Kind(lambda f, name=name: PICTURE.save(f / name), decoded(name), (name,), 40)
        for name in ("a.png", "a.jpg", "a.tif", "a.webp")
    },
    "keyframes": Kind(
        lambda f: (f / "keys.yaml").write_text(yaml.safe_dump({"keyframes": KEYFRAMES})), filmed, ("keys.yaml",)
    ),
    "resumed run": Kind(
        write_run, lambda f: tame(former_overrides(f / "runs" / "a", [])), ("runs/a/.hydra/overrides.yaml",)
    ),
    "resumed sweep": Kind(
        lambda f: SweepRecord(["seed=0,1", "hydra.launcher.n_jobs=2", *OVERRIDES]).write(f),
        lambda f: tame(former_sweep(f, [])),
        (sweep_record(Path()).as_posix(),),
    ),
}
if find_spec("nerf_lightning.extensions"):
    KINDS["report"] = Kind(write_run, reported, (*OF_A_RUN, "runs/a/.hydra/config.yaml"))
    KINDS["events"] = Kind(write_events, charted, ("events.out.tfevents.1",), 15)
    KINDS["table"] = Kind(write_run, tabled, (*OF_A_RUN, "runs/a/.hydra/overrides.yaml"))


@pytest.fixture(autouse=True)
def _no_sweep(monkeypatch):
    """What these commands ask Hydra for beside the config."""
    monkeypatch.setattr("nerf_lightning.runs.command_folder.job_folder", lambda: None)


def damage(draw, path):
    """Return what a file holds after its values, or its bytes, were changed."""
    if path.suffix in (".json", ".yaml") and draw(st.integers(0, 3)):
        changed = draw(mutated(yaml.safe_load(path.read_text())))
        text = json.dumps(changed) if path.suffix == ".json" else yaml.dump(changed, allow_unicode=True)
        return text.encode("utf-8", "surrogatepass")
    if path.suffix in (".ckpt", ".pth") and draw(st.integers(0, 3)):
        part = path.with_suffix(".part")
        torch.save(draw(mutated(torch.load(path, weights_only=True))), part)
        content = part.read_bytes()
        part.unlink()
        return content
    return draw(damaged(path.read_bytes()))


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file(tmp_path, kind):
    kind = KINDS[kind]
    kind.write(tmp_path)
    kind.read(tmp_path)  # a sound one

    @fuzzed(kind.cases)
    @given(st.data())
    def try_one(data):
        path = tmp_path / data.draw(st.sampled_from(kind.files))
        sound = path.read_bytes()
        content = damage(data.draw, path)
        path.unlink()  # it is mapped, perhaps
        path.write_bytes(content)
        try:
            harmless(kind.read, tmp_path)
        finally:
            path.unlink()
            path.write_bytes(sound)

    try_one()
