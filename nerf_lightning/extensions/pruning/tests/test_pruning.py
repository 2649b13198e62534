"""Which neurons and table entries stay, and `nerf prune` from end to end."""

import copy
from dataclasses import replace

import pytest
import torch
import yaml
from support.configs import composed
from support.planted import write_checkpoint
from support.running import refused, said
from support.scenes import ball_scene, some_rays, tiny_field, tiny_model

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.cli.prepare import prepared
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.load_model import load_model
from nerf_lightning.extensions.pruning.fine_tuning import fine_tuning
from nerf_lightning.extensions.pruning.prune import Pruning, prunable_fields, prune
from nerf_lightning.extensions.pruning.quantized_weights import quantized_weights, reached_entries
from nerf_lightning.extensions.pruning.selection import Neurons, choose, coreset, importance, neurons_of
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.rays import Points


def test_what_counts_most_stays():
    layer = Neurons(torch.tensor([[1.0, 1], [0, 4], [9, 9]]), torch.tensor([[5.0, -1, 1], [1, 3, 0]]))
    assert importance(layer, "both").tolist() == [2.0, 2.0, 4.75]
    assert choose(layer, 1, "importance", "out", None, 0).numbers.tolist() == [0]
    assert choose(layer, 2, "activation", "out", torch.tensor([0.1, 3.0, 2.0]), 0).numbers.tolist() == [1, 2]


def test_a_coreset_by_hand():
    """P = (0.6, 0.1, 0.3); three of four draws are the first neuron, and an undrawn one fills the free slot."""
    layer = Neurons(torch.tensor([[3.0], [1.0], [1.0]]), torch.tensor([[2.0, 1.0, -3.0]]))
    kept = coreset(layer, 3, torch.tensor([0.0, 0.2, 0.59, 0.65]))
    assert kept.numbers.tolist() == [0, 1, 2]
    torch.testing.assert_close(kept.factors, torch.tensor([3 / (4 * 0.6), 1 / (4 * 0.1), 0.0]))


@pytest.mark.parametrize("by", ["importance", "coreset", "random", "activation"])
def test_keeping_all_keeps_every_bit(by):
    model = tiny_model().eval()
    state = prune(model, model, Pruning(keep=1.0, by=by), ball_scene(), 1 << 14)
    assert all(torch.equal(state[name], tensor) for name, tensor in model.state_dict().items())


