"""Folders of runs and sweeps from strangers: what they would repeat, and where their links would make us write."""

import json
import os
import sys

import pytest
import yaml
from filelock import FileLock
from omegaconf import OmegaConf
from support.configs import composed
from support.running import FAST, said

from nerf_lightning.cli.prepare import sweep_arguments
from nerf_lightning.files.folders import conf_folder
from nerf_lightning.files.made_folders import require_no_way_out
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs import saved_overrides
from nerf_lightning.runs.resume import _former_identity, newest_unfinished
from nerf_lightning.runs.run_folder import RunFolder, open_run
from nerf_lightning.runs.saved_overrides import former_overrides, former_sweep, to_give_again
from nerf_lightning.runs.summary import read_note
from nerf_lightning.runs.sweep import Sweep
from nerf_lightning.runs.sweep_record import SweepRecord, sweep_record

JOB = "${hydra.job.num}_seed=${seed}"
OWN = f"hydra.sweep.subdir='${{file_name:\"{JOB}\"}}'"
links = pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need rights there")


@pytest.fixture
def run(tmp_path):
    (tmp_path / "run" / ".hydra").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints").mkdir()
    (tmp_path / "run" / "run.json").write_text('{"fingerprint": "0"}')
    return tmp_path / "run"


def record(kind, folder):
    return folder / ".hydra" / "overrides.yaml" if kind == "run" else sweep_record(folder)


def leave(kind, folder, *lines):
    """Write what a run or a sweep was started with."""
    if kind == "sweep":
        SweepRecord(list(lines)).write(folder)
    else:
        OmegaConf.save(OmegaConf.create(list(lines)), record(kind, folder))
    return folder


def repeated(kind, folder, *given):
    return (former_overrides if kind == "run" else former_sweep)(folder, given)


def go_on_with(kind, folder):
    return ("train", f"resume={folder}") if kind == "run" else (
        "train", "-m", "sweep.resume=true", f"paths.output_dir={folder}"
    )  # fmt: skip


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
    "+optimizer.amsgrad=true",
    "path.views=[train/r_1.png,3]",
    "evaluation.lpips=alex",
    "model.levels.fine.field.skip=null",
]
# Of the README, of train --help, and their kin; in parts that may be given together.
SWEPT = [
    "seed=0,1",
    "seed=shuffle(range(3))",
    "model=choice(nerf_tiny,nerf_small)",
    "model=glob(nerf_*)",
    "encoder@direction_encoder=frequency,spherical_harmonics",
    "optimizer.lr=tag(log, interval(1e-4, 1e-2))",
    "optimizer.lr=sort(1e-3,1e-4,reverse=true)",
    "++data.batch_rays=int(interval(64,256))",
    "scene.root='my data',../captures/fox",
    "model.levels.fine.field.skip=null,[1,2]",
    "init_from=outputs/other/checkpoints/last.ckpt",
    *("hydra/launcher=slurm_here", "hydra/sweeper/sampler=random", "hydra.launcher.partition=gpu-long"),
    *("hydra.sweeper.sampler.seed=null", "+hydra.launcher.gpus_per_node=1"),
]


def shipped_settings():
    """Return each setting of our launchers and sweepers as the override that a person would type for it."""
    for file in sorted((conf_folder() / "hydra").glob("*er/*.yaml")):
        content = yaml.safe_load(file.read_text())
        del content["defaults"]
        for key, value in content.items():
            path = f"hydra.{file.parent.name}.{key}"
            leaves = (
                {f"{path}.{name}": leaf for name, leaf in value.items()} if isinstance(value, dict) else {path: value}
            )
            yield from (f"{name}={leaf}" for name, leaf in leaves.items())


@pytest.mark.parametrize(
    ("kind", "line"), [*(("run", x) for x in HARMLESS), *(("sweep", x) for x in (*SWEPT, *shipped_settings()))]
)
def test_ordinary_overrides_are_repeated(run, kind, line):
    leave(kind, run, "trainer.max_steps=4", line)
    assert repeated(kind, run, f"resume={run}") == ["trainer.max_steps=4", line]
    assert to_give_again([line], of_sweep=kind == "sweep") == []


