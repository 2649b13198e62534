"""Splat files, read back by gsply, and as plain json and bytes."""

import io
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree
from support.scenes import ball_scene
from torch.nn.functional import normalize

from nerf_lightning.extensions.splats.files import HALF_TURN, moved, save_splats
from nerf_lightning.extensions.splats.gaussians import Gaussians, colors, covariances
from nerf_lightning.extensions.splats.sog import morton_order
from nerf_lightning.nerf.geometry.poses import quaternion_from_rotation as quaternions
from nerf_lightning.nerf.geometry.poses import rotation_from_quaternion as rotations
from nerf_lightning.nerf.geometry.world_frame import points_to_user, similarity

MIRRORED = np.array([1.0, -1.0, -1.0])


def some(count=50, degree=2):
    generator = torch.Generator().manual_seed(7)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    sh = 0.3 * normal(count, 3), 0.1 * normal(count, (degree + 1) ** 2 - 1, 3)
    return Gaussians(normal(count, 3), -3 + 0.5 * normal(count, 3), normal(count, 4), normal(count), *sh)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_moved_splats_look_the_same_from_a_moved_place(degree):
    turn = rotations(torch.tensor([0.3, -0.7, 0.2, 0.6])).double()
    matrix = similarity(turn.float(), torch.tensor([3.0, -1.0, 2.0]), 2.5)
    splats, eye = some(degree=degree), torch.tensor([0.5, 4.0, -2.0])
    there = moved(splats, matrix).map(lambda each: each.float())
    seen_from = points_to_user(eye.double(), matrix).float()
    torch.testing.assert_close(colors(there, seen_from), colors(splats, eye), atol=1e-4, rtol=0)
    expected = 2.5**2 * turn.float() @ covariances(splats) @ turn.float().mT
    torch.testing.assert_close(covariances(there), expected, atol=1e-5, rtol=1e-4)


def test_quaternions_of_any_rotation():
    angles = normalize(torch.cat([torch.randn(200, 4), torch.eye(4), -torch.eye(4)]), dim=-1)
    torch.testing.assert_close(rotations(quaternions(rotations(angles))), rotations(angles), atol=1e-5, rtol=0)


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_a_ply_is_what_gsply_reads(tmp_path, degree):
    gsply = pytest.importorskip("gsply", reason="gsply is not installed (the extra splats)")
    splats = some(degree=degree)
    save_splats(tmp_path / "splats.ply", splats)
    assert_read(gsply.plyread(tmp_path / "splats.ply"), splats, 1e-6)


def test_an_spz_is_turned_and_coarse_as_the_format_has_it(tmp_path):
    """Version 3, since Spark reads no other; its axes are right, up, back."""
    gsply = pytest.importorskip("gsply", reason="gsply is not installed (the extra splats)")
    splats = some()
    save_splats(tmp_path / "splats.spz", splats)
    read = gsply.read_spz(tmp_path / "splats.spz")
    turned = replace(splats, means=splats.means * torch.tensor([1.0, -1.0, -1.0]))
    assert np.abs(read.means - turned.means.numpy()).max() < 0.01
    half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    found = rotations(torch.from_numpy(np.ascontiguousarray(read.quats)))
    expected = half_turn @ rotations(splats.quaternions)
    torch.testing.assert_close(found, expected, atol=0.01, rtol=0)
    back = Gaussians(*(torch.from_numpy(np.ascontiguousarray(each)).float() for each in parts(read)))
    eye = torch.tensor([0.0, 5.0, 1.0])
    found, expected = colors(back, half_turn @ eye), colors(splats, eye)
    assert float((found - expected).abs().mean()) < 0.03


