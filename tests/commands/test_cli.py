import os

import pytest
from omegaconf import OmegaConf
from support.configs import yaml_files
from support.running import said

from nerf_lightning.cli.main import find_commands
from nerf_lightning.config.hydra_versions import IS_1_3


def test_help_lists_every_command_with_its_line_and_fits_a_terminal(nerf, monkeypatch):
    result = nerf("--help")
    assert result.code == 0
    for name in ("train", "eval", "render", "doctor"):
        assert f"\n  {name}" in result.out
    assert nerf().out == result.out
    monkeypatch.setenv("COLUMNS", "80")
    assert [line for line in nerf("--help").out.splitlines() if len(line) > 80] == []
    assert all(summary for summary in find_commands().values())


def test_json_is_refused_without_a_table_and_what_readers_share_is_no_scene_and_no_command(nerf):
    said(nerf("train", "--json"), "nerf train prints no table", "such as nerf doctor")
    assert "There is no command 'scene_defaults'" in nerf("scene_defaults").err
    refused = nerf("train", "scene=capture").err
    assert "There is no scene=capture." in refused
    assert "colmap" in refused.partition("Its options are")[2]
    assert "capture" not in refused.partition("Its options are")[2]


def test_no_config_sets_the_mode_that_hydra_composes_twice_to_find():
    """cli/process.py counts on it."""
    configs = [OmegaConf.load(file) for file in yaml_files()]
    assert len(configs) > 50
    assert not [config for config in configs if OmegaConf.select(config, "hydra.mode") or config.get("hydra/mode")]


of_1_3 = pytest.mark.skipif(
    not IS_1_3, reason="Hydra 1.4 looks for the mode in the command line and the main yaml only"
)


@of_1_3
def test_a_mode_in_a_file_of_the_users_counts(tmp_path, nerf):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "many.yaml").write_text("# @package _global_\nhydra:\n  mode: MULTIRUN\n")
    many = ("seed=0,1", "trainer.max_steps=-1", f"paths.root_dir={tmp_path / 'out'}")
    assert "Launching 2 jobs" in nerf("train", f"--config-dir={tmp_path}", "experiment=many", *many).err


def test_mistyped_options_and_commands_have_near_matches(nerf):
    said(nerf("train", "--hlep"), "Did you mean --help?")
    said(nerf("trian"), "Did you mean train?")


@pytest.mark.parametrize(
    ("override", "hint"),
    [
        ("trainer.max_stps=3", "trainer.max_steps"),
        ("optimiser.lr=1", "optimizer.lr"),
        ("lr=0.1", "optimizer.lr=0.1"),
        ("model=nerf_smal", "nerf_small"),
        ("modle=fast", "model=fast"),
        ("encoder@direction_encodr=frequency", "encoder@direction_encoder=frequency"),
        ("~callbacks.monitr", "callbacks.monitor"),
        ("hydra/launcher=paralel", "hydra/launcher=parallel"),
    ],
)
def test_an_unknown_override_is_named_with_near_matches(nerf, override, hint):
    result = nerf("train", override)
    said(result, override.partition("=")[0].rpartition(".")[2])
    assert f"Did you mean {hint}" in result.err or f"={hint}" in result.err
    assert "search path" not in result.err


@pytest.mark.parametrize("command", ["render", "eval"])
def test_without_a_run_the_newest_is_named_to_be_pasted(nerf, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    said(nerf(command), f"nerf {command} needs a run, and outputs/ holds none")
    said(nerf(command, "paths.root_dir=elsewhere"), f"nerf {command} needs a run, and elsewhere/ holds none")
    for age, run in enumerate(["outputs/sweeps/new/0_seed=0", "outputs/bricks/old"]):
        (tmp_path / run / "checkpoints").mkdir(parents=True)
        (tmp_path / run / "checkpoints" / "last.ckpt").touch()
        os.utime(tmp_path / run / "checkpoints" / "last.ckpt", (1e9 - age, 1e9 - age))
    monkeypatch.chdir(tmp_path)
    said(nerf(command), f"type: nerf {command} ckpt=outputs/sweeps/new/0_seed=0")


def test_settings_that_are_not_there_missing_or_of_the_wrong_kind_are_told(nerf):
    said(nerf("train", "optimizer.fused=true"), "optimizer.fused is a setting of optimizer=adam, which is not chosen.")
    assert "It belongs to training: nerf help optimizer.lr." in nerf("render", "optimizer.lr=1").err
    said(nerf("doctor", "experiment=quickstart"), "nerf doctor has no setting experiment. It belongs to training")
    said(nerf("train", "+experiment=quickstart"), "leave out the +. Type experiment=quickstart.")
    said(nerf("train", "trainer.accumulate_grad_batches=2"), "accumulate_grad_batches is data.batch_rays")
    said(nerf("train", "trainer.gradient_clip_val=1"), "gradient_clip_val is trainer.clip_norm here")
    said(nerf("train", "scene.downscale=2"), "scene=bricks is rendered, in the size scene.resolution=N")
    assert "+zzzz=VALUE adds one of your own" in nerf("render", "zzzz=1").err
    said(nerf("train", "scene=blender"), "nerf train needs scene.root: add scene.root=VALUE.")
    said(nerf("train", "model=nerf", "field.skip=20"), "skip=20 names no layer")
