"""Run folders from strangers: what they would repeat, and where their links would make a resumed run write."""

import json
import sys

import pytest
from filelock import FileLock
from omegaconf import OmegaConf
from support.running import FAST, said

from nerf_lightning.files.links import require_no_way_out
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.folder import RunFolder, _former_identity, _newest_unfinished, open_run
from nerf_lightning.runs.saved_overrides import former_overrides, to_give_again
from nerf_lightning.runs.summary import read_note


@pytest.fixture
def run(tmp_path):
    (tmp_path / "run" / ".hydra").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints").mkdir()
    (tmp_path / "run" / "run.json").write_text('{"fingerprint": "0"}')
    return tmp_path / "run"


def write_overrides(run, *lines):
    OmegaConf.save(OmegaConf.create(list(lines)), run / ".hydra" / "overrides.yaml")


HARMLESS = [
    "model=fast",
    "+experiment=lego_article",
    "sampler@model.levels.fine.sampler=occupancy",
    "scene.root='my data/it\\'s'",
    "scene.skip={train:1,val:1,test:8}",
    "+scene.of_a_new_reader=images_4",
    "optimizer.lr=2e-3",
    "callbacks=[default]",
    "~callbacks.monitor",
    "~logger",
    "+optimizer.amsgrad=true",
    "path.views=[train/r_1.png,3]",
    "evaluation.lpips_weights='my weights/alex.pt'",
    "trainer.max_steps=100",
    "++data.batch_rays=64",
    "model.levels.fine.field.skip=null",
]


def test_ordinary_overrides_are_repeated(run):
    write_overrides(run, *HARMLESS)
    assert former_overrides(run, [f"resume={run}"]) == HARMLESS
    assert to_give_again(HARMLESS) == []


PLANTED = [
    # Classes and programs.
    "scene._target_=os.system",
    "++callbacks.evil={_target_:os.system,command:'touch ran'}",
    "callbacks={evil:{deep:[{_target_:os.system}]}}",
    "+trainer._args_=[1]",
    "hydra/launcher=evil",
    "--config-dir=/tmp/evil",
    "encoder@callbacks.evil=frequency",
    "encoder@model._target_=frequency",
    # Files.
    "model=../../../tmp/evil",
    "+experiment=[fern,../evil]",
    # What is looked up.
    "scene.root='${oc.env:HOME}'",
    "seed=1,2",
    # Where to write, what to fetch, how far to trust.
    "hydra={run:{dir:x}}",
    "logger.tensorboard.name=../../elsewhere",
    "scene.cache_dir=/tmp/elsewhere",
    "scene.allow_outside=true",
    "scene={download:{url:https://x/y}}",
    "encoder@scene.download=frequency",
    "scene.path=not_there.npz",
    # Paths where there are words, groups that nobody has decided about, and what is no override.
    "encoder.unheard_of=/tmp/evil",
    "+unheard_of=1",
    "unheard/of=any",
    "not an override",
    "",
    "scene.path=" + "x" * 5000,
    "a=" + "[" * 900 + "]" * 900,
    "seed=" + "9" * 5000,
]


@pytest.mark.parametrize("line", PLANTED)
def test_a_planted_override_is_not_repeated(run, line):
    write_overrides(run, "seed=0", line)
    with pytest.raises(InputError, match=r"overrides.yaml holds .* which is not repeated from a file.*type it again"):
        former_overrides(run, [f"resume={run}"])


@pytest.mark.parametrize(
    "line",
    ["++paths.root_dir=/x", "resume=auto", "+init_from=/x.ckpt", "paths={root_dir:/x}", "viewer@callbacks=on",
     "viewer.live_view.host=0.0.0.0", "viewer={live_view:{host:0.0.0.0}}"],
)  # fmt: skip
def test_what_belongs_to_one_start_is_left_out(run, line):
    write_overrides(run, line, "seed=1")
    assert former_overrides(run, []) == ["seed=1"]
    assert to_give_again([line]) == []


def test_what_the_user_types_again_is_the_users(run):
    write_overrides(run, "scene.cache_dir=/x", "seed=1")
    assert former_overrides(run, [f"resume={run}", "scene.cache_dir=/y"]) == ["seed=1"]


def test_the_printed_command_repeats_what_the_folder_does_not(run):
    lines = ["seed=1", "scene.cache_dir=/x y", "paths.root_dir=/z", "scene.root='${oc.env:HOME}'"]
    assert to_give_again(lines) == ["'scene.cache_dir=/x y'", """'scene.root='"'"'${oc.env:HOME}'"'"''"""]


