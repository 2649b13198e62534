import math
from dataclasses import replace

import pytest
import torch
from support.known_fields import ball, solid
from support.scenes import ball_scene
from torch.nn.functional import normalize

from nerf_lightning.data.pixels.picture_files import read_rgba
from nerf_lightning.evaluation.evaluator import Scoring
from nerf_lightning.evaluation.geometry_errors import depth_error, normal_error
from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.geometry.surfaces import normals_from_depth, surface_depth
from nerf_lightning.nerf.types.scene import Truth

FAR = 6.0


def picture_rays(size=48, focal=60.0):
    """The rays of one oblique camera, with the world turned so that no axis is special."""
    eye = torch.tensor([[2.0, -3.0, 1.5]], dtype=torch.float64)
    c2w = look_at(eye, torch.zeros_like(eye), torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64))
    cameras = pinhole_cameras(c2w, focal, size, size)
    near, far = torch.zeros(1, dtype=torch.float64), torch.full((1,), FAR, dtype=torch.float64)
    return rays_through_pixels(cameras, all_pixels(cameras, 0), near, far)


def plane(rays, normal):
    distance = -(rays.origins @ normal) / (rays.directions @ normal)
    return rays.origins + distance[..., None] * rays.directions


def sphere(rays, radius=1.0):
    middle = (rays.origins * rays.directions).sum(dim=-1)
    inside = middle**2 - (rays.origins.square().sum(dim=-1) - radius**2)
    distance = -middle - inside.clamp(min=0).sqrt()
    hit = inside > 0
    points = rays.origins + torch.where(hit, distance, FAR)[..., None] * rays.directions
    return points, hit


def test_depth_is_scored_without_escaping_light_and_where_the_scene_covers_the_pixel():
    opacity = torch.tensor([1.0, 0.5, 0.01, 0.0], dtype=torch.float64)
    depth = 2.5 * opacity + FAR * (1 - opacity)
    found = surface_depth(depth, opacity, torch.full_like(depth, FAR))
    torch.testing.assert_close(found, torch.tensor([2.5, 2.5, 2.5, FAR], dtype=torch.float64))
    truth = torch.tensor([2.0, 2.0, 2.0, math.inf])
    opacity = torch.tensor([1.0, 0.5, 1.0, 0.0])
    depth = torch.tensor([2.5, 0.5 * 1.9 + 0.5 * FAR, 5.0, FAR])
    alpha = torch.tensor([1.0, 1.0, 0.99, 1.0])
    far = torch.full((4,), FAR)
    assert math.isclose(depth_error(depth, opacity, far, truth, alpha), (0.5 + 0.1) / 2, abs_tol=1e-6)
    assert depth_error(depth, opacity, far, truth, torch.zeros(4)) is None


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, -0.6, 0.2), (-0.1, 0.9, -0.4)])
def test_a_plane_has_its_normal_exactly(normal):
    rays = picture_rays(16, focal=200.0)
    normal = normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    found = normals_from_depth(plane(rays, normal))
    facing = normal if float(rays.directions[8, 8] @ normal) < 0 else -normal
    torch.testing.assert_close(found, facing.expand_as(found))
    assert ((found * rays.directions).sum(dim=-1) < 0).all()


def test_a_spheres_normals_are_near_and_face_the_camera():
    rays = picture_rays(96, focal=130.0)
    points, hit = sphere(rays)
    normals = normals_from_depth(points)
    truth = torch.where(hit[..., None], points, 0.0)
    error = normal_error(normals, truth, hit.double())
    assert error < 1.0
    inner = torch.linalg.cross(rays.directions, truth).norm(dim=-1) < 0.8
    assert ((normals * rays.directions).sum(dim=-1) < 0)[inner & hit].all()
    finer = picture_rays(192, focal=260.0)
    fine_points, fine_hit = sphere(finer)
    fine_truth = torch.where(fine_hit[..., None], fine_points, 0.0)
    assert normal_error(normals_from_depth(fine_points), fine_truth, fine_hit.double()) < 0.6 * error


