"""Which folder a run takes, and which it leaves alone."""

import errno
import json

import pytest
import torch
from omegaconf import OmegaConf, open_dict
from support.configs import composed
from support.running import refused
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import make_record
from nerf_lightning.evaluation.protocol import config_hash
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.identity import settings_digest
from nerf_lightning.runs.run_folder import ResumePoint, open_run, write_config

HYDRA = {"job": {}, "runtime": {}, "overrides": {"task": ["seed=0"]}}


def config(tmp_path, *overrides):
    return composed("train", f"paths.root_dir={tmp_path}", *overrides)


def begin(cfg, steps=100, job_folder=None):
    run = open_run(cfg, steps, job_folder)
    write_config(run.path, cfg, OmegaConf.create(HYDRA))
    return run


def left(cfg, **note):
    """A run that its process has left, with a note."""
    run = begin(cfg)
    run.note(**note)
    run.release()
    return run


def test_auto_finds_the_newest_unfinished_run_of_the_same_config_and_else_the_folder_is_fresh(tmp_path):
    done, other = left(config(tmp_path), finished_at_step=100), left(config(tmp_path, "seed=1"))
    open_one = left(config(tmp_path))
    assert left(config(tmp_path, "resume=auto"), finished_at_step=100).path == open_one.path
    fresh = left(config(tmp_path, "resume=auto"))
    assert fresh.path.parent == tmp_path / "bricks"
    assert len({each.path for each in (fresh, done, open_one, other)}) == 4


def test_a_longer_run_takes_a_finished_one_for_unfinished(tmp_path):
    run = left(config(tmp_path, "trainer.max_steps=100"), finished_at_step=100)
    assert begin(config(tmp_path, "trainer.max_steps=200", "resume=auto"), steps=200).path == run.path


def test_a_run_whose_budget_is_used_up_is_gone_on_with_for_a_larger_one_only(tmp_path):
    run = left(config(tmp_path, "budget.seconds=60"), finished_at_step=50, budget_seconds=60)
    assert begin(config(tmp_path, "budget.seconds=300", "resume=auto")).path == run.path
    run.note(finished_at_step=50, budget_seconds=60)
    assert begin(config(tmp_path, "budget.seconds=60", "resume=auto")).path != run.path


def test_a_folder_of_another_config_is_refused_and_the_difference_named(tmp_path):
    begin(config(tmp_path, f"paths.output_dir={tmp_path}/here")).release()
    before = json.loads((tmp_path / "here/run.json").read_text())
    with pytest.raises(InputError, match=r"contains a run with other settings \(seed: there 0, here 3\)"):
        open_run(config(tmp_path, f"paths.output_dir={tmp_path}/here", "seed=3", "resume=auto"), 100, None)
    with pytest.raises(InputError, match=r"already contains a run with these settings. Add resume=auto"):
        open_run(config(tmp_path, f"paths.output_dir={tmp_path}/here"), 100, None)
    assert json.loads((tmp_path / "here/run.json").read_text()) == before


def without(config, *names):
    """The config of a program that does not know these settings yet."""
    with open_dict(config):
        for name in names:
            section, _, key = name.rpartition(".")
            del OmegaConf.select(config, section)[key]
    return config


def test_a_run_that_is_older_than_a_setting_goes_on_with_its_default(tmp_path, caplog):
    here = f"paths.output_dir={tmp_path}/here"
    begin(without(config(tmp_path, here), "model.subpixels", "trainer.clip_norm")).release()
    resumed = config(tmp_path, f"resume={tmp_path}/here")
    with pytest.raises(InputError, match=r"other settings \(model.subpixels: there unknown, here 1,"):
        open_run(resumed, 100, None, typed=[f"resume={tmp_path}/here", "model.subpixels=1"])
    with pytest.raises(InputError, match=r"other settings \(seed: there 0, here 3,"):
        open_run(config(tmp_path, f"resume={tmp_path}/here", "seed=3"), 100, None)
    open_run(resumed, 100, None, typed=[f"resume={tmp_path}/here"]).release()
    assert "continues with model.subpixels=1, trainer.clip_norm=None." in caplog.text
    assert begin(config(tmp_path, here, "resume=auto")).path == tmp_path / "here"


