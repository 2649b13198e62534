"""`nerf prune` from end to end: what it writes, who reads it, and what it says of bad input."""

import pytest
import torch
import yaml
from support.planted import in_config, write_checkpoint
from support.running import refused, said
from support.scenes import some_rays, tiny_model

from nerf_lightning.checkpoints.reading import read_checkpoint, read_content
from nerf_lightning.commands.fine_tuning import fine_tuning
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.load_model import load_model
from nerf_lightning.config.narrower_model import widths_of
from nerf_lightning.training.packed_weights import packed_weights


@pytest.fixture
def tiny(tmp_path):
    """A checkpoint of model=nerf_tiny, outside of any run."""
    return write_checkpoint(tmp_path / "tiny.ckpt")


def seen_by(path):
    with torch.no_grad():
        return load_model(read_checkpoint(path))(some_rays(100, torch.Generator().manual_seed(0)), None, None)[-1].rgb


def test_a_narrower_checkpoint_is_one_like_others(nerf, tiny, tmp_path):
    result = nerf("prune", f"ckpt={tiny}", "by=coreset")
    assert result.code == 0, result.err
    for level in ("coarse", "fine"):
        assert f"levels.{level}.field  32 -> 16 neurons wide" in result.out
    written = tmp_path / "pruned" / "checkpoints" / "last.ckpt"
    checkpoint = read_checkpoint(tmp_path / "pruned")
    assert checkpoint.path == written
    assert str(written) in result.out
    config = yaml.safe_load(checkpoint.config)
    assert config["field"]["width"] == config["model"]["levels"]["fine"]["field"]["width"] == 16
    assert load_model(checkpoint).last.field.color_head.weight.shape == (3, 8)
    assert checkpoint.step == 7
    # Again: from 16 to 8, where that is no whole vector.
    again = nerf("prune", f"ckpt={tmp_path}/pruned", "round_to=8", f"paths.output_dir={tmp_path}/again", "by=random")
    assert "levels.fine.field  16 -> 8 neurons wide" in again.out
    assert load_model(read_checkpoint(tmp_path / "again")).last.field.feature.weight.shape == (8, 8)


def test_keeping_all_keeps_every_bit(nerf, tiny, tmp_path):
    assert nerf("prune", f"ckpt={tiny}", "keep=1", "by=activation").code == 0
    before, after = read_checkpoint(tiny), read_checkpoint(tmp_path / "pruned")
    assert before.weights.keys() == after.weights.keys()
    assert all(torch.equal(after.weights[name], weight) for name, weight in before.weights.items())
    assert yaml.safe_load(before.config) == yaml.safe_load(after.config)


def test_a_run_is_pruned_packed_measured_and_trained_on(nerf, stopped_fast, capture, tmp_path):
    where = f"paths.output_dir={tmp_path}/small"
    result = nerf("prune", f"ckpt={stopped_fast}", "keep=0.5", "round_to=8", "tables=int8", "drop_empty=true", where,
                  "finetune_steps=2")  # fmt: skip
    assert result.code == 0, result.err
    small, run = tmp_path / "small" / "checkpoints" / "last.ckpt", tmp_path / "small" / "finetuned"
    weights = read_checkpoint(small).weights
    assert weights["levels.fine.field.color_mlp.1"].shape == (3, 8)
    assert weights["levels.fine.field.position_encoder.table"].dtype == torch.float32
    assert read_checkpoint(run).step == 2
    assert "field.width=8" in yaml.safe_load((run / ".hydra" / "overrides.yaml").read_text())
    assert load_model(read_checkpoint(run)).last.field.density_mlp[0].shape[0] == 8
    again = nerf("prune", f"ckpt={stopped_fast}", "keep=0.5", "round_to=8", where, "finetune_steps=2")
    said(again, f"{run} holds a fine-tuning already", f"nerf train resume={run} init_from={small}, or")
    assert "resume=auto" not in again.err
    assert all(torch.equal(tensor, weights[name]) for name, tensor in read_checkpoint(small).weights.items())
    gone_on_with = nerf("train", f"resume={run}", f"init_from={small}")
    assert gone_on_with.code == 0, gone_on_with.err
    # What training goes on from is in the run that followed, and not in the file that was made smaller.
    refused(read_content, small, True, parts=("last.ckpt", "lacks"))


