"""Narrower fields against slow references in which the neurons that went come to nothing."""

import copy
from dataclasses import replace

import pytest
import torch
from support.configs import composed, options
from support.scenes import ball_scene, tiny_field, tiny_model

from nerf_lightning.config.instantiate import build
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.fields.hash_field import HashField
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.pruning.activity import mean_activity
from nerf_lightning.nerf.pruning.narrow import narrowed, neurons_of
from nerf_lightning.nerf.pruning.prune import Pruning, prunable_fields, prune
from nerf_lightning.nerf.pruning.selection import Kept
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.points import Points

EVERY = [("importance", "out"), ("importance", "in"), ("importance", "both"), ("coreset", "out"), ("random", "out"),
         ("activation", "out")]  # fmt: skip


def points(count=50):
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    return Points(2 * torch.rand(count, 3) - 1, directions)


def hash_field(width=32):
    small = "encoder.num_levels=3", "encoder.log2_table_size=8", "encoder.max_resolution=16"
    torch.manual_seed(2)
    field = build(
        composed("train", "model=fast", "field=hash", *small, f"field.width={width}", "field.density_bias=0.0").field
    )
    torch.nn.init.normal_(field.position_encoder.table)
    return field


def chosen(field, seed=0):
    """A choice of half of each layer's neurons, with factors."""
    generator, kept = torch.Generator().manual_seed(seed), {}
    for layer in field.hidden_layers():
        there = field.state_dict()[layer.rows[0]].shape[0]
        numbers = torch.randperm(there, generator=generator)[: there // 2].sort().values
        kept[layer] = Kept(numbers, 0.5 + torch.rand(there // 2, generator=generator))
    return kept


def masks_of(kept, sizes):
    masks = []
    for each, size in zip(kept.values(), sizes, strict=True):
        mask = torch.zeros(size)
        mask[each.numbers] = each.factors
        masks.append(mask)
    return masks


@pytest.mark.parametrize("changes", [{"depth": 4}, {"skip": 1}, {"skip": None}, {"batch_norm": True}], ids=str)
def test_a_narrower_mlp_is_the_wide_one_with_masks(changes):
    torch.manual_seed(0)
    wide, thin = tiny_field(**changes).eval(), tiny_field(**changes | {"width": 8}).eval()
    for module in wide.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            torch.nn.init.uniform_(module.running_mean)
            torch.nn.init.uniform_(module.running_var, 0.5, 2.0)
            torch.nn.init.uniform_(module.bias)
    kept = chosen(wide)
    thin.load_state_dict(narrowed(wide.state_dict(), kept))
    layers = [*wide.trunk, wide.feature, wide.color_hidden]
    for layer, mask in zip(layers, masks_of(kept, [16] * (len(layers) - 1) + [8]), strict=True):
        layer.register_forward_hook(lambda _, inputs, output, mask=mask: output * mask)
    where = points()
    found, expected = thin(where), wide(where)
    torch.testing.assert_close(found.density, expected.density, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found.rgb, expected.rgb, rtol=1e-4, atol=1e-5)


def test_a_narrower_hash_field_is_the_wide_one_with_masks():
    wide, thin, where = hash_field(32), hash_field(16), points()
    kept = chosen(wide)
    thin.load_state_dict(narrowed(wide.state_dict(), kept))
    masks = masks_of(kept, [32, 32, 32])
    encoded = wide.position_encoder((where.positions + 1) / 2)
    hidden = torch.relu(encoded @ wide.density_mlp[0].T) * masks[0] @ wide.density_mlp[1].T
    color = torch.cat([hidden, wide.direction_encoder(where.directions)], dim=-1)
    color = torch.relu(color @ wide.color_mlp[0].T) * masks[1]
    color = torch.relu(color @ wide.color_mlp[1].T) * masks[2] @ wide.color_mlp[2].T
    found = thin(where)
    torch.testing.assert_close(found.density, torch.exp(hidden[:, 0]), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found.rgb, torch.sigmoid(color), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("option", options("field"))
def test_every_field_is_narrowed_to_one_of_half_its_width(option):
    method = "nerf" if option.startswith("nerf_mlp") else "fast_small"
    small = () if method == "nerf" else ("encoder.log2_table_size=8",)
    settings = composed("train", f"model={method}", f"field={option}", *small)
    wide = build(settings.field)
    settings.field.width //= 2
    thin = build(settings.field)
    where, state = points(8), wide.state_dict()
    layers = wide.hidden_layers()
    sizes = [layer.shape[-1] for layer in wide.eval().hidden_activations(where)]
    assert sizes == [state[layer.rows[0]].shape[0] for layer in layers]
    thin.load_state_dict(narrowed(state, chosen(wide)))
    # Every matrix became smaller but those of the encoders.
    same = [
        name for name, tensor in thin.state_dict().items() if tensor.ndim == 2 and tensor.shape == state[name].shape
    ]
    assert all("encoder" in name or name == "aabb" for name in same), same


def test_keeping_all_is_the_identity_to_the_bit():
    model = tiny_model().eval()
    for by, weights in EVERY:
        pruning = Pruning(keep=1.0, by=by, weights=weights)
        state = prune(model, model, pruning, ball_scene(), 1 << 14)
        assert all(torch.equal(state[name], tensor) for name, tensor in model.state_dict().items())


@pytest.mark.parametrize("field", [tiny_field(depth=4), hash_field(16)], ids=lambda field: type(field).__name__)
def test_neurons_that_nothing_reads_go_and_nothing_changes(field):
    field = copy.deepcopy(field).eval()
    state = field.state_dict()
    for number, layer in enumerate(field.hidden_layers()):
        there = state[layer.rows[0]].shape[0]
        unread = torch.randperm(there, generator=torch.Generator().manual_seed(number))[: there // 2]
        for name in layer.columns:
            state[name][:, unread] = 0.0
    model, where = RadianceModel({"only": DenseLevel(StratifiedSampler(4), field)}), points()
    before = field(where)
    thin = tiny_field(depth=4, width=8) if not isinstance(field, HashField) else hash_field(8)
    narrower = RadianceModel({"only": DenseLevel(StratifiedSampler(4), thin)})
    narrower.load_state_dict(prune(model, narrower, Pruning(0.5, round_to=8), ball_scene(), 1 << 14))
    after = thin.eval()(where)
    torch.testing.assert_close(after.density, before.density, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(after.rgb, before.rgb, rtol=1e-5, atol=1e-6)


def test_activity_is_the_mean_over_the_points_that_are_asked_about():
    """Against the same points, written down by a sampler's level of its own; and the fields are as they were."""
    model = tiny_model().eval()
    fields, scene = prunable_fields(model), ball_scene()
    seen = {name: [] for name in fields}
    known = type(model.levels["coarse"].field).hidden_activations
    found = mean_activity(model, fields, scene, key=4, tile_points=1 << 12)
    for name, field in fields.items():
        field.register_forward_pre_hook(lambda _, inputs, name=name: seen[name].append(inputs[0]))
    again = mean_activity(model, fields, scene, key=4, tile_points=1 << 12)
    for name, field in fields.items():
        field._forward_pre_hooks.clear()
        layers = [known(field, each) for each in seen[name][::2]]  # each is asked, and looked into
        for number, layer in enumerate(found[name]):
            expected = torch.cat([tile[number].flatten(0, -2) for tile in layers]).abs().mean(dim=0)
            torch.testing.assert_close(layer.float(), expected, rtol=1e-4, atol=1e-5)
            assert torch.equal(layer, again[name][number])
        assert "density" not in vars(field)


def test_a_field_that_is_asked_about_nothing_is_said():
    model = tiny_model().eval()
    fields = prunable_fields(model) | {"another": tiny_field()}
    with pytest.raises(InputError, match=r"No ray of the training views asks model\.another about any point"):
        mean_activity(model, fields, ball_scene(), key=4, tile_points=1 << 12)


def test_the_bias_is_a_weight_that_makes_a_neuron_and_the_norm_is_not():
    for field in (tiny_field(), tiny_field(batch_norm=True)):
        state, (first, *_) = field.state_dict(), field.hidden_layers()
        assert torch.equal(neurons_of(state, first).incoming[:, -1], state["trunk.0.0.bias"])
        assert neurons_of(state, first).incoming.shape[1] == field.position_encoder.out_dim + 1


def test_widths_are_whole_vectors_and_something_is_left():
    assert [Pruning(keep).width(64, "f") for keep in (1.0, 0.75, 0.5, 0.4, 0.25, 0.1)] == [64, 48, 32, 32, 16, 16]
    assert Pruning(0.5).width(16, "f") == 16
    assert Pruning(0.5, round_to=1).width(15, "f") == 8
    with pytest.raises(
        InputError, match=r"keep=0.01 leaves 0.64 of the 64 neurons .* of f has: nothing. Give keep=0.25"
    ):
        Pruning(0.01).width(64, "f")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"keep": 0.0}, "keep=0.0: give the share of neurons that stay, above 0"),
        ({"keep": 1.5}, "keep=1.5: give the share"),
        ({"keep": float("nan")}, "keep=nan: give the share"),
        ({"round_to": 0}, "round_to=0: give 1 or more"),
    ],
)
def test_settings_that_are_none_are_refused(setting, words):
    with pytest.raises(InputError, match=words):
        replace(Pruning(), **setting)