@pytest.fixture
def sogread(monkeypatch):
    """Gsply's reader, with Pillow in the place of imagecodecs."""
    gsply = pytest.importorskip("gsply", reason="gsply is not installed (the extra splats)")

    def decoded(content):
        picture = Image.open(io.BytesIO(content)).convert("RGBA")
        return np.asarray(picture).ravel(), *picture.size

    monkeypatch.setattr("gsply.sog_reader._load_webp_image", decoded)
    return gsply.sogread


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_a_sog_is_what_gsply_reads_to_a_byte_or_two(tmp_path, sogread, degree):
    splats = some(2000, degree)
    save_splats(tmp_path / "splats.sog", splats)
    read = sogread(tmp_path / "splats.sog")
    apart, order = cKDTree(read.means).query(splats.means.numpy())
    assert apart.max() < 1e-3
    assert sorted(order) == list(range(2000))
    assert np.abs(read.scales[order] - splats.log_scales.numpy()).max() < 0.1
    assert np.abs(read.sh0[order] - splats.sh_dc.numpy()).max() < 0.1
    opacity = 1 / (1 + np.exp(-read.opacities[order]))
    assert np.abs(opacity - splats.opacity_logits.sigmoid().numpy()).max() < 0.003
    found = rotations(torch.from_numpy(np.ascontiguousarray(read.quats[order])))
    torch.testing.assert_close(found, rotations(splats.quaternions), atol=0.02, rtol=0)
    if degree:  # one of a thousand for every two
        rest = splats.sh_rest.numpy()
        assert np.square(read.shN[order] - rest).mean() < 0.5 * np.square(rest).mean()


def test_few_splats_have_a_sog_whose_harmonics_are_their_own(tmp_path, sogread):
    splats = some(50, 3)
    save_splats(tmp_path / "splats.sog", splats)
    read = sogread(tmp_path / "splats.sog")
    order = cKDTree(read.means).query(splats.means.numpy())[1]
    assert np.abs(read.shN[order] - splats.sh_rest.numpy()).max() < 0.05


def test_neighbors_in_space_are_neighbors_in_a_sog():
    order = morton_order(torch.tensor([[1.0, 1, 1], [0, 0, 0], [0, 0, 0.9], [0.1, 0, 0]]))
    assert order.tolist() == [1, 3, 2, 0]


def test_a_usda_is_a_stage_with_splats_and_cameras(tmp_path):
    Usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed (make setup)")
    from pxr import Gf, UsdGeom, UsdVol

    splats, scene = some(), ball_scene(num_views=3, size=16)
    save_splats(tmp_path / "splats.usda", splats, scene.cameras)
    stage = Usd.Stage.Open(str(tmp_path / "splats.usda"))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    prim = stage.GetPrimAtPath("/Scene/Splats")
    assert prim.IsA(UsdVol.ParticleField3DGaussianSplat)
    read = {name: np.array(prim.GetAttribute(name).Get()) for name in ("positions", "scales", "opacities")}
    np.testing.assert_allclose(read["positions"] * MIRRORED, splats.means, rtol=1e-5)
    np.testing.assert_allclose(read["scales"], splats.log_scales.exp(), rtol=1e-5)
    np.testing.assert_allclose(read["opacities"], splats.opacity_logits.sigmoid(), rtol=1e-5)
    turned = moved(splats, HALF_TURN)
    quaternion = prim.GetAttribute("orientations").Get()[7]
    found = torch.tensor([[quaternion.GetReal(), *quaternion.GetImaginary()]])
    torch.testing.assert_close(rotations(found), rotations(turned.quaternions[7:8]), atol=1e-5, rtol=0)
    coefficients = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()).reshape(50, -1, 3)
    np.testing.assert_allclose(coefficients[:, 1:], turned.sh_rest, atol=1e-6)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 2
    # A point on a photograph's axis is on that of its camera.
    view = UsdGeom.Camera(stage.GetPrimAtPath("/Scene/Cameras/View_0001")).GetCamera()
    c2w = scene.cameras.c2w[1]
    ahead = (c2w[:, 3] - 2 * c2w[:, 2]).numpy() * MIRRORED
    seen = view.transform.GetInverse().Transform(Gf.Vec3d(*map(float, ahead)))
    np.testing.assert_allclose(seen, [0, 0, -2], atol=1e-5)
    shown = view.focalLength / view.horizontalAperture
    assert shown == pytest.approx(float(scene.cameras.focal[1, 0]) / 16, rel=1e-6)