PLANTED = [
    # Classes and programs.
    "scene._target_=os.system",
    "callbacks={evil:{deep:[{_target_:os.system}]}}",
    "+callbacks.mine._target_=os.system",
    "++trainer.lightning.profiler={_target_: os.system}",
    "+trainer._args_=[1]",
    "--config-dir=/tmp/evil",
    "encoder@callbacks.evil=frequency",
    # Files.
    "model=../../../tmp/evil",
    "+experiment=[fern,../evil]",
    # What is looked up.
    "scene.root='${oc.env:HOME}'",
    # Where to write, what to fetch, how far to trust.
    "hydra={run:{dir:x}}",
    "logger.tensorboard.name=../../elsewhere",
    "scene.cache_dir=/tmp/elsewhere",
    "scene.allow_outside=true",
    "scene={download:{url:https://x/y}}",
    "scene.path=not_there.npz",
    # What leads out of a capture.
    "path.file=/etc/shadow",
    "scene.masks=../../etc",
    "scene.masks=masks/../../etc",
    "scene.masks={a:['~/secret']}",
    "path.file='C:\\keys.yaml'",
    # Numbers that are none.
    "optimizer.lr=nan",
    "optimizer.betas=[0.9,-inf]",
    # Paths where there are words, groups that nobody has decided about, and what is no override.
    "encoder.unheard_of=/tmp/evil",
    "unheard/of=any",
    "not an override",
    "",
    "a=" + "[" * 900 + "]" * 900,
    "seed=" + "9" * 5000,
]
# Of a launcher, a plain name is one that Hydra finds among those that are installed, or does not find.
IN_RUNS = ["seed=1,2", "hydra/launcher=evil"]
IN_SWEEPS = [
    # Classes and programs.
    "hydra.launcher={_target_:os.system,command:'touch ran'}",
    "hydra.sweeper.sampler._target_=os.system",
    "encoder@hydra.callbacks.evil=hash_grid,frequency",
    "hydra.launcher.setup=['touch ran']",
    "hydra.launcher.additional_parameters={wrap:'touch ran'}",
    'hydra.launcher.name="x\\n#SBATCH --wrap=evil"',
    "hydra.sweeper.storage=sqlite:///elsewhere.db",
    # Overrides in disguise.
    "hydra.sweeper.params={scene._target_:'os.system,x'}",
    # Other configs.
    "hydra/launcher=../../evil",
    "hydra/launcher=[parallel]",
    "~hydra/launcher",
    "+hydra/launcher@hydra.callbacks.evil=parallel",
    "+hydra/env=evil",
    "hydra.searchpath=[file:///tmp/evil]",
    "-cd",
    "model=choice(nerf_tiny,'/tmp/evil')",
    # Places.
    "++hydra.sweep.subdir=../../elsewhere",
    "hydra.job.env_set.PATH=/tmp/evil",
    "hydra.launcher.n_jobs=${oc.env:HOME}",
    # What jobs would get of the values.
    "+seed=choice(1,{a:'${oc.env:HOME}'})",
    "++callbacks.evil=choice({_target_:os.system},{_target_:os.popen})",
    "scene.allow_outside=true,false",
    "optimizer.lr=1e-3,nan",
    "init_from=/elsewhere/last.ckpt",
    "scene.path=not_there.npz,neither.npz",
]


@pytest.mark.parametrize(
    ("kind", "line"), [*(("run", x) for x in (*PLANTED, *IN_RUNS)), *(("sweep", x) for x in (*PLANTED, *IN_SWEEPS))]
)
def test_a_planted_override_is_not_repeated(run, kind, line):
    leave(kind, run, "seed=0", line)
    flag = "resume=" if kind == "run" else "sweep.resume=true"
    words = rf"{record(kind, run).name} holds .* is not taken from a file.*type it again after {flag}"
    with pytest.raises(InputError, match=words):
        repeated(kind, run, f"resume={run}")


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        *(("run", x) for x in ("++paths.root_dir=/x", "resume=auto", "+init_from=/x.ckpt", "paths={root_dir:/x}")),
        *(("run", x) for x in ("viewer@callbacks=on", "viewer={live_view:{host:0.0.0.0}}")),
        *(("sweep", x) for x in ("paths.root_dir=/x", "++resume=/x", "sweep.resume=true", "++sweep.evil=1")),
        *(("sweep", x) for x in ("hydra.mode=MULTIRUN", "hydra.sweep.subdir=../../evil")),
    ],
)
def test_what_belongs_to_one_start_is_left_out(run, kind, line):
    leave(kind, run, line, "seed=1")
    assert repeated(kind, run) == ["seed=1"]
    assert kind == "sweep" or to_give_again([line]) == []


