"""The built-in scene's surface is known: a mesh of a short run stays close to it."""

import numpy as np
import pytest
import trimesh
from bricks_surface import distances, exact_surface, on_mesh
from support.running import start

POINTS = 100_000


def test_points_of_the_exact_surface_are_on_it_and_reach_all_of_it():
    from nerf_lightning.data.bricks.parts import fire_engine
    from nerf_lightning.data.bricks.solids import Solids

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
    fused = (*export, "what.surface=tsdf", f"paths.output_dir={tmp_path}/fused")
    commands = (("train", *run, *least, f"paths.output_dir={tmp_path}/run"), ("export", *export), ("export", *fused))
    for command in commands:
        process = start(*command)
        output, _ = process.communicate(timeout=600)
        assert process.returncode == 0, output
    to_truth, to_mesh = errors(tmp_path / "run" / "export" / "mesh.ply")
    assert to_truth < 0.08
    assert to_mesh < 0.03
    fused_to_truth, fused_to_mesh = errors(tmp_path / "fused" / "mesh.ply")
    assert fused_to_truth < 0.8 * to_truth
    assert fused_to_mesh < 1.35 * to_mesh


def errors(path):
    """How far the mesh's points are from the exact surface on average, and those of the surface from the mesh."""
    mesh, true = trimesh.load(path, process=False), exact_surface(POINTS)
    ours = on_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), POINTS)
    found = distances(ours, true).mean(), distances(true, ours).mean()
    print(f"{path.parent.name}: chamfer {found[0]:.4f} and {found[1]:.4f}")
    return found