def test_a_principal_point_off_the_center_is_where_it_was_in_usd(tmp_path):
    Usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed (make setup)")
    from pxr import UsdGeom

    cameras = ball_scene(num_views=1, size=16).cameras
    cameras = replace(cameras, center=torch.tensor([[4.0, 10.0]]))  # right and down from the upper left corner
    save_splats(tmp_path / "splats.usda", some(), cameras)
    stage = Usd.Stage.Open(str(tmp_path / "splats.usda"))
    frustum = UsdGeom.Camera(stage.GetPrimAtPath("/Scene/Cameras/View_0000")).GetCamera().frustum
    (left, bottom), (right, top) = frustum.window.min, frustum.window.max
    assert -left / (right - left) == pytest.approx(4 / 16, abs=1e-6)
    assert top / (top - bottom) == pytest.approx(10 / 16, abs=1e-6)


def test_spz_places_fit_far_from_the_origin(tmp_path):
    gsply = pytest.importorskip("gsply", reason="gsply is not installed (the extra splats)")
    splats = some()
    splats.means += 30_000.0
    save_splats(tmp_path / "splats.spz", splats)
    read = gsply.read_spz(tmp_path / "splats.spz")
    assert np.abs(read.means * MIRRORED - splats.means.numpy()).max() < 0.01


def test_a_glb_has_activated_numbers_and_y_up(tmp_path):
    splats, turn = some(degree=1), HALF_TURN[:3, :3].float()
    save_splats(tmp_path / "splats.glb", splats)
    content = (tmp_path / "splats.glb").read_bytes()
    magic, version, length, json_length = struct.unpack_from("<4sIII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    tree, body = json.loads(content[20 : 20 + json_length]), content[28 + json_length :]
    (primitive,) = tree["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"

    def read(name):
        accessor = tree["accessors"][primitive["attributes"][name]]
        view = tree["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        floats = np.frombuffer(body, "<f4", accessor["count"] * width, view["byteOffset"])
        return torch.from_numpy(floats.reshape(-1, width).copy())

    torch.testing.assert_close(read("POSITION"), splats.means @ turn)
    torch.testing.assert_close(read("KHR_gaussian_splatting:SCALE"), splats.log_scales.exp())
    torch.testing.assert_close(read("KHR_gaussian_splatting:OPACITY")[:, 0], splats.opacity_logits.sigmoid())
    axes = rotations(read("KHR_gaussian_splatting:ROTATION")[:, [3, 0, 1, 2]])
    torch.testing.assert_close(axes, turn @ rotations(splats.quaternions), atol=1e-5, rtol=0)
    sh = [read(f"KHR_gaussian_splatting:SH_DEGREE_1_COEF_{k}") for k in range(3)]
    back = Gaussians(
        read("POSITION"), splats.log_scales, splats.quaternions, splats.opacity_logits, splats.sh_dc, torch.stack(sh, 1)
    )
    eye = torch.tensor([0.0, 5.0, 1.0])
    torch.testing.assert_close(colors(back, turn @ eye), colors(splats, eye), atol=1e-4, rtol=0)


def test_a_disk_that_is_full_leaves_nothing(tmp_path, monkeypatch):
    def full(self, content):
        self.open("wb").close()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    for end in ("ply", "glb"):
        with pytest.raises(OSError, match="No space left"):
            save_splats(tmp_path / f"splats.{end}", some())
    assert not list(tmp_path.iterdir())


def parts(read):
    return read.means, read.scales, read.quats, read.opacities, read.sh0, read.shN


def assert_read(read, splats, tolerance):
    expected = (
        *(splats.means, splats.log_scales, normalize(splats.quaternions, dim=-1), splats.opacity_logits),
        *(splats.sh_dc, splats.sh_rest),
    )
    for found, right in zip(parts(read), expected, strict=True):
        if right.numel():
            np.testing.assert_allclose(found, right.numpy(), atol=tolerance)