@pytest.mark.parametrize("kind", ["run", "sweep"])
def test_loggers_are_typed_again(run, kind, caplog):
    leave(kind, run, "logger=wandb", "seed=1")
    assert repeated(kind, run) == ["seed=1"]
    assert [record.getMessage().partition(": ")[2] for record in caplog.records] == [
        "to log as before, type logger=wandb again."
    ]
    assert to_give_again(["logger=wandb", "seed=1"], of_sweep=kind == "sweep") == ["logger=wandb"]
    caplog.clear()
    assert repeated(kind, run, "logger=csv") == ["seed=1"]
    assert not caplog.records


def test_a_sweep_of_a_stranger_makes_no_folder_elsewhere(nerf, tmp_path):
    planted = ("scene=llff", "scene.root=absent", "scene.name=a,b", "scene.name=../../../ESCAPED")
    leave("sweep", tmp_path / "x" / "sweep", *planted)
    said(
        nerf("train", "-m", "sweep.resume=true", f"paths.output_dir={tmp_path}/x/sweep"),
        "'scene.name=../../../ESCAPED'",
    )
    typed = ("scene=llff", "scene.root=absent", "seed=0,1", "hydra.sweep.subdir=../ESCAPED_${hydra.job.num}")
    result = nerf("train", "-m", *typed, f"paths.output_dir={tmp_path}/x/typed")
    assert "2 of 2 jobs failed. .._ESCAPED_0, .._ESCAPED_1: The folder absent does not exist" in result.err
    assert "Traceback" not in result.err


def test_what_the_user_types_again_is_the_users_and_the_printed_command_asks_for_it(run, tmp_path):
    leave("run", run, "scene.cache_dir=/x", "seed=1")
    assert repeated("run", run, f"resume={run}", "scene.cache_dir=/y") == ["seed=1"]
    leave("sweep", run, "hydra.sweep.subdir=mine", "scene.cache_dir=/x", "seed=0,1")
    again = ["hydra.sweep.subdir='ours/${seed}'", "scene.cache_dir=/y"]
    assert sweep_arguments(["-m", "sweep.resume=true", f"paths.output_dir={run}", *again]) == [
        "-m", "seed=0,1", "sweep.resume=true", f"hydra.sweep.dir={run}", again[1], OWN.replace(JOB, "ours/${seed}")
    ]  # fmt: skip
    lines = ["seed=1", "scene.cache_dir=/x y", "paths.root_dir=/z", "scene.root='${oc.env:HOME}'"]
    assert to_give_again(lines) == ["'scene.cache_dir=/x y'", """'scene.root='"'"'${oc.env:HOME}'"'"''"""]
    lines = ["hydra.sweep.dir=x", "seed=0,1", "paths.root_dir=/z", "scene.cache_dir=/x y"]
    printed = Sweep("nerf train", tmp_path, SweepRecord(lines)).go_on_with()
    assert printed == f"nerf train -m sweep.resume=true paths.output_dir={tmp_path} 'scene.cache_dir=/x y'"


FILES = {
    "numbers": b"[1, 2]\n",
    "objects": b"!!python/object/apply:os.system ['touch ran']\n",
}


@pytest.mark.parametrize("kind", ["run", "sweep"])
@pytest.mark.parametrize("content", FILES.values(), ids=FILES)
def test_a_file_that_is_no_list_of_overrides(nerf, run, kind, content):
    record(kind, run).write_bytes(content)
    said(nerf(*go_on_with(kind, run)), record(kind, run).name)


def test_a_sweep_that_is_not_named_is_not_looked_for_in_a_damaged_one(nerf, tmp_path):
    (tmp_path / "sweeps" / "one" / ".hydra").mkdir(parents=True)
    sweep_record(tmp_path / "sweeps" / "one").write_bytes(FILES["numbers"])
    said(nerf("train", "-m", "sweep.resume=true", f"paths.root_dir={tmp_path}"), "newest is paths.output_dir=DIR")


LOG = "{_target_:logging.FileHandler,filename:'MARK'}"


@pytest.mark.parametrize(
    ("kind", "planted"),
    [
        ("run", f"+callbacks.evil={LOG}"),
        ("sweep", f"hydra.launcher={LOG}"),
        ("sweep", "hydra.searchpath=['file://FOLDER/conf']"),
    ],
)
def test_nothing_planted_runs_through_the_command_line(nerf, capture, run, tmp_path, kind, planted):
    """FileHandler makes a file, and is none of the names that Hydra itself refuses (os.system is)."""
    mark = tmp_path / "ran"
    (tmp_path / "conf" / "scene").mkdir(parents=True)
    (tmp_path / "conf" / "scene" / "npz.yaml").write_text(f"_target_: logging.FileHandler\nfilename: {mark}\n")
    planted = planted.replace("MARK", str(mark)).replace("FOLDER", str(tmp_path))
    leave(kind, run, planted, "scene=npz", f"scene.path={capture}", *FAST, "seed=0,1" if kind == "sweep" else "seed=0")
    said(nerf(*go_on_with(kind, run)), "is not taken from a file")
    assert not mark.exists()
    assert sorted(path.name for path in run.iterdir()) == [".hydra", "checkpoints", "run.json"]
    assert list((run / ".hydra").iterdir()) == [record(kind, run)]


