"""Experts: two of them at each point, a permanent one, and losses that keep them busy and steady."""

import torch
from support.looking import looking_model, rays_of_views
from support.scenes import ball_scene

from nerf_lightning.nerf.models.view_transformer.experts import Experts, Gate, Gates, imbalance, roughness
from nerf_lightning.nerf.randomness import batch_random


def gates(points=50, experts=4, noise=True):
    torch.manual_seed(0)
    gate = Gate(8, experts)
    return gate, gate(torch.randn(3, points, 8), torch.randn(3, points, experts) if noise else None)


def test_exactly_two_gates_are_not_zero_and_sum_to_1():
    for noise in (True, False):
        chosen = gates(noise=noise)[1].chosen
        assert torch.equal((chosen != 0).sum(dim=-1), torch.full(chosen.shape[:-1], 2))
        torch.testing.assert_close(chosen.sum(dim=-1), torch.ones(chosen.shape[:-1]))


def test_gates_are_those_of_float32_where_states_are_not():
    gate, states = Gate(8, 4), torch.randn(3, 5, 8).bfloat16()
    assert torch.equal(gate(states, None).shares, gate(states.float(), None).shares)


def test_the_load_is_how_often_an_expert_is_chosen_under_the_noise():
    torch.manual_seed(2)
    gate = Gate(8, 4)
    states = torch.randn(1, 8).expand(40000, 8)
    found = gate(states, torch.randn(40000, 4))
    torch.testing.assert_close(found.load.mean(dim=0), (found.chosen > 0).float().mean(dim=0), atol=0.02, rtol=0)


def test_the_balance_loss_is_0_for_uniform_use_and_grows_with_preference():
    pairs = torch.tensor([[0.5, 0.5, 0, 0], [0, 0, 0.5, 0.5], [0.5, 0, 0.5, 0], [0, 0.5, 0, 0.5]])
    assert float(imbalance(Gates(pairs, pairs, (pairs > 0).float()))) == 0.0
    one_sided = pairs[:1].expand(4, 4)
    # Means 1/2, 1/2, 0, 0: variance over squared mean is 1, for the gates and for the load.
    assert float(imbalance(Gates(one_sided, one_sided, (one_sided > 0).float()))) == 2.0


def test_the_permanent_expert_alone_is_the_model_without_experts():
    """Experts that all know what the permanent one knows change nothing, whichever are asked."""
    torch.manual_seed(0)
    layer, states = Experts(8, 4), torch.randn(5, 6, 8)
    with torch.no_grad():
        layer.wide.weight.copy_(layer.permanent.wide.weight.repeat(4, 1))
        layer.wide.bias.copy_(layer.permanent.wide.bias.repeat(4))
        layer.out.weight.copy_(layer.permanent.out.weight.repeat(1, 4))
        layer.out_bias.copy_(layer.permanent.out.bias)
    torch.testing.assert_close(layer(states, torch.randn(5, 6, 4))[0], layer.permanent(states))


def test_it_is_the_mean_of_the_permanent_and_of_the_two_that_are_chosen():
    torch.manual_seed(0)
    layer, state = Experts(8, 4), torch.randn(1, 8)
    found, gates = layer(state, None)
    normed = layer.permanent.norm(state)[0]
    of_experts = torch.zeros(8)
    for number, gate in enumerate(gates.chosen[0]):
        rows = slice(32 * number, 32 * (number + 1))
        wide = torch.relu(layer.wide.weight[rows] @ normed + layer.wide.bias[rows])
        of_experts += gate * (layer.out.weight[:, rows] @ wide + layer.out_bias[number])
    expected = state[0] + 0.5 * (layer.permanent.change(normed) + of_experts)
    torch.testing.assert_close(found[0], expected)


def test_rays_that_ask_alike_are_smooth_and_only_neighbours_of_one_target_count():
    scene = ball_scene()
    rays = rays_of_views(scene, [0, 3], every=40)
    target, count = (rays.photograph == 3).long(), len(rays.near)
    per_target = torch.tensor([[0.7, 0.1, 0.1, 0.1], [0.1, 0.1, 0.1, 0.7]])[target]
    alike = per_target[:, None].expand(count, 5, 4)
    torch.testing.assert_close(roughness(Gates(alike, alike, alike), rays, target), torch.zeros(count))
    rough = alike.clone()
    rough[0] = rough[0].flip(-1)
    found = roughness(Gates(rough, rough, rough), rays, target)
    assert found[0] > 0.5
    assert float(found[target == 1].abs().max()) < 1e-6
    # KL((.7 .1 .1 .1) | (.1 .1 .1 .7)), from each neighbour.
    torch.testing.assert_close(found[0], 0.6 * torch.tensor(7.0).log())


def test_every_expert_learns_and_the_gate_too():
    scene = ball_scene()
    model = looking_model(scene, experts=4)
    rays = rays_of_views(scene, [0, 4])
    seen = model(rays, torch.ones(len(rays.near), 3), batch_random(3, len(rays.near)))[0]
    layer = model.blocks[1].after_views
    assert isinstance(layer, Experts)
    for lost in (seen.penalty.mean(), seen.rgb.square().mean()):
        layer.gate.zero_grad()
        lost.backward(retain_graph=True)
        assert layer.gate.vectors.grad.abs().sum() > 0
        assert layer.gate.log_temperature.grad.abs() > 0
    assert layer.out.weight.grad.view(16, 4, -1).abs().sum(dim=(0, 2)).min() > 0
    assert all(parameter.grad.isfinite().all() for parameter in model.parameters())
