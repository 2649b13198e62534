"""What a sweep is asked for, before Hydra reads it."""

import os

import pytest
from support.configs import composed
from support.running import start_code

from nerf_lightning.cli.prepare import sweep_arguments
from nerf_lightning.config import hydra_versions
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.sweep_record import SweepRecord


def leave_sweep(folder, *arguments, slurm_job=None):
    SweepRecord(list(arguments), slurm_job).write(folder)


def test_the_flag_comes_first_wherever_it_was_typed_and_a_single_run_stays_as_it_is():
    assert sweep_arguments(["seed=0,1", "--multirun"])[:2] == ["-m", "seed=0,1"]
    assert sweep_arguments(["seed=0", "paths.output_dir=out"]) == ["seed=0", "paths.output_dir=out"]


def test_what_cannot_be_started_is_refused_before_a_folder_is_made(monkeypatch):
    asked = ["-m", "seed=0,1", "~callbacks.monitor"]
    monkeypatch.setattr(hydra_versions, "SWEEPS_REMOVE", True)
    assert "~callbacks.monitor" in sweep_arguments(asked)
    monkeypatch.setattr(hydra_versions, "SWEEPS_REMOVE", False)
    with pytest.raises(InputError, match=r"~callbacks.monitor.*'hydra-core<1.4'"):
        sweep_arguments(asked)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match=r"Slurm's srun, which is not found here.*hydra/launcher=parallel"):
        sweep_arguments(["-m", "hydra/launcher=slurm", "seed=0,1"])


def test_going_on_repeats_what_the_sweep_was_started_with(tmp_path):
    subdir = "hydra.sweep.subdir='${file_name:\"${hydra.job.num}_seed=${seed}\"}'"
    made = ("hydra.mode=MULTIRUN", "hydra.sweep.dir=x", subdir, "sweep.resume=true")
    leave_sweep(tmp_path / "my sweep", *made, "hydra/launcher=parallel", "seed=0,1", "model=nerf_tiny")
    asked = ["-m", "sweep.resume=true", f"paths.output_dir='{tmp_path}/my sweep'", "model=nerf"]
    assert sweep_arguments(asked) == [
        "-m", "hydra/launcher=parallel", "seed=0,1", "sweep.resume=true", f"hydra.sweep.dir='{tmp_path}/my sweep'",
        "model=nerf", subdir,
    ]  # fmt: skip


def test_going_on_with_nothing_is_refused_and_without_saying_with_what_names_the_newest(tmp_path):
    leave_sweep(tmp_path / "sweeps" / "old", "seed=0,1")
    with pytest.raises(InputError, match=rf"newest is paths\.output_dir={tmp_path}/sweeps/old"):
        sweep_arguments(["-m", "sweep.resume=true", f"paths.root_dir={tmp_path}"])
    with pytest.raises(InputError, match=r"holds no sweep \(no .hydra/sweep.yaml\)"):
        sweep_arguments(["-m", "sweep.resume=true", f"paths.output_dir={tmp_path}"])
    assert "seed=0,1" in sweep_arguments(["-m", "sweep.resume=true", f"paths.output_dir={tmp_path}", "seed=0,1"])
    with pytest.raises(InputError, match="add -m"):
        sweep_arguments(["sweep.resume=true"])


def test_a_requeued_slurm_job_finds_its_own_sweep(tmp_path, monkeypatch):
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    asked = [f"paths.root_dir={tmp_path}", "seed=0,1", "trainer.lightning.limit_val_batches=2"]
    leave_sweep(tmp_path / "sweeps" / "mine", *asked[:2], f"++{asked[2]}", slurm_job="7")
    leave_sweep(tmp_path / "sweeps" / "other_job", *asked, slurm_job="8")
    leave_sweep(tmp_path / "sweeps" / "other_sweep", asked[0], "seed=2,3", slurm_job="7")
    assert f"hydra.sweep.dir='{tmp_path}/sweeps/mine'" in sweep_arguments(["-m", *asked])
    monkeypatch.setenv("SLURM_RESTART_COUNT", "0")
    assert not any("hydra.sweep.dir" in argument for argument in sweep_arguments(["-m", *asked]))


@pytest.mark.parametrize(
    ("group", "plugin", "extra"),
    [
        ("launcher=parallel", "joblib", "sweep"),
        ("launcher=slurm", "submitit", "slurm"),
        ("sweeper=search", "optuna", "sweep"),
    ],
)
def test_a_plugin_that_is_not_installed_is_named_with_its_extra(tmp_path, group, plugin, extra):
    arguments = ["nerf", "train", "-m", f"hydra/{group}", "seed=0,1", f"paths.output_dir={tmp_path}/out"]
    code = f"import sys; sys.modules['hydra_plugins'] = None; sys.argv = {arguments}; import nerf_lightning.__main__"
    (tmp_path / "srun").touch(mode=0o700)
    process = start_code(code, env={"PATH": f"{tmp_path}:{os.environ['PATH']}"})
    _, told = process.communicate(timeout=300)
    assert process.returncode == 2, told
    kind = group.partition("=")[0]
    expected = f"nerf: This {kind} needs {plugin}, which is not installed: pip install '.[{extra}]'.\n"
    assert told.endswith(expected), told  # Hydra 1.4 first names each plugin that was hidden
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["parallel", "slurm", "slurm_here"])
def test_our_launchers_are_the_plugins_with_other_defaults(option):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    assert composed("train", f"hydra/launcher={option}") is not None


def test_a_typo_is_not_taken_for_a_missing_plugin(nerf):
    result = nerf("train", "-m", "hydra/launcher=joblibb", "seed=0,1")
    assert result.code == 2
    assert "not installed" not in result.err
