"""The parts of a view transformer against slow references."""

from dataclasses import replace

import pytest
import torch
from looking import looking_model, rays_of_views
from support.scenes import LENSES, ball_scene
from torch.nn.functional import grid_sample

from nerf_lightning.extensions.view_transformer.attention import attend
from nerf_lightning.extensions.view_transformer.experts import Experts, Gates, imbalance, roughness
from nerf_lightning.extensions.view_transformer.image_network import local_deviation
from nerf_lightning.extensions.view_transformer.projection import project_samples, seen_cosines
from nerf_lightning.extensions.view_transformer.source_views import choose_sources
from nerf_lightning.extensions.view_transformer.view_tables import ViewTable
from nerf_lightning.nerf.geometry.cameras import project
from nerf_lightning.nerf.geometry.photographs import photographs_of
from nerf_lightning.nerf.randomness import batch_random


def test_attention_is_the_mean_under_a_softmax_of_what_is_visible():
    torch.manual_seed(0)
    scores, values = (torch.randn(2, 2, 3, 4, dtype=torch.float64, requires_grad=True) for _ in range(2))
    visible = torch.tensor([[[True, False, True], [True] * 3], [[False] * 3, [False, True, False]]])
    seen = attend(scores, values, visible)
    weights = scores.masked_fill(~visible[..., None], -1e30).softmax(dim=-2)
    torch.testing.assert_close(seen, (weights * values).sum(dim=-2) * visible.any(dim=-1)[..., None])
    assert torch.autograd.gradcheck(lambda s, v: attend(s, v, visible), (scores, values))


def test_experts_are_the_mean_of_the_permanent_and_of_the_two_that_are_chosen():
    torch.manual_seed(0)
    layer, state = Experts(8, 4), torch.randn(1, 8)
    found, gates = layer(state, None)
    assert int((gates.chosen != 0).sum()) == 2
    normed, of_experts = layer.permanent.norm(state)[0], torch.zeros(8)
    for number, gate in enumerate(gates.chosen[0]):
        rows = slice(32 * number, 32 * (number + 1))
        wide = torch.relu(layer.wide.weight[rows] @ normed + layer.wide.bias[rows])
        of_experts += gate * (layer.out.weight[:, rows] @ wide + layer.out_bias[number])
    torch.testing.assert_close(found[0], state[0] + 0.5 * (layer.permanent.change(normed) + of_experts))


def test_the_losses_of_experts_by_hand():
    pairs = torch.tensor([[0.5, 0.5, 0, 0], [0, 0, 0.5, 0.5], [0.5, 0, 0.5, 0], [0, 0.5, 0, 0.5]])
    assert float(imbalance(Gates(pairs, pairs, (pairs > 0).float()))) == 0.0
    one_sided = pairs[:1].expand(4, 4)
    # Means 1/2, 1/2, 0, 0: variance over squared mean is 1, for the gates and for the load.
    assert float(imbalance(Gates(one_sided, one_sided, (one_sided > 0).float()))) == 2.0
    rays = rays_of_views(ball_scene(), [0, 3], every=40)
    target = (rays.photograph == 3).long()
    rough = torch.tensor([[0.7, 0.1, 0.1, 0.1], [0.1, 0.1, 0.1, 0.7]])[target][:, None].expand(-1, 5, 4).clone()
    rough[0] = rough[0].flip(-1)
    found = roughness(Gates(rough, rough, rough), rays, target)
    # KL((.7 .1 .1 .1) | (.1 .1 .1 .7)), from each neighbor; rays of another target are none.
    torch.testing.assert_close(found[0], 0.6 * torch.tensor(7.0).log())
    assert float(found[target == 1].abs().max()) < 1e-6


