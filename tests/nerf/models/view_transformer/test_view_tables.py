"""Looking up colours and features between pixels of views, and keeping what was made of them."""

from dataclasses import replace

import pytest
import torch
from support.looking import looking_model
from support.scenes import ball_scene
from torch.nn.functional import grid_sample

from nerf_lightning.nerf.models.view_transformer.view_tables import ViewTable
from nerf_lightning.nerf.rendering.blending import photograph

CPU = torch.device("cpu")


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_it_is_bilinear_and_repeats_the_border(scale):
    torch.manual_seed(0)
    maps = [torch.randn(3, 5, 7), torch.randn(3, 4, 6)]
    sizes = torch.tensor([[7, 5], [6, 4]])
    table = ViewTable(torch.cat([each.flatten(1).T for each in maps]), torch.tensor([0, 35]), sizes, scale)
    view = torch.randint(0, 2, (200,))
    at = (1.2 * torch.rand(200, 2) - 0.1) * scale * sizes[view]
    found = table.look_up(view, at)
    for number, each in enumerate(maps):
        place = 2.0 * at[view == number] / (scale * sizes[number]) - 1.0
        expected = grid_sample(each[None], place[None, None], align_corners=False, padding_mode="border")[0, :, 0].T
        torch.testing.assert_close(found[view == number], expected, atol=1e-5, rtol=1e-4)


def chosen(*views):
    return torch.tensor(views), views


def test_pixels_are_found_at_their_centres():
    scene = ball_scene()
    model = looking_model(scene)
    table = model.tables.colors(*chosen(4, 1))
    x, y = torch.tensor([0, 3, 11]), torch.tensor([5, 0, 11])
    found = table.look_up(torch.tensor([1, 1, 1]), torch.stack([x, y], dim=-1) + 0.5)
    torch.testing.assert_close(found, photograph(scene, 1, "white")[y, x])


def test_features_are_kept_until_a_weight_changes():
    model = looking_model()
    with torch.no_grad():
        first = model.tables.features(*chosen(0, 2), model.image_network).rows
        calls = []
        model.image_network.register_forward_hook(lambda *_: calls.append(1))
        again = model.tables.features(*chosen(2, 0), model.image_network).rows
        assert torch.equal(again, first.view(2, -1, 8).flip(0).flatten(0, 1))
        assert not calls
        model.tables.features(*chosen(0, 1), model.image_network)
        assert len(calls) == 1
        model.image_network.out.bias.add_(1.0)
        torch.testing.assert_close(model.tables.features(*chosen(0, 2), model.image_network).rows, first + 1.0)


def test_views_may_differ_in_size():
    scene = ball_scene(4, 12)
    cut = replace(
        scene.pixels,
        width=torch.tensor([12, 12, 12, 12]),
        height=torch.tensor([12, 6, 12, 6]),
    )
    cameras = replace(scene.cameras, height=cut.height)
    model = looking_model(replace(scene, pixels=cut, cameras=cameras), range(4))
    table = model.tables.features(*chosen(0, 1, 2, 3), model.image_network)
    alone = model.tables.features(*chosen(3), model.image_network)
    place = torch.tensor([[3.3, 2.2]])
    torch.testing.assert_close(table.look_up(torch.tensor([3]), place), alone.look_up(torch.tensor([0]), place))
