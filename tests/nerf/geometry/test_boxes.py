import torch
from support.scenes import some_rays

from nerf_lightning.nerf.geometry.boxes import distances_in_box, to_unit_cube

AABB = torch.tensor([[-1.0, -0.5, -2.0], [1.0, 0.5, 0.3]])


def test_a_ray_is_in_the_box_between_entering_and_leaving_it():
    rays = some_rays(500)
    enter, leave = distances_in_box(rays, AABB)
    t = torch.linspace(2.0, 6.0, 401)
    points = rays.origins[:, None] + t[:, None] * rays.directions[:, None]
    inside = ((points > AABB[0]) & (points < AABB[1])).all(-1)
    between = (t > enter[:, None]) & (t < leave[:, None])
    close = ((t - enter[:, None]).abs() < 1e-4) | ((t - leave[:, None]).abs() < 1e-4)
    assert bool(((inside == between) | close).all())
    assert 0.1 < float((enter < leave).float().mean()) < 0.99


def test_rays_along_the_axes_are_not_lost():
    rays = some_rays(1)
    rays.origins.copy_(torch.tensor([[0.2, 0.1, 4.0]]))
    rays.directions.copy_(torch.tensor([[0.0, 0.0, -1.0]]))
    enter, leave = distances_in_box(rays, AABB)
    torch.testing.assert_close(torch.cat([enter, leave]), torch.tensor([3.7, 6.0]))


def test_the_unit_cube_has_the_boxes_corners():
    torch.testing.assert_close(to_unit_cube(AABB, AABB), torch.tensor([[0.0] * 3, [1.0] * 3]))