@pytest.mark.parametrize(("lens_model", "lens"), [("pinhole", (0.0,) * 6), ("equirectangular", (0.0,) * 6), *LENSES])
def test_samples_lie_where_points_are_projected(lens_model, lens):
    scene = ball_scene(8, 64, lens=lens, lens_model=lens_model)
    rays = rays_of_views(scene, [0, 3], every=97)
    count = len(rays.near)
    places = torch.stack([torch.arange(count) % 8, torch.arange(count) * 3 % 8], dim=1)
    t = torch.linspace(0.1, 9.0, 7).expand(count, 7)
    found = project_samples(scene.cameras, seen_cosines(scene.cameras), places, rays, t)
    exact = scene.cameras.map(lambda each: each.double() if each.is_floating_point() else each)
    points = rays.origins[:, None].double() + t[..., None].double() * rays.directions[:, None].double()
    assert found.visible.float().mean() > 0.05
    for ray in range(count):
        for source, view in enumerate(places[ray].tolist()):
            seen = found.visible[ray, :, source]
            expected = project(exact, view, points[ray])[seen]
            torch.testing.assert_close(found.xy[ray, seen, source].double(), expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("key", [None, *range(20)])
def test_the_nearest_of_the_same_capture_are_sources_and_never_the_view_itself(key):
    capture = torch.arange(12) % 2
    scene = replace(ball_scene(12), capture_of=tuple(capture.tolist()), captures=("even", "odd"))
    rays = rays_of_views(scene, [2, 5], every=50)
    rays = replace(rays, capture=capture[rays.photograph])
    random = None if key is None else batch_random(key, len(rays.near))
    sources = choose_sources(photographs_of(scene, range(12)), rays, 2, random)
    for ray, target in enumerate(sources.target.tolist()):
        places, view = sources.views[target][sources.valid[target]].tolist(), int(rays.photograph[ray])
        assert view not in places
        assert all(place % 2 == view % 2 for place in places)
        assert key is not None or set(places) == {view - 2, (view + 2) % 12}


@pytest.mark.parametrize("scale", [1, 4])
def test_a_table_is_bilinear_and_repeats_the_border(scale):
    torch.manual_seed(0)
    maps, sizes = [torch.randn(3, 5, 7), torch.randn(3, 4, 6)], torch.tensor([[7, 5], [6, 4]])
    table = ViewTable(torch.cat([each.flatten(1).T for each in maps]), torch.tensor([0, 35]), sizes, scale)
    view = torch.randint(0, 2, (200,))
    at = (1.2 * torch.rand(200, 2) - 0.1) * scale * sizes[view]
    found = table.look_up(view, at)
    for number, each in enumerate(maps):
        place = 2.0 * at[view == number] / (scale * sizes[number]) - 1.0
        expected = grid_sample(each[None], place[None, None], align_corners=False, padding_mode="border")[0, :, 0].T
        torch.testing.assert_close(found[view == number], expected, atol=1e-5, rtol=1e-4)


def test_features_are_kept_until_a_weight_changes():
    model, views = looking_model(), (torch.tensor([0, 2]), [0, 2])
    with torch.no_grad():
        first, calls = model.tables.features(*views, model.image_network).rows, []
        model.image_network.register_forward_hook(lambda *_: calls.append(1))
        assert torch.equal(model.tables.features(*views, model.image_network).rows, first)
        assert not calls
        model.image_network.out.bias.add_(1.0)
        torch.testing.assert_close(model.tables.features(*views, model.image_network).rows, first + 1.0)


def test_neurn_is_the_deviation_of_each_patch_whatever_the_gain():
    picture = torch.rand(1, 1, 11, 14, generator=torch.Generator().manual_seed(0))
    deviation = picture[0, 0].unfold(0, 3, 1).unfold(1, 3, 1).flatten(2).std(dim=-1, correction=0)
    found = local_deviation(picture)
    torch.testing.assert_close(found[0, 0, 1:-1, 1:-1] / found[0, 0, 1:-1, 1:-1].max(), deviation / deviation.max())
    torch.testing.assert_close(local_deviation(0.02 * picture + 0.9), found, atol=2e-5, rtol=0)