FILES = {
    "aliases": "a: &a [x, x]\nb: [*a, *a]\n",
    "numbers": "[1, 2]\n",
    "objects": "!!python/object/apply:os.system ['touch ran']\n",
    "long": "- x\n" * 2_000_000,
    "binary": b"\xff\xfe\x00",
}


@pytest.mark.parametrize("content", FILES.values(), ids=FILES)
def test_a_file_that_is_no_list_of_overrides(nerf, run, content):
    (run / ".hydra" / "overrides.yaml").write_bytes(content if isinstance(content, bytes) else content.encode())
    said(nerf("train", f"resume={run}"), "overrides.yaml")


@pytest.mark.parametrize("line", ["+callbacks.evil={_target_:os.system,command:'touch MARK'}", "model=../../evil"])
def test_nothing_planted_runs_through_the_command_line(nerf, capture, run, tmp_path, line):
    mark = tmp_path / "ran"
    write_overrides(run, "scene=npz", f"scene.path={capture}", *FAST, line.replace("MARK", str(mark)))
    said(nerf("train", f"resume={run}"), "is not repeated from a file")
    assert not mark.exists()
    assert sorted(path.name for path in run.iterdir()) == [".hydra", "checkpoints", "run.json"]


def test_a_garbled_note_is_damaged(nerf, capture, run):
    (run / "run.json").write_text('{"fingerprint": ' + "[" * 10_000)
    write_overrides(run, "scene=npz", f"scene.path={capture}", *FAST)
    said(nerf("train", f"resume={run}"), f"{run / 'run.json'} is damaged", "Remove it")


@pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need rights there")
@pytest.mark.parametrize(
    "name", ["train.log", "checkpoints", "tensorboard", ".hydra/lock", "images/progress", "metrics.json"]
)
def test_links_out_of_a_run_folder_are_not_written_through(run, tmp_path, name):
    victim = tmp_path / "victim"
    if name in ("checkpoints", "tensorboard", "images/progress"):
        victim.mkdir()
    else:
        victim.write_text("precious")
    if name == "checkpoints":
        (run / name).rmdir()
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).symlink_to(victim)
    with pytest.raises(InputError, match=r"is a symbolic link to .*victim.*Remove the link"):
        require_no_way_out(run)


def test_links_within_a_run_folder_are_fine(run, tmp_path):
    (run / "checkpoints" / "last.ckpt").write_text("")
    (run / "checkpoints" / "best.ckpt").symlink_to("last.ckpt")
    (tmp_path / "link").symlink_to(run)
    require_no_way_out(tmp_path / "link")


def test_a_run_with_a_link_out_of_it_is_not_taken(tmp_path):
    from support.configs import composed

    config = composed("train", f"paths.root_dir={tmp_path}", f"paths.output_dir={tmp_path}/here")
    open_run(config, 100, None).release()
    (tmp_path / "victim").write_text("precious")
    (tmp_path / "here" / "train.log").symlink_to(tmp_path / "victim")
    for resume in ("auto", f"{tmp_path}/here"):
        with pytest.raises(InputError, match="symbolic link"):
            open_run(composed("train", f"paths.output_dir={tmp_path}/here", f"resume={resume}"), 100, None)
    assert (tmp_path / "victim").read_text() == "precious"


def test_more_overrides_than_agreed_are_not_read(run):
    write_overrides(run, "path.views=[" + "1," * 1000 + "1]")
    assert len(former_overrides(run, [])) == 1
    write_overrides(run, "path.views=[" + "1," * 40_000 + "1]")
    with pytest.raises(InputError, match=r"overrides.yaml holds more than 65,536 characters"):
        former_overrides(run, [])


@pytest.mark.parametrize("value", ["x", [], None, 10**400, float("nan")])
def test_numbers_of_a_note_that_are_none_do_not_end_a_run(run, value):
    """The note is anybody's; a training that goes on in its folder writes its own numbers there at the end."""
    note = {"fingerprint": "0", "seconds": value, "finished_at_step": value}
    (run / "run.json").write_text(json.dumps(note))
    assert _newest_unfinished(run.parent, "0", 10, None) == run
    RunFolder(run, FileLock(run / "lock"), None).note(finished_at_step=12)
    found = read_note(run)
    assert found["finished_at_step"] == 12
    assert 0 <= found["seconds"] < 60


def test_a_config_with_half_an_interpolation_is_called_damaged(run):
    (run / ".hydra" / "config.yaml").write_text('a: "${"')
    assert _former_identity(run) == "its config is damaged"