def test_waves_of_the_depth_are_smoothed():
    rays, generator = picture_rays(48, focal=200.0), torch.Generator().manual_seed(0)
    normal = normalize(torch.tensor([0.5, -0.6, 0.2], dtype=torch.float64), dim=0)
    points = plane(rays, normal)
    pixel = (points[1:] - points[:-1]).norm(dim=-1).median()
    noise = 0.15 * pixel * torch.randn(48, 48, 1, generator=generator, dtype=torch.float64)
    rough = points + noise * rays.directions
    down, along = torch.gradient(rough, dim=(0, 1))
    differences = normalize(torch.linalg.cross(down, along), dim=-1)
    truth, alpha = (-normal).expand_as(points), torch.ones(48, 48, dtype=torch.float64)
    if float(rays.directions[8, 8] @ normal) < 0:
        truth = -truth
    assert normal_error(normals_from_depth(rough), truth, alpha) < 0.5 * normal_error(differences, truth, alpha)


def test_normals_are_their_own_surfaces_beside_an_edge_and_beside_a_pixel_without_a_point():
    rays = picture_rays(32, focal=60.0)
    normal = normalize(torch.tensor([0.5, -0.6, 0.2], dtype=torch.float64), dim=0)
    points = plane(rays, normal)
    points[:, 16:] = (points + 2.0 * rays.directions)[:, 16:]
    facing = normal if float(rays.directions[8, 8] @ normal) < 0 else -normal
    found = normals_from_depth(points)[:, :16]
    assert float((found * facing).sum(dim=-1).min()) > math.cos(math.radians(2.0))
    rays = picture_rays(16, focal=200.0)
    normal = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    points = plane(rays, normal)
    points[5, 5], points[9, 3] = math.inf, math.nan
    found = normals_from_depth(points)
    kept = points.isfinite().all(dim=-1)
    torch.testing.assert_close(found[kept], normal.expand_as(found[kept]))


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 30.0, 90.0, 180.0])
def test_the_angle_is_in_degrees(degrees):
    truth = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(5, 5, 3)
    angle = math.radians(degrees)
    tilted = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64).expand(5, 5, 3)
    alpha = torch.ones(5, 5, dtype=torch.float64)
    assert normal_error(tilted, truth, alpha) == pytest.approx(degrees, rel=1e-9, abs=1e-12)


def test_only_pixels_whose_neighbours_are_covered_count():
    truth = torch.tensor([0.0, 0.0, 1.0]).repeat(5, 5, 1)
    normals = torch.tensor([1.0, 0.0, 0.0]).repeat(5, 5, 1)
    normals[2, 3] = truth[2, 3]
    alpha = torch.ones(5, 5)
    alpha[1, 1] = alpha[3, 1] = 0.5
    # Rows and columns 1 to 3 are inside; on or beside the two half-covered pixels nothing counts. That leaves
    # (1,3), (2,2), (2,3) and (3,3).
    assert normal_error(normals, truth, alpha) == pytest.approx(90.0 * 3 / 4)
    truth[2, 2] = 0.0
    assert normal_error(normals, truth, alpha) == pytest.approx(90.0 * 2 / 3)
    assert normal_error(normals, truth, torch.zeros(5, 5)) is None


def test_true_and_rendered_depths_of_all_views_are_shown_on_one_scale(tmp_path):
    scene = ball_scene(num_views=6, size=24)
    c2w = scene.cameras.c2w.clone()
    c2w[2, :, 3] *= 1.2  # farther
    scene = replace(scene, cameras=replace(scene.cameras, c2w=c2w), far=1.2 * scene.far)
    depth = torch.full((24 * 24,), 2.0)
    scene = replace(scene, truth=lambda view: Truth(depth, torch.zeros(24 * 24, 3)))
    Scoring(split="train", num_worst=1).score(solid(ball()), scene, "white", 1 << 15, tmp_path)
    views = sorted((tmp_path / "images" / "views").iterdir())
    pictures = [read_rgba(view / f"{name}.png")[..., :3] for view in views for name in ("depth", "true_depth")]
    assert len(pictures) > 4
    legends = {picture[:, 24:].tobytes() for picture in pictures}
    assert len(legends) == 1
    assert len({picture[:, :24].tobytes() for picture in pictures[::2]}) > 1