def test_a_setting_that_a_run_had_and_the_program_lost_is_another_config(tmp_path):
    here = f"paths.output_dir={tmp_path}/here"
    begin(config(tmp_path, here)).release()
    with pytest.raises(InputError, match=r"other settings \(model.subpixels: there 1, here unknown\)"):
        open_run(without(config(tmp_path, f"resume={tmp_path}/here"), "model.subpixels"), 100, None)
    with pytest.raises(InputError, match=r"other settings \(trainer.clip_norm: there None, here unknown\)"):
        open_run(without(config(tmp_path, f"resume={tmp_path}/here"), "trainer.clip_norm"), 100, None)


@pytest.mark.parametrize(
    "more", [["viewer=on", "viewer.live_view.port=9000"], ["logger=none"]], ids=lambda more: more[0]
)
def test_a_run_that_is_watched_is_the_same_run(tmp_path, more):
    alone, watched = config(tmp_path), config(tmp_path, *more)
    run = begin(alone)
    run.release()
    again = begin(config(tmp_path, more[0], "resume=auto"))
    assert again.path == run.path
    again.release()
    assert settings_digest(watched) == settings_digest(alone)
    hashes = {config_hash(OmegaConf.to_container(each, resolve=True)) for each in (alone, watched)}
    assert len(hashes) == 1


def test_resume_of_a_folder_without_a_run_is_refused_and_one_in_use(tmp_path):
    with pytest.raises(InputError, match="there is no run in"):
        open_run(config(tmp_path, f"resume={tmp_path}/nothing"), 100, None)
    assert not (tmp_path / "nothing").exists()
    run = begin(config(tmp_path, f"paths.output_dir={tmp_path}/here"))
    with pytest.raises(InputError, match="in use by another process"):
        open_run(config(tmp_path, f"paths.output_dir={tmp_path}/here", "resume=auto"), 100, None)
    run.release()


def save(path, step):
    path.parent.mkdir(exist_ok=True)
    record = make_record(ball_scene(), config="", choices={}) | {"precision": "bf16-mixed", "tile_points": 100 + step}
    torch.save({"state_dict": {}, "global_step": step, "nerf_lightning": record}, path)


def resume_point(tmp_path, resume="auto"):
    run = open_run(config(tmp_path, f"paths.output_dir={tmp_path}/here", f"resume={resume}"), 100, None)
    run.release()
    return run.resume_point()


def test_a_run_goes_on_as_its_newest_whole_checkpoint_says(tmp_path):
    assert resume_point(tmp_path) is None
    folder = tmp_path / "here/checkpoints"
    for name, step in (("last", 8), ("previous", 7), ("best", 5)):
        save(folder / f"{name}.ckpt", step)
    assert resume_point(tmp_path) == ResumePoint(folder / "last.ckpt", 8, "bf16-mixed", 108, num_steps=8)
    assert resume_point(tmp_path, folder / "best.ckpt") == ResumePoint(folder / "best.ckpt", 5, "bf16-mixed", 105, 5)
    assert resume_point(tmp_path, folder / "previous.ckpt").checkpoint == folder / "previous.ckpt"
    (folder / "last.ckpt").write_bytes(b"damaged")
    assert resume_point(tmp_path) == ResumePoint(folder / "last.ckpt", 7, "bf16-mixed", 107, 7)
    assert {path.name for path in folder.iterdir()} == {"last.ckpt", "damaged.ckpt", "best.ckpt"}


@pytest.mark.parametrize(("content", "what"), [("", "empty"), ("{", "damaged"), ("[]", "damaged"), ("{}", "damaged")])
def test_a_note_that_says_nothing_is_named_with_its_cure(tmp_path, content, what):
    """A disk that was full, or a machine that lost its power, leaves such a one."""
    here = f"paths.output_dir={tmp_path}/here"
    run = begin(config(tmp_path, here))
    run.release()
    save(run.path / "checkpoints" / "last.ckpt", step=3)
    note = run.path / "run.json"
    note.write_text(content)
    for resuming in ((here,), (here, "resume=auto"), (f"resume={run.path}",)):
        refused(open_run, config(tmp_path, *resuming), 100, None, parts=(f"{note} is {what}", "Remove it", here))
    note.unlink()
    again = begin(config(tmp_path, here))
    assert again.resume_point().step == 3
    again.release()


def test_a_full_disk_is_said_of_the_run_where_a_logger_does_not_name_its_file(train, tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("nerf_lightning.commands.train_job.fit.describe_run", full)
    result = train()
    assert result.code == 2
    assert f"nerf: {tmp_path}/run: No space left on device. Check that the folder" in result.err.splitlines()[-1]