def test_what_fine_tunes_is_the_runs_own_training_at_the_narrower_widths(tmp_path):
    run = tmp_path / "run"
    for folder in (".hydra", "checkpoints"):
        (run / folder).mkdir(parents=True)
    write_checkpoint(run / "checkpoints" / "last.ckpt")
    checkpoint = read_checkpoint(run)

    def after(*typed):
        (run / ".hydra" / "overrides.yaml").write_text(
            yaml.safe_dump([*typed, "paths.output_dir=there", "init_from=a"])
        )
        return fine_tuning(checkpoint, {"levels.coarse.field": 16, "levels.fine.field": 16}, 5)

    length = ["trainer.max_steps=5", "trainer.max_epochs=null", "budget.seconds=null", "data.crop_steps=0"]
    typed = ["optimizer.lr=1e-3", "model=nerf_small"]
    assert after(*typed, "trainer.max_steps=900", "data.crop_steps=9") == [*typed, *length, "field.width=16"]
    # Where nothing was typed, it is the model that the scene had chosen, which the checkpoint remembers.
    assert after("seed=3") == ["seed=3", *length, "model=nerf_tiny", "field.width=16"]
    (run / ".hydra" / "overrides.yaml").write_text("- model=fast_proposal")
    *_, proposal, fine = fine_tuning(checkpoint, {"levels.proposal.field": 8, "levels.fine.field": 32}, 5)
    assert (proposal, fine) == ("model.levels.proposal.field.width=8", "field.width=32")
    compose_config("train", [proposal, fine, "model=fast_proposal"])
    assert fine_tuning(checkpoint, {}, 0) is None


def test_without_neurons_that_went_the_smaller_file_shows_the_same(nerf, stopped_fast, tmp_path):
    given = ("prune", f"ckpt={stopped_fast}", "keep=1", "drop_empty=true", f"paths.output_dir={tmp_path}")
    assert nerf(*given).code == 0
    assert torch.equal(seen_by(tmp_path), seen_by(stopped_fast))


def test_bad_input_is_one_paragraph_and_leaves_nothing(nerf, tiny, tmp_path):
    for settings, *words in (
        (("keep=0",), "keep=0: give the share of neurons that stay, above 0"),
        (("keep=half",), "keep=half does not fit: it must be a number"),
        (("keep=0.01",), "keep=0.01 leaves 0.32 of the 32 neurons", "nothing. Give keep=0.5 or more"),
        (("by=luck",), "by=luck does not fit: it must be importance, coreset, random, activation"),
        (("tables=int8",), "tables=int8: this model has no hash tables"),
        (("finetune_steps=5",), "has no .hydra/overrides.yaml", "init_from=CHECKPOINT"),
    ):
        said(nerf("prune", f"ckpt={tiny}", *settings), *words)
    said(nerf("prune", f"ckpt={tmp_path}/none.ckpt"), "There is no checkpoint at")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tiny.ckpt"]


def test_a_model_without_hidden_layers_is_said(nerf, tmp_path, monkeypatch):
    from nerf_lightning.nerf.fields.nerf_mlp import NerfMLP

    monkeypatch.setattr(NerfMLP, "hidden_layers", lambda field: [])
    path = write_checkpoint(tmp_path / "bare.ckpt")
    said(nerf("prune", f"ckpt={path}"), "no field of the model in", "bare.ckpt has hidden layers", "Give keep=1")


def test_a_config_that_does_not_say_the_width_is_said(tmp_path):
    def forget(config):
        del config["model"]["levels"]["fine"]["field"]["width"]

    checkpoint = read_checkpoint(write_checkpoint(tmp_path / "unsaid.ckpt", in_config(forget)))
    assert widths_of(checkpoint, ["levels.coarse.field"]) == {"levels.coarse.field": 32}
    refused(widths_of, checkpoint, ["levels.fine.field"], parts=("unsaid.ckpt has no model.levels.fine.field.width",))


def test_a_model_without_tables_or_without_a_grid_is_said():
    refused(packed_weights, tiny_model(), "float32", True, parts=("drop_empty=true: this model has no occupancy grid",))
    refused(packed_weights, tiny_model(), "int8", False, parts=("tables=int8: this model has no hash tables",))
