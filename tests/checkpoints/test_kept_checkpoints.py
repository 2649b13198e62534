"""Checkpoints of released versions open and render as they did; one of each kind of model.

`python tests/checkpoints/test_kept_checkpoints.py` writes those of this version. It is for a new release, or a new kind
of model; the files of a released version are never written again.
"""

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.orbit import orbit_scene

import nerf_lightning as nl
from nerf_lightning.checkpoints.format import FILE

KEPT = Path(__file__).parent / "kept"
NERF = (
    *("encoder.num_frequencies=3", "direction_encoder.num_frequencies=1", "field.width=8", "field.depth=2"),
    "field.skip=1",
)
HASH = ("encoder.num_levels=2", "encoder.log2_table_size=5", "encoder.max_resolution=32", "field.width=8")
GRID = ("model.levels.fine.sampler.resolution=8", "model.levels.fine.sampler.num_steps=16")
PROPOSAL = "model.levels.proposal.field"
KINDS = {
    "nerf": ("model=nerf_tiny", *NERF),
    "nerf_occupancy": ("model=nerf_occupancy", *NERF, *GRID),
    "fast": ("model=fast_small", *HASH, *GRID),
    "fast_dense": ("model=fast_dense", *HASH, *GRID),
    "fast_proposal": (
        *("model=fast_proposal", *HASH, f"{PROPOSAL}.position_encoder.num_levels=2", f"{PROPOSAL}.width=8"),
        f"{PROPOSAL}.position_encoder.log2_table_size=5",
    ),
    "view_transformer": (
        *("model=view_transformer_tiny", "model.width=8", "model.image_width=4", "model.image_features=4"),
    ),
}
SMALL = ("trainer=cpu", "trainer.precision=32-true", "data.batch_rays=64", "data.crop_steps=0")


def scene_for(kind):
    return orbit_scene(space="contracted" if kind == "fast_proposal" else "bounded")


def rendered(file):
    model = nl.load(file, "trainer=cpu")
    if model.module.needs_photographs:
        model = model.of_scene(scene_for(file.stem))
    picture = model.render(2)
    return [float(mean) for mean in (*picture.rgb.mean(dim=(0, 1)), picture.depth.mean(), picture.opacity.mean())]


@pytest.mark.parametrize("file", sorted(KEPT.glob("*/*.ckpt")), ids=lambda file: f"{file.parent.name}-{file.stem}")
def test_a_checkpoint_of_a_released_version_renders_as_it_did(file):
    if file.stem == "view_transformer":
        pytest.importorskip("nerf_lightning.extensions.view_transformer", reason="an extension, which is not here")
    expected = json.loads((file.parent / "rendered.json").read_text())[file.stem]
    assert rendered(file) == pytest.approx(expected, abs=2e-3, rel=1e-3)  # rendered in bfloat16, float32 in places


def test_there_is_one_of_each_kind_and_they_are_small():
    files = list(KEPT.glob("1.0.0/*.ckpt"))
    assert {file.stem for file in files} == set(KINDS)
    assert sum(file.stat().st_size for file in files) < 300_000


def remake():
    folder = KEPT / nl.__version__
    folder.mkdir(parents=True, exist_ok=True)
    for kind, settings in KINDS.items():
        run = nl.build_run(*settings, *SMALL, scene=scene_for(kind))
        for _ in run.steps(3):
            pass
        run.save(folder / f"{kind}.ckpt")
        content = torch.load(folder / f"{kind}.ckpt", weights_only=True)
        torch.save({key: content[key] for key in FILE}, folder / f"{kind}.ckpt")  # without what training goes on from
    results = {kind: [round(mean, 5) for mean in rendered(folder / f"{kind}.ckpt")] for kind in KINDS}
    (folder / "rendered.json").write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    remake()
