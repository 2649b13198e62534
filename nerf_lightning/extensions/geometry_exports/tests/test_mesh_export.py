"""Meshes: the surface of known solids, in the user's frame and every format, of the density and of what views see."""

import json
import logging
from dataclasses import replace

import numpy as np
import psutil
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from support.known_fields import INSIDE, SOFT, ball, solid
from support.posed_captures import Known, read, write_colmap
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.export.base import RunContext
from nerf_lightning.extensions.geometry_exports.density_mesh import without_floaters
from nerf_lightning.extensions.geometry_exports.fused_mesh import depth_rays
from nerf_lightning.extensions.geometry_exports.mesh import MeshExport
from nerf_lightning.extensions.geometry_exports.mesh_files import GltfFrame, save_mesh
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import all_pixels
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.nerf.geometry.world_frame import similarity, unit_of, upright_rotation
from nerf_lightning.nerf.rendering.linear_light import to_linear

RADIUS = 0.8
TILE = 1 << 15


def silent(stage, done):
    assert 0 <= done <= 1


def record(**changes):
    return replace(scene_record(ball_scene(num_views=8, size=24)), **changes)


def exported(folder, model, scene, crop=None, **settings):
    what, run = MeshExport(**{"resolution": 48, "seen_only": False} | settings), RunContext(crop=crop)
    (path,) = what.export(model, scene, folder, TILE, run)
    loaded = trimesh.load(path, process=False)
    return next(iter(loaded.geometry.values())) if isinstance(loaded, trimesh.Scene) else loaded


def test_only_the_surface_in_a_crop_box_is_written(tmp_path):
    upper = CropBox.from_user((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0), torch.eye(4))
    mesh = exported(tmp_path, solid(ball()), record(), upper)
    assert 0.0 < mesh.vertices[:, 2].min() < 0.1
    assert mesh.area == pytest.approx(2 * np.pi * RADIUS**2, rel=0.1)
    with pytest.raises(InputError, match="there is no surface in this box"):
        exported(tmp_path, solid(ball()), record(), CropBox.from_user((0.9, 0.9, 0.9), (1.0, 1.0, 1.0), torch.eye(4)))
    with pytest.raises(InputError, match="asks for a closed mesh, which a crop box opens"):
        exported(tmp_path, solid(ball()), record(), upper, format="stl")


def colors_of(mesh):
    visual = mesh.visual
    colors = visual.vertex_colors if hasattr(visual, "vertex_colors") else visual.vertex_attributes["color"]
    full = np.iinfo(np.asarray(colors).dtype).max  # 16 bits in GLB, where trimesh leaves them as they are
    return np.rint(255 * (np.asarray(colors)[:, :3] / full)).astype(int)


@pytest.mark.parametrize("format", ["ply", "obj", "glb"])
def test_a_ball_is_a_ball_in_every_format(tmp_path, format):
    mesh = exported(tmp_path, solid(ball()), record(), format=format)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    # The surface that rendering sees is where light is absorbed: about the width of the ramp outside.
    assert np.abs(radius - RADIUS).max() < 0.05
    assert radius.std() < 0.005
    assert mesh.is_watertight
    assert mesh.volume > 0
    outward = (np.asarray(mesh.vertex_normals) * mesh.vertices).sum(axis=1) / radius
    assert outward.min() > 0.95
    colors = colors_of(mesh)
    clear = np.abs(mesh.vertices[:, 0]) > 0.2
    expected = np.where(mesh.vertices[:, :1] > 0, [[255, 0, 0]], [[0, 255, 0]])
    assert np.abs(colors - expected)[clear].max() <= 2


@pytest.mark.parametrize(("metres", "radius"), [(0.01, RADIUS * 2 * 10.0), (None, 50.0)])
def test_a_print_is_closed_solid_upright_and_in_millimeters(tmp_path, metres, radius):
    """A hollow ball that the camera's frame has tipped over, in units half as long as the scene's."""

    def hollow(points):
        return torch.maximum(ball()(points), 0.6 - points.norm(dim=-1))

    to_user = similarity(upright_rotation(torch.tensor([0.6, 0.0, 0.8])).mT, torch.tensor([5.0, 6.0, 7.0]), 2.0)
    mesh = exported(
        tmp_path, solid(hollow), record(to_user=to_user, metres_per_unit=metres), format="stl", min_share=0.0
    )
    mesh.merge_vertices()
    assert mesh.is_watertight
    assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)
    assert mesh.extents / 2 == pytest.approx([radius] * 3, rel=0.06)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.12)