@pytest.mark.parametrize("batch_norm", [False, True])
def test_neurons_that_nothing_reads_go_and_nothing_changes(batch_norm):
    field, thin = (tiny_field(depth=4, batch_norm=batch_norm, **width) for width in ({}, {"width": 8}))
    for name, buffer in field.named_buffers():
        if "running" in name:
            torch.nn.init.uniform_(buffer, 0.5, 1.5)
    assert (
        neurons_of(field.state_dict(), field.hidden_layers()[0]).incoming.shape[1] == field.trunk[0][0].in_features + 1
    )
    wide = RadianceModel({"only": DenseLevel(StratifiedSampler(4), field)}).eval()
    narrow = RadianceModel({"only": DenseLevel(StratifiedSampler(4), thin)}).eval()
    state = field.state_dict()
    for layer in field.hidden_layers():
        for name in layer.columns:
            state[name][:, : state[layer.rows[0]].shape[0] // 2] = 0.0
    narrow.load_state_dict(prune(wide, narrow, Pruning(0.5, round_to=8), ball_scene(), 1 << 14))
    where = Points(torch.rand(50, 3), torch.nn.functional.normalize(torch.rand(50, 3), dim=-1))
    torch.testing.assert_close(thin(where).density, field(where).density, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(thin(where).rgb, field(where).rgb, rtol=1e-5, atol=1e-6)
    assert list(prunable_fields(copy.deepcopy(wide))) == ["levels.only.field"]


def test_rays_see_the_same_whatever_stands_where_they_look_nothing_up():
    torch.manual_seed(3)
    small = ("encoder.log2_table_size=12", "encoder.num_levels=3", "encoder.max_resolution=32", "field.width=16")
    model = build(composed("train", "model=fast_small", *small, "model.levels.fine.sampler.resolution=12").model).eval()
    fit_parts(model, ball_scene())
    table, rays = model.last.field.position_encoder.table, some_rays(200)
    torch.nn.init.normal_(table)
    model.last.sampler.grid.occupy(torch.rand(12, 12, 12) < 0.01)
    reached = reached_entries(model.last)
    assert 0 < int(reached.sum()) < 0.8 * reached.numel()
    with torch.no_grad():
        before = model(rays, None, None)[-1]
        table[~reached] = 100.0
        assert torch.equal(before.rgb, model(rays, None, None)[-1].rgb)
        table[reached] = 100.0
        assert not torch.equal(before.rgb, model(rays, None, None)[-1].rgb)
    refused(
        quantized_weights, tiny_model(), "float32", True, parts=("drop_empty=true: this model has no occupancy grid",)
    )


def test_a_narrower_checkpoint_is_one_like_others_and_only_it_is_written_over(nerf, tmp_path):
    given = ("prune", f"ckpt={write_checkpoint(tmp_path / 'tiny.ckpt')}", "by=coreset")
    result = nerf(*given)
    assert result.code == 0, result.err
    assert "levels.fine.field  32 -> 16 neurons wide" in result.out
    checkpoint = read_checkpoint(tmp_path / "pruned")
    assert yaml.safe_load(checkpoint.config)["field"]["width"] == 16
    assert load_model(checkpoint).last.field.color_head.weight.shape == (3, 8)
    assert nerf(*given).code == 0
    checkpoint.path.write_text("precious")
    said(nerf(*given), f"{checkpoint.path} was not written by nerf prune", "paths.output_dir=DIR")


def test_a_run_is_pruned_packed_and_trained_on(nerf, stopped_fast, tmp_path):
    small, run = tmp_path / "small" / "checkpoints" / "last.ckpt", tmp_path / "small" / "finetuned"
    given = ("prune", f"ckpt={stopped_fast}", "keep=0.5", "round_to=8", "tables=int8", "drop_empty=true")
    result = nerf(*given, f"paths.output_dir={tmp_path}/small", "finetune_steps=2")
    assert result.code == 0, result.err
    weights = read_checkpoint(small).weights
    assert weights["levels.fine.field.color_mlp.1"].shape == (3, 8)
    assert weights["levels.fine.field.position_encoder.table"].dtype == torch.float32
    assert read_checkpoint(run).step == 2
    assert "field.width=8" in yaml.safe_load((run / ".hydra" / "overrides.yaml").read_text())
    said(
        nerf(*given, f"paths.output_dir={tmp_path}/small", "finetune_steps=2"),
        f"{run} already contains a fine-tuning run",
    )


def test_fine_tuning_repeats_what_was_chosen_for_the_scene(stopped_fast, tmp_path):
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "overrides.yaml").write_text("[scene=bricks, seed=3]")  # model=auto
    checkpoint = replace(
        read_checkpoint(stopped_fast),
        path=tmp_path,
        choices={"model": "fast_proposal", "loss": "depth"},
        config="{encoder: {max_resolution: 77, log2_table_size: 9}, data: {batch_rays: not a number}}",
    )
    asked = compose_config("train", fine_tuning(checkpoint, {"levels.fine.field": 8}, 2))
    config, choices = asked.config, asked.choices
    assert (choices["model"], choices["loss"], config.seed) == ("fast_proposal", "depth", 3)
    assert (config.encoder.max_resolution, config.encoder.log2_table_size, config.field.width) == (77, 9, 8)


def test_bad_input_is_one_paragraph_and_leaves_nothing(nerf, tmp_path):
    tiny = write_checkpoint(tmp_path / "tiny.ckpt")
    for setting, *words in (
        ("keep=0", "keep=0: give the share of neurons to keep, above 0"),
        ("keep=0.01", "keep=0.01 leaves 0.32 of the 32 neurons", "nothing. Give keep=0.5 or more"),
        ("by=luck", "by=luck is not valid: it must be importance, coreset, random, activation"),
        ("tables=int8", "tables=int8: this model has no hash tables"),
        ("finetune_steps=5", "has no .hydra/overrides.yaml", "init_from=CHECKPOINT"),
    ):
        said(nerf("prune", f"ckpt={tiny}", setting), *words)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tiny.ckpt"]


def test_a_run_needs_no_key():
    assert prepared("prune", ["outputs/run", "keep=0.5"]) == ["keep=0.5", "ckpt='outputs/run'"]
