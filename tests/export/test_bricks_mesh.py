"""The embedded scene's surface is known: a mesh of a short run stays close to it."""

import numpy as np
import pytest
import trimesh
from support.bricks_surface import distances, exact_surface, on_mesh
from support.running import start

POINTS = 100_000


def test_points_of_the_exact_surface_are_on_it_and_reach_all_of_it():
    from nerf_lightning.data.bricks.solids import Solids
    from nerf_lightning.data.bricks.vehicle import fire_engine

    points = exact_surface(5_000)
    room = Solids.of(fire_engine()).room(points.T, 1.0)
    assert np.abs(room).max() < 1e-6
    assert np.ptp(points, axis=0).min() > 1.0


@pytest.mark.slow
@pytest.mark.exhaustive
def test_the_mesh_of_a_short_run_is_close_to_the_exact_surface(tmp_path):
    scene = ("scene.resolution=64", "scene.num_train=60", "scene.num_val=2", "scene.num_test=2")
    run = ("experiment=quickstart", *scene, f"scene.cache_dir={tmp_path}/cache", "trainer.max_steps=150")
    least = ("final.video=false", "logger=none", "evaluation.max_views=1", "evaluation.num_pictures=0")
    export = (f"ckpt={tmp_path}/run/checkpoints/last.ckpt", "what=mesh", "what.resolution=128")
    for command in (("train", *run, *least, f"paths.output_dir={tmp_path}/run"), ("export", *export)):
        process = start(*command)
        output, _ = process.communicate(timeout=600)
        assert process.returncode == 0, output
    mesh = trimesh.load(tmp_path / "run" / "export" / "mesh.ply", process=False)
    ours = on_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), POINTS)
    true = exact_surface(POINTS)
    to_truth, to_mesh = distances(ours, true).mean(), distances(true, ours).mean()
    print(f"chamfer {to_truth:.4f} and {to_mesh:.4f}")
    assert to_truth < 0.08
    assert to_mesh < 0.03