def _glb_tree(path):
    content = path.read_bytes()
    length = int.from_bytes(content[12:16], "little")
    assert (content[:4], content[16:20]) == (b"glTF", b"JSON")
    return json.loads(content[20 : 20 + length])


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.6, 0.0, 0.8)])
def test_glb_has_y_up_and_the_others_keep_the_captures_frame(tmp_path, up):
    """A ball whose upper half, as the photographer saw it, is red, and whose lower half is blue."""

    def color(points):
        return torch.where(points[..., 2:] > 0, torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1]))

    to_user = similarity(upright_rotation(torch.tensor(up)).mT, torch.zeros(3), 1.0)
    scene = record(to_user=to_user)
    model = solid(ball(), color=color)
    for format in ("ply", "obj"):
        mesh = exported(tmp_path, model, scene, format=format, resolution=16)
        height = mesh.vertices @ np.array(up)
        red = colors_of(mesh)[:, 0] > 128
        assert height[red].mean() > 0.2 > -0.2 > height[~red].mean()
    exported(tmp_path, model, scene, format="glb", resolution=16)
    # As in glTF: a node's matrix is in column-major order, and is multiplied by its parent's from the left.
    tree = _glb_tree(tmp_path / "mesh.glb")
    (root,) = tree["scenes"][tree["scene"]]["nodes"]
    matrix = np.array(tree["nodes"][root]["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(matrix[:3, :3] @ up, [0, 1, 0], atol=1e-6)
    loaded = trimesh.load(tmp_path / "mesh.glb", process=False)
    placed, name = loaded.graph[loaded.graph.nodes_geometry[0]]
    height = trimesh.transform_points(loaded.geometry[name].vertices, placed)[:, 1]
    red = colors_of(loaded.geometry[name])[:, 0] > 128
    assert height[red].mean() > 0.2 > -0.2 > height[~red].mean()


@pytest.mark.parametrize("colors", ["cameras", "normal"])
def test_grey_is_the_same_grey_but_linear_in_glb(tmp_path, colors):
    model = solid(ball(), color=lambda positions: torch.full_like(positions, 0.4))
    for format, grey in (("ply", 102), ("glb", 34)):
        mesh = exported(tmp_path, model, record(), format=format, colors=colors, resolution=16)
        assert np.unique(colors_of(mesh)).tolist() == [grey]


def test_glb_tells_all_colors_apart_in_linear_light(tmp_path):
    colors = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    vertices = np.random.default_rng(0).random((256, 3)).astype(np.float32)
    faces, normals = np.arange(255).reshape(-1, 3), np.tile(np.float32([0, 0, 1]), (256, 1))
    path = tmp_path / "mesh.glb"
    save_mesh(path, vertices, faces, normals, GltfFrame(np.array([0.0, 0.0, 1.0]), 1.0), colors)
    tree = _glb_tree(path)
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    view, content = tree["bufferViews"][accessor["bufferView"]], path.read_bytes()
    binary = 28 + int.from_bytes(content[12:16], "little") + view["byteOffset"] + accessor["byteOffset"]
    found = np.frombuffer(content, "<u2", 4 * accessor["count"], binary).reshape(-1, 4) / 65535
    assert (found[:, 3] == 1).all()
    # Back in sRGB, each is what it was.
    known = to_linear(torch.arange(256) / 255.0).numpy()
    np.testing.assert_array_equal(np.abs(found[:, :3, None] - known).argmin(axis=2), colors)


def test_the_surface_is_where_the_depth_of_the_pictures_is(tmp_path):
    # Rendering sees thin matter deep inside; the level follows.
    dense, thin = (exported(tmp_path, solid(ball(), inside=inside), record()) for inside in (4000.0, 40.0))
    assert np.linalg.norm(dense.vertices, axis=1).mean() > np.linalg.norm(thin.vertices, axis=1).mean() + 0.02


def test_haze_in_front_of_a_surface_is_not_taken_for_it(tmp_path):
    """A quarter of the light is absorbed before it reaches the ball, so the expected depth is in the haze."""
    model = solid(ball(RADIUS), inside=50.0)
    clear = model.last.field.density
    model.last.field.density = lambda points: (clear(points)[0] + 0.1, None)
    mesh = exported(tmp_path, model, record())
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(np.median(radii) - RADIUS) < 0.05


@pytest.mark.parametrize("space", ["bounded", "contracted"])
def test_a_scene_in_another_frame_gives_the_same_mesh_in_the_new_place(tmp_path, space):
    def shape(positions):  # a ball with a nose: no turn brings it onto itself
        return torch.minimum(ball(0.6, (0.3, -0.2, 0.1))(positions), ball(0.25, (0.9, 0.1, 0.5))(positions))

    rotation = upright_rotation(torch.nn.functional.normalize(torch.tensor([0.3, -1.2, 0.4]), dim=0)).numpy()
    scale, shift = 13.0, np.array([20.0, -7.0, 4.0])
    known, found = Known(), []
    for name, capture in (("one", known), ("other", known.moved(scale, rotation, shift))):
        scene = scene_record(read("colmap", write_colmap(tmp_path / name, capture), space=space))
        back = np.linalg.inv(np.block([[scale * rotation, shift[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]))
        to_first = torch.tensor(back if name == "other" else np.eye(4)).double() @ scene.to_user
        unit = unit_of(to_first)
        to_first = to_first.float()

        def distance(positions, to_first=to_first, unit=unit):
            return shape(positions @ to_first[:3, :3].T + to_first[:3, 3]) / unit

        found.append((exported(tmp_path / name, solid(distance), scene, resolution=96, threshold=INSIDE / 2), unit))
    (one, unit), (other, _) = found
    assert one.is_watertight
    assert other.is_watertight
    moved = scale * one.vertices @ rotation.T + shift
    spacing = 4.0 * unit / 96
    for a, b in ((moved, other.vertices), (other.vertices, moved)):
        assert cKDTree(a).query(b)[0].max() < scale * spacing
    assert other.volume == pytest.approx(scale**3 * one.volume, rel=0.01)
    # Both are on the solid itself.
    assert float(shape(torch.tensor(one.vertices).float()).abs().max()) < 0.02


def test_floaters_are_removed_by_their_share_of_faces(tmp_path, caplog):
    def shape(positions):
        return torch.minimum(ball(0.6)(positions), ball(0.1, (0.85, 0.85, 0.85))(positions))

    with caplog.at_level(logging.INFO):
        mesh = exported(tmp_path, solid(shape), record(), min_share=0.1)
    assert "1 floaters removed" in caplog.text
    assert mesh.body_count == 1
    assert exported(tmp_path, solid(shape), record(), min_share=0.0).body_count == 2


def test_of_two_parts_alike_both_are_kept():
    cube = trimesh.creation.box()
    both = trimesh.util.concatenate([cube, cube.copy().apply_translation([3, 0, 0])])
    vertices, faces, removed = without_floaters(np.asarray(both.vertices), np.asarray(both.faces), 1.0)
    assert (len(vertices), len(faces), removed) == (16, 24, 0)


def test_what_no_view_sees_is_removed_when_asked(tmp_path):
    def hollow(positions):  # a shell: its inside is an invisible surface
        return torch.maximum(ball(0.8)(positions), -ball(0.4)(positions))

    whole = exported(tmp_path, solid(hollow), record())
    seen = exported(tmp_path, solid(hollow), record(), seen_only=True)
    assert np.linalg.norm(whole.vertices, axis=1).min() < 0.5
    assert np.linalg.norm(seen.vertices, axis=1).min() > 0.7
    assert seen.area > 0.6 * 4 * np.pi * RADIUS**2


def test_decimation_keeps_the_shape(tmp_path):
    mesh = exported(tmp_path, solid(ball()), record(), faces=500)
    assert 400 < len(mesh.faces) <= 500
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).max() < 0.06
    assert mesh.volume > 0


def test_content_that_leaves_a_bounded_box_is_closed_and_that_of_a_contracted_scene_is_not(tmp_path):
    floor = solid(lambda positions: positions[..., 2] + 0.3)
    assert exported(tmp_path, floor, record(), threshold=100.0).is_watertight
    open_mesh = exported(tmp_path, floor, record(space="contracted"), threshold=100.0)
    assert not open_mesh.is_watertight
    assert np.ptp(open_mesh.vertices[:, 2]) < 0.05
    assert np.abs(open_mesh.vertices).max() <= 1.001


def test_an_empty_field_is_refused_with_the_densities_seen(tmp_path):
    thin = solid(ball(), inside=0.01)
    with pytest.raises(InputError, match=r"densities in its box range from 0 to 0\.01.*sees anything opaque"):
        exported(tmp_path, thin, record())
    with pytest.raises(InputError, match=r"where the density is 900: .* range from 0 to 400 .*what\.threshold="):
        exported(tmp_path, solid(ball()), record(), threshold=900.0)
    assert not list(tmp_path.iterdir())


def test_a_grid_beyond_memory_is_refused_with_what_would_fit(tmp_path, monkeypatch):
    memory = type("Memory", (), {"available": 1_000_000_000})
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)
    with pytest.raises(
        InputError, match=r"2049 x 2049 x 2049 points, which takes 68\.\d GB, but only 0\.8 GB"
    ) as error:
        exported(tmp_path, solid(ball()), record(), resolution=2048)
    fitting = int(str(error.value).split("what.resolution=")[2].split(" ")[0])
    assert (fitting + 1) ** 3 <= 1e8 < (fitting + 2) ** 3
    with pytest.raises(InputError, match="4194304 x 4194304 x 4194304 points"):  # too many for 64 bits
        exported(tmp_path, solid(ball()), record(), resolution=2**22 - 1)
    exported(tmp_path, solid(ball()), record(), resolution=20)


def fused(folder, model, scene, **settings):
    (path,) = MeshExport(**{"resolution": 40, "surface": "tsdf"} | settings).export(model, scene, folder, TILE)
    return trimesh.load(path, process=False)


def test_a_ball_comes_back_to_within_a_cell_and_only_what_is_seen_of_it(tmp_path):
    scene = record()
    mesh = fused(tmp_path, solid(ball()), scene)
    radius, cell = np.linalg.norm(mesh.vertices, axis=1), 2.0 / 40
    # A ray at the middle has half of its light behind it where INSIDE * SOFT * log(1 + exp(-d / SOFT)) = log 2.
    expected = RADIUS - SOFT * np.log(np.expm1(np.log(2) / (INSIDE * SOFT)))
    assert np.abs(radius - expected).mean() < 0.25 * cell
    assert np.quantile(np.abs(radius - expected), 0.95) < cell
    assert np.abs(radius - expected).max() < 2 * cell  # at the rim, which all views graze
    assert not mesh.is_watertight
    outward = (np.asarray(mesh.vertex_normals) * mesh.vertices).sum(axis=1) / radius
    assert outward.min() > 0.0
    assert outward.mean() > 0.95
    # Four views from a half circle: what faces away from all of them is missing.
    eyes = scene.cameras.c2w[list(scene.splits["train"]), :, 3].numpy()
    places = mesh.vertices / radius[:, None]
    assert (places @ (eyes / np.linalg.norm(eyes, axis=1, keepdims=True)).T).max(axis=1).min() > -0.1


def test_the_inside_of_things_is_no_part_of_it(tmp_path):
    hollow = solid(lambda points: torch.maximum(ball(0.8)(points), -ball(0.4)(points)))
    assert np.linalg.norm(fused(tmp_path, hollow, record()).vertices, axis=1).min() > 0.7


def test_a_panorama_is_seen_through_the_faces_of_a_cube_and_a_lens_is_left_out_of_rendered_depth():
    scene = record()
    cameras = replace(scene.cameras, lens_model="equirectangular")
    rays_of = depth_rays(replace(scene, cameras=cameras), 16)
    number = len(scene.splits["train"])
    assert rays_of.cameras.lens_model == "pinhole"
    assert rays_of.cameras.c2w.shape == (6 * number, 3, 4)
    turned = rays_of.cameras.c2w[:6, :, :3]
    np.testing.assert_allclose(torch.linalg.det(turned), 1.0, atol=1e-5)
    directions = torch.cat([rays_of(all_pixels(rays_of.cameras, view)).directions.flatten(0, 1) for view in range(6)])
    everywhere = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    assert float((everywhere @ directions.mT).amax(dim=1).min()) > 0.99
    scene = scene_record(ball_scene(num_views=4, size=24, lens=(0.1, 0, 0, 0, 0, 0), lens_model="radial_tangential"))
    cameras = depth_rays(scene, 48).cameras
    assert cameras.lens_model == "pinhole"
    assert not cameras.lens.any()
    assert cameras.width.tolist() == [48, 48]
    assert cameras.focal[0, 0] == 2 * scene.cameras.focal[0, 0]


def test_what_no_view_sees_is_refused_with_the_cure(tmp_path):
    with pytest.raises(InputError, match=r"no training view of ball sees anything opaque in its box.*Train longer"):
        fused(tmp_path, solid(ball(), inside=0.01), record())
    elsewhere = record(aabb=torch.tensor([[5.0, 5.0, 5.0], [6.0, 6.0, 6.0]]))
    with pytest.raises(InputError, match=r"no training view of ball sees anything opaque in its box"):
        fused(tmp_path, solid(ball()), elsewhere)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("metres", "size"), [(0.01, 0.8), (None, 80.0)])
def test_a_glb_has_its_size_in_metres_where_the_unit_is_known(tmp_path, metres, size):
    to_user = similarity(torch.eye(3), torch.tensor([5.0, 6.0, 7.0]), 50.0)
    record = replace(scene_record(ball_scene(num_views=4, size=33)), to_user=to_user, metres_per_unit=metres)
    MeshExport(resolution=16, format="glb").export(solid(ball()), record, tmp_path, 1 << 15)
    assert trimesh.load(tmp_path / "mesh.glb").extents == pytest.approx(np.full(3, size), rel=0.1)
