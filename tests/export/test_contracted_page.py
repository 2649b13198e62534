"""Scenes without bounds: the shell around the box, where rays bend between the parts of a contracted cube."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.baked_ball import baked_ball, quiet, shiny_model
from support.contracted_hall import hall_model, hall_record, hall_scene
from support.known_fields import ball

from nerf_lightning.export.baking.contraction import Contraction, is_place, num_values
from nerf_lightning.export.baking.cost import measured_cost
from nerf_lightning.export.baking.density import dilated
from nerf_lightning.export.baking.marcher import Marcher
from nerf_lightning.export.voxel_kernels.layout import kernels
from nerf_lightning.nerf.types.rays import RayBundle


def contracted(u):
    """Eq. 4 of arXiv 2302.12249."""
    r = u.abs().amax(dim=-1, keepdim=True)
    beyond = torch.where(u.abs() == r, (2 - 1 / r) * u.sign(), u / r)
    return torch.where(r <= 1, u, beyond)


@pytest.fixture(scope="module")
def baked():
    return baked_ball(64, 4, hall_model(), hall_record())


def test_the_cube_holds_all_of_space_and_gives_it_back():
    space = Contraction((1.0, -2.0, 0.5), 3.0, 0.1)
    directions = torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    world = torch.tensor(space.center) + directions * torch.logspace(-1, 2, 200)[:, None]
    places = contracted(space.unit(world))
    assert is_place(places).all()
    torch.testing.assert_close(space.world(places), world, atol=1e-3, rtol=1e-3)
    rim = torch.tensor([[2.0, 0.0, 0.0], [1.5, 1.5, 0.0], [1.2, 0.0, -1.2]])
    assert not is_place(rim).any()


def test_the_bytes_look_like_the_model(baked):
    assert baked.shape == (num_values(64) // 8,) * 3
    scene = hall_scene()
    cost = measured_cost(Marcher(baked), hall_model(), hall_record(), scene, 2, 1 << 16, quiet)
    assert cost.page_to_model > 30


def test_the_ways_of_light_outside_the_box_are_as_long_as_they_are():
    """Fog of constant density, from within the box and from without, along the axes and across the parts."""
    sigma, end = 0.4, 2.5
    fog = shiny_model(ball(end), inside=sigma)
    marcher = Marcher(baked_ball(48, 1, fog, hall_record()))
    ways = torch.nn.functional.normalize(
        torch.tensor([[1.0, 0, 0], [1, 0.9, 0], [0.7, -0.7, -0.1], [-1, 0, 0]]), dim=-1
    )
    origins = torch.tensor([[0.0, 0, 0], [-0.2, 0.3, 0], [0.1, 0, 0], [1.9, 0.4, 0.2]])
    near, far = torch.zeros(4), torch.full((4,), 9.0)
    found = marcher.render(RayBundle(origins, ways, near, far, ways))
    along = (origins * ways).sum(dim=-1)
    length = -along + (along**2 + end**2 - origins.square().sum(dim=-1)).sqrt() - 0.05
    torch.testing.assert_close(found.opacity, 1 - torch.exp(-sigma * length), atol=0.03, rtol=0)


def test_depth_is_in_units_of_the_scene(baked):
    ways = torch.tensor([[-1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    origins, none = torch.tensor([[1.0, 1.2, 0.0], [2.0, 0.0, 0.0]]), torch.zeros(2)
    found = Marcher(baked).render(RayBundle(origins, ways, none, none + 9.0, ways))
    t = torch.linspace(0.05, 8.0, 8000)
    density = hall_model().density((origins[:, None] + t[:, None] * ways[:, None]).flatten(0, 1)).view(2, -1)
    stopped = -torch.exp(-(density * t.diff()[0]).cumsum(dim=1)).diff(dim=1)
    torch.testing.assert_close(
        found.depth, (stopped @ t[1:]) / stopped.sum(dim=1), atol=0, rtol=0.15
    )  # the last 2 % are left out


def test_the_light_of_rays_is_stopped_where_it_is_and_all_of_it_is_shared_out():
    """In fog of constant density within a ball, from its middle and from beside it; closed form: 1 - exp(-sigma l)."""
    sigma, end, grid = 0.4, 2.5, 64
    space = Contraction((0.0, 0.0, 0.0), 1.0, 0.05)
    places = torch.from_numpy(4.0 / grid * np.stack(np.indices((grid,) * 3), axis=-1) - 2.0).float()
    inside = is_place(places) & (space.world(places).norm(dim=-1) < end)
    optical = (sigma * 4.0 / grid * space.radius(places).square() * inside).numpy()
    ways = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    origins = torch.zeros(200, 3)
    origins[100:] = torch.tensor([0.5, -0.3, 0.2])
    stopped = kernels("contracted").stopped_light(optical, origins.numpy(), ways.numpy(), space.near, 0.5)
    along = (origins * ways).sum(dim=-1)
    length = -along + (along**2 + end**2 - origins.square().sum(dim=-1)).sqrt() - space.near
    assert stopped.sum() == pytest.approx(float((1 - torch.exp(-sigma * length)).sum()), rel=0.02)
    assert (stopped[dilated(optical > 0) == 0] == 0).all()


def test_what_no_view_sees_is_left_out_and_what_is_missing_is_as_what_is_met():
    """A wall all around, and as much again behind it."""

    def wall(positions):
        away = positions.norm(dim=-1)
        return torch.maximum(2.0 - away, away - 4.0)

    baked = baked_ball(48, 1, shiny_model(wall, inside=50.0), hall_record())
    assert baked.closed
    at = np.argwhere(baked.colored)
    block = np.stack(np.unravel_index(baked.blocks[at[:, 0]], baked.shape), axis=1)
    places = torch.from_numpy(np.array(baked.lower) + np.array(baked.spacing) * (8 * block + at[:, 1:])).float()
    assert baked.contraction.world(places).norm(dim=-1).max() < 3.2
    ways = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    none = torch.zeros(500)
    rays = RayBundle(torch.zeros(500, 3), ways, none, none + 9.0, ways)
    thin = replace(baked, density=np.minimum(baked.density, 150))
    met, as_it_is = Marcher(thin).render(rays), Marcher(replace(thin, closed=False)).render(rays)
    some = as_it_is.opacity > 0.35
    assert some.sum() > 4
    torch.testing.assert_close(met.opacity[some], torch.ones(int(some.sum())))
    torch.testing.assert_close(met.rgb[some], as_it_is.rgb[some] / as_it_is.opacity[some, None])
    torch.testing.assert_close(met.depth, as_it_is.depth)
