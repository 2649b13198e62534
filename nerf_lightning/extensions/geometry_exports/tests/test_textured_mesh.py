"""what.texture=true: a known pattern comes back in place, files are what readers expect, bad input is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from support.known_fields import ball, solid
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.extensions.geometry_exports.mesh import MeshExport
from nerf_lightning.extensions.geometry_exports.texels import covered_texels
from nerf_lightning.messages.errors import InputError

TILE, CELL = 1 << 15, 0.5
DARK, LIGHT = (0.2, 0.3, 0.7), (0.9, 0.8, 0.3)


def in_texture(picture, uv):
    """Return the colors at places of a texture (v up), mixed between the four texels around each."""
    height, width, _ = picture.shape
    x, y = (np.nan_to_num(uv) * (1, -1) + (0, 1)).reshape(-1, 2).T * np.array([[width], [height]]) - 0.5
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = (x - j)[:, None], (y - i)[:, None]

    def texel(row, column):
        return picture[row.clip(0, height - 1), column.clip(0, width - 1)].astype(float)

    top, bottom = ((1 - u) * texel(row, j) + u * texel(row, j + 1) for row in (i, i + 1))
    return ((1 - v) * top + v * bottom).reshape(*uv.shape[:-1], 3)


def record(**changes):
    return replace(scene_record(ball_scene(num_views=12, size=24)), **changes)


def is_light(points):
    """A checker in space, of cells that are CELL wide."""
    return torch.floor(points / CELL + 0.5).long().sum(dim=-1) % 2 == 0


def checker(points):
    return torch.where(is_light(points)[..., None], torch.tensor(LIGHT), torch.tensor(DARK))


def exported(folder, model, scene, **settings):
    pytest.importorskip("xatlas", reason="xatlas is not installed (the extra texture)")
    given = {"resolution": 10, "texture": True, "texture_size": 64} | settings
    return MeshExport(**given).export(model, scene, folder, TILE)


def texture_of(mesh):
    material = mesh.visual.material
    picture = material.baseColorTexture if hasattr(material, "baseColorTexture") else material.image
    return np.asarray(picture.convert("RGB"))


def only_mesh(path):
    loaded = trimesh.load(path, process=False)
    return next(iter(loaded.geometry.values())) if isinstance(loaded, trimesh.Scene) else loaded


@pytest.mark.parametrize(("format", "surface"), [("glb", "density"), ("obj", "tsdf")])
def test_a_checker_comes_back_in_place(tmp_path, format, surface):
    fine = {"resolution": 20, "texture_size": 192, "format": format, "surface": surface}
    path = exported(tmp_path, solid(ball(), color=checker), record(), **fine)[-1]
    mesh = only_mesh(path)
    inside = np.random.default_rng(0).dirichlet((1.0, 1.0, 1.0), len(mesh.faces))
    points = (inside[..., None] * mesh.vertices[mesh.faces]).sum(axis=1)
    uv = (inside[..., None] * mesh.visual.uv[mesh.faces]).sum(axis=1)
    found = in_texture(texture_of(mesh), uv) / 255.0
    # A cell of the mesh from the edges of the checker: so far is its surface from that of the rays.
    clear = (np.abs((points / CELL) % 1 - 0.5) > 0.08 / CELL).all(axis=1)
    seen = points @ [1.0, 0.0, 0.0] > -0.2 if surface == "density" else clear
    expected = checker(torch.tensor(points)).numpy()
    wrong = np.abs(found - expected).max(axis=1) > 0.25
    print(f"{wrong[clear & seen].mean():.4f} of {(clear & seen).sum()} are of the other color")
    assert (clear & seen).sum() > 100
    assert wrong[clear & seen].mean() < 0.03


def test_one_grey_fills_the_whole_picture_and_is_encoded_as_srgb(tmp_path):
    (path,) = exported(tmp_path, solid(ball(), color=lambda points: torch.full_like(points, 0.4)), record())
    assert path.name == "mesh.glb"
    assert np.unique(texture_of(only_mesh(path))).tolist() == [102]


def test_glb_holds_its_picture_and_no_viewer_lights_it(tmp_path):
    (path,) = exported(tmp_path, solid(ball()), record())
    assert [each.name for each in tmp_path.iterdir()] == ["mesh.glb"]
    content = path.read_bytes()
    tree = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    (image,), (texture,), (material,) = tree["images"], tree["textures"], tree["materials"]
    assert image["mimeType"] == "image/png"
    assert "uri" not in image
    assert texture["source"] == 0
    assert material["pbrMetallicRoughness"]["baseColorTexture"]["index"] == 0
    assert material["extensions"] == {"KHR_materials_unlit": {}}
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    (primitive,) = tree["meshes"][0]["primitives"]
    assert {"POSITION", "NORMAL", "TEXCOORD_0"} <= set(primitive["attributes"])
    assert "COLOR_0" not in primitive["attributes"]


def test_texels_are_those_whose_centres_lie_in_a_triangle():
    corners = np.array([[[1.0, 1.0], [7.2, 1.0], [1.0, 7.2]]])
    face, shares = covered_texels(corners, 8)
    row, column = np.indices((8, 8)) + 0.5
    inside = (row > 1) & (column > 1) & (row + column < 8.2)
    assert np.array_equal(face == 0, inside)
    places = (shares[inside][..., None] * corners[0]).sum(axis=1)
    np.testing.assert_allclose(places, np.stack([column[inside], row[inside]], axis=1), atol=1e-5)


def test_obj_has_its_material_and_its_picture_beside_it_unless_a_folder_is_in_the_way(tmp_path):
    (tmp_path / "mesh.png").mkdir()
    with pytest.raises(InputError, match=r"mesh\.png is a folder.*paths\.output_dir=DIR"):
        exported(tmp_path, solid(ball()), record(), format="obj")
    assert [each.name for each in tmp_path.iterdir()] == ["mesh.png"]
    (tmp_path / "mesh.png").rmdir()
    written = exported(tmp_path, solid(ball()), record(), format="obj")
    assert sorted(each.name for each in written) == ["mesh.mtl", "mesh.obj", "mesh.png"]
    assert sorted(each.name for each in tmp_path.iterdir()) == ["mesh.mtl", "mesh.obj", "mesh.png"]
    assert "mtllib mesh.mtl" in (tmp_path / "mesh.obj").read_text()
    assert "map_Kd mesh.png" in (tmp_path / "mesh.mtl").read_text()
    with Image.open(tmp_path / "mesh.png") as picture:
        assert picture.size == (64, 64)


def test_a_mesh_that_no_view_sees_gets_no_texture(tmp_path):
    scene = record()
    away = scene.cameras.c2w.clone()
    away[:, :, [0, 2]] *= -1  # each looks the other way
    turned = replace(scene, cameras=replace(scene.cameras, c2w=away))
    with pytest.raises(InputError, match="No training view of ball sees the mesh"):
        exported(tmp_path, solid(ball()), turned, threshold=100.0, seen_only=False)
    assert not list(tmp_path.iterdir())
