"""Distances triangulated from matches: near to the truth, of training views alone, and none where nothing agrees."""

from dataclasses import replace

import pytest
import torch

import nerf_lightning as nl
from nerf_lightning.commands.train_job.build import assemble_job
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.instantiate import build
from nerf_lightning.doctor.triangulation import FEWEST, triangulated, with_distances


@pytest.fixture(scope="module")
def bricks():
    """Some views from one side."""
    scene = build(compose_config("train", ["scene=bricks"]).config.scene).read()
    apart = (scene.cameras.c2w[:, :, 3] - scene.cameras.c2w[0, :, 3]).norm(dim=-1)
    near, held = apart.argsort()[:10].tolist(), tuple(apart.argsort()[10:12].tolist())
    return replace(scene, splits={"train": tuple(sorted(near)), "val": held, "test": held})


def errors(scene, found):
    """Relative errors of the distances."""
    depth = torch.empty(len(found))
    for view in found.pixels.view.unique().tolist():
        there = found.pixels.view == view
        truth = scene.truth(view).depth.view(int(scene.cameras.height[view]), -1)
        depth[there] = truth[found.pixels.y[there], found.pixels.x[there]]
    return (found.distance / depth - 1.0).abs()


def test_distances_are_those_of_the_surfaces_that_training_views_show(bricks):
    found = triangulated(bricks)
    assert len(found) >= FEWEST * len(bricks.splits["train"])
    assert torch.isin(found.pixels.view, torch.tensor(bricks.splits["train"])).all()
    off = errors(bricks, found)
    assert float(off.median()) < 0.02
    assert float((off < 0.1).float().mean()) > 0.8
    assert float(off[found.certainty > 0.8].median()) <= float(off.median())


def test_cameras_that_contradict_the_photographs_tell_nothing(bricks):
    turned = bricks.cameras.c2w[torch.randperm(len(bricks.cameras.c2w), generator=torch.Generator().manual_seed(0))]
    assert triangulated(replace(bricks, cameras=replace(bricks.cameras, c2w=turned))) is None


def test_what_a_capture_knows_itself_stays(bricks):
    known = with_distances(bricks)
    assert known.depths is not None
    assert known.depths.from_pictures
    assert with_distances(known) is known
    assert with_distances(replace(bricks, capture_of=(0,) * len(bricks.view_names))).depths is None


@pytest.mark.minutes
@pytest.mark.parametrize(
    ("space", "overrides", "learns"),
    [
        ("contracted", ("model=auto",), True),
        ("contracted", ("model=auto", "loss=proposal"), False),
        ("bounded", ("model=auto",), False),
    ],
)
def test_a_run_has_distances_where_its_loss_takes_them(bricks, space, overrides, learns):
    record = replace(bricks, space=space)
    run = nl.build_run(*overrides, "encoder.max_resolution=64", "encoder.log2_table_size=10", scene=record)
    assert (run.scene.depths is not None) == learns
    asked = compose_config("train", ("scene=in_memory", "scene.name=bricks", *overrides))
    job = assemble_job(asked, scene=record)
    assert (job.scene.depths is not None) == learns