@links
@pytest.mark.parametrize("resuming", [True, False])
@pytest.mark.parametrize("name", [".hydra/jobs", ".hydra/stop", "sweep.md", "0_seed=0"])
def test_links_out_of_a_sweep_are_not_written_through(nerf, tmp_path, name, resuming):
    folder, victim = leave("sweep", tmp_path / "sweep", "seed=0,1"), tmp_path / "victim"
    victim.mkdir()
    (victim / "precious.json").write_text("{}")
    (folder / name).symlink_to(victim)
    words = ["sweep.resume=true"] if resuming else ["seed=0,1"]
    said(nerf("train", "-m", *words, f"paths.output_dir={folder}"), "is a symbolic link to", "victim")
    assert [path.name for path in victim.iterdir()] == ["precious.json"]


@links
@pytest.mark.parametrize(
    "name", ["train.log", "checkpoints", "tensorboard", ".hydra/lock", "images/progress", "metrics.json"]
)
def test_a_run_with_a_link_out_of_it_is_not_taken(tmp_path, name):
    here, victim = tmp_path / "here", tmp_path / "victim"
    open_run(composed("train", f"paths.output_dir={here}"), 100, None).release()
    victim.mkdir()
    (here / name).parent.mkdir(exist_ok=True)
    (here / name).unlink(missing_ok=True)
    (here / name).symlink_to(victim)
    for resume in ("auto", here):
        with pytest.raises(InputError, match=r"is a symbolic link to .*victim.*Remove the link"):
            open_run(composed("train", f"paths.output_dir={here}", f"resume={resume}"), 100, None)
    assert list(victim.iterdir()) == []


def test_links_within_a_run_folder_are_fine(run, tmp_path):
    (run / "checkpoints" / "last.ckpt").write_text("")
    (run / "checkpoints" / "best.ckpt").symlink_to("last.ckpt")
    (tmp_path / "link").symlink_to(run)
    require_no_way_out(tmp_path / "link")


@pytest.mark.parametrize("key", ["output_dir", "root_dir"])
def test_a_run_folder_that_no_event_file_can_lie_in_is_refused(tmp_path, key):
    """TensorBoard's writer encodes the path as UTF-8."""
    place = tmp_path / os.fsdecode(b"x\xff")
    with pytest.raises(InputError, match=r"The run folder .* has a name that is not UTF-8 or holds control"):
        open_run(OmegaConf.merge(composed("train"), {"paths": {key: str(place)}}), 100, None)
    assert not place.exists()


def test_hydras_parser_gets_nothing_that_keeps_it_busy(run, monkeypatch):
    leave("run", run, "path.views=[" + "1," * 1000 + "1]")
    assert len(repeated("run", run)) == 1
    leave("run", run, *["seed=1"] * 2000)
    with pytest.raises(InputError, match=r"overrides.yaml holds more than 8,192 characters"):
        repeated("run", run)
    monkeypatch.setattr(saved_overrides, "parse", lambda line: pytest.fail("it is parsed"))
    for line in ("seed=[" + "1," * 2000, "seed=" + "{a:" * 500, "seed=" + "f(" * 500):
        leave("run", run, line)
        with pytest.raises(InputError, match="is not taken from a file"):
            repeated("run", run)


@pytest.mark.parametrize("value", ["x", [], None, 10**400, float("nan")])
def test_numbers_of_a_note_that_are_none_do_not_end_a_run(run, value):
    """The note is anybody's; a training that goes on in its folder writes its own numbers there at the end."""
    note = {"fingerprint": "0", "seconds": value, "finished_at_step": value}
    (run / "run.json").write_text(json.dumps(note))
    assert newest_unfinished(run.parent, "0", (10, 60.0), None) == run
    RunFolder(run, FileLock(run / "lock"), None).note(finished_at_step=12)
    found = read_note(run)
    assert found["finished_at_step"] == 12
    assert 0 <= found["seconds"] < 60


def test_a_config_with_half_an_interpolation_is_called_damaged(run):
    (run / ".hydra" / "config.yaml").write_text('a: "${"')
    assert _former_identity(run) == "its config is damaged"
