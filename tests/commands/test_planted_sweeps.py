"""Sweep folders from strangers: what they would repeat, and where their links would make a resumed sweep write."""

import sys

import pytest
import yaml
from support.running import FAST, said
from test_planted_runs import FILES, HARMLESS, PLANTED

from nerf_lightning.cli.sweep_arguments import sweep_arguments
from nerf_lightning.files.folders import conf_folder
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.saved_overrides import former_sweep, to_give_again
from nerf_lightning.runs.sweep_record import JOB_NUMBER, SweepRecord, sweep_record

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
]
LAUNCHED = ["hydra/launcher=slurm_here", "hydra/sweeper/sampler=random", "hydra.launcher.partition=gpu-long",
            "hydra.sweeper.sampler.seed=null", "+hydra.launcher.gpus_per_node=1"]  # fmt: skip


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


def leave_sweep(folder, *arguments):
    SweepRecord(list(arguments)).write(folder)
    return folder


@pytest.mark.parametrize("argument", [*SWEPT, *LAUNCHED, *shipped_settings(), *HARMLESS])
def test_what_a_sweep_is_started_with_is_repeated(tmp_path, argument):
    leave_sweep(tmp_path, "trainer.max_steps=4", argument)
    assert former_sweep(tmp_path, []) == ["trainer.max_steps=4", argument]
    assert to_give_again([argument], of_sweep=True) == []


# Of a launcher, a plain name is one that Hydra finds among those that are installed, or does not find.
FINE_IN_SWEEPS = ("seed=1,2", "hydra/launcher=evil")
PLANTED_IN_SWEEPS = [
    *(line for line in PLANTED if line not in FINE_IN_SWEEPS),
    # Classes and programs.
    "hydra.launcher={_target_:os.system,command:'touch ran'}",
    "hydra.sweeper.sampler._target_=os.system",
    "encoder@hydra.callbacks.evil=hash_grid,frequency",
    "hydra.launcher.setup=['touch ran']",
    "hydra.launcher.additional_parameters={wrap:'touch ran'}",
    'hydra.launcher.name="x\\n#SBATCH --wrap=evil"',
    "hydra.launcher.partition='gpu --wrap=evil'",
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
    "--experimental-rerun=/tmp/evil.pickle",
    "-cd",
    "model=choice(nerf_tiny,'/tmp/evil')",
    # Places.
    "hydra.sweep.subdir=../../elsewhere",
    "hydra.job.env_set.PATH=/tmp/evil",
    "hydra.launcher.n_jobs=${oc.env:HOME}",
    # What jobs would get of the values.
    "+seed=choice(1,{a:'${oc.env:HOME}'})",
    "+scene._target_=choice(os.system)",
    "++callbacks.evil=choice({_target_:os.system},{_target_:os.popen})",
    "scene.allow_outside=true,false",
    "scene.path=not_there.npz,neither.npz",
]


@pytest.mark.parametrize("argument", PLANTED_IN_SWEEPS)
def test_a_planted_argument_is_not_repeated(tmp_path, argument):
    leave_sweep(tmp_path, "seed=0,1", argument)
    with pytest.raises(InputError, match=r"sweep.yaml holds .* is not repeated from a file.* after sweep.resume=true"):
        sweep_arguments(["-m", "sweep.resume=true", f"paths.output_dir={tmp_path}"])


@pytest.mark.parametrize(
    "argument",
    [
        *("paths.root_dir=/x", "++resume=/x", "resume=auto", "sweep.resume=true", "++sweep.evil=1"),
        *("hydra.mode=MULTIRUN", "hydra.sweep.dir=/x", f"hydra.sweep.subdir='{JOB_NUMBER}/../../evil'"),
    ],
)
def test_what_belongs_to_one_start_is_left_out(tmp_path, argument):
    leave_sweep(tmp_path, argument, "seed=0,1")
    assert former_sweep(tmp_path, []) == ["seed=0,1"]


def test_values_that_are_paths_name_no_folders(tmp_path):
    """A job in DIR/0_scene.root=../../../elsewhere would write there."""
    leave_sweep(tmp_path, "scene.root=../../../elsewhere,b", "seed=0,1")
    asked = sweep_arguments(["-m", "sweep.resume=true", f"paths.output_dir={tmp_path}"])
    assert asked[-1] == f"hydra.sweep.subdir='{JOB_NUMBER}_seed=${{seed}}'"


def test_what_the_user_types_again_is_the_users(tmp_path):
    leave_sweep(tmp_path, "hydra.sweep.subdir=mine", "scene.cache_dir=/x", "seed=0,1")
    again = ["hydra.sweep.subdir=ours", "scene.cache_dir=/y"]
    assert sweep_arguments(["-m", "sweep.resume=true", f"paths.output_dir={tmp_path}", *again]) == [
        "-m", "seed=0,1", "sweep.resume=true", f"hydra.sweep.dir={tmp_path}", *again
    ]  # fmt: skip


def test_the_printed_command_repeats_what_the_folder_does_not(tmp_path):
    from nerf_lightning.runs.sweep import Sweep

    lines = [
        "hydra.sweep.dir=x",
        "seed=0,1",
        "paths.root_dir=/z",
        "scene.cache_dir=/x y",
        "hydra.sweeper.storage=a://b",
    ]
    printed = Sweep("nerf train", tmp_path, SweepRecord(lines)).go_on_with()
    again = "'scene.cache_dir=/x y' hydra.sweeper.storage=a://b"
    assert printed == f"nerf train -m sweep.resume=true paths.output_dir={tmp_path} {again}"


@pytest.mark.parametrize("content", FILES.values(), ids=FILES)
def test_a_file_that_is_no_record_of_a_sweep(nerf, tmp_path, content):
    record = sweep_record(tmp_path / "sweeps" / "one")
    record.parent.mkdir(parents=True)
    record.write_bytes(content if isinstance(content, bytes) else content.encode())
    said(nerf("train", "-m", "sweep.resume=true", f"paths.output_dir={record.parent.parent}"), "sweep.yaml")
    named = nerf("train", "-m", "sweep.resume=true", f"paths.root_dir={tmp_path}")
    said(named, "newest is paths.output_dir=DIR")


@pytest.mark.parametrize(
    "planted",
    [
        "hydra.launcher={_target_:logging.FileHandler,filename:'MARK'}",
        "+hydra.callbacks.evil={_target_:logging.FileHandler,filename:'MARK'}",
        "+callbacks.evil={_target_:logging.FileHandler,filename:'MARK'},null",
        "hydra.searchpath=['file://FOLDER/conf']",
        "--config-dir=FOLDER/conf",
        "hydra/launcher=../../../../../../../../../../FOLDER/conf/evil",
    ],
)
def test_nothing_planted_runs_through_the_command_line(nerf, capture, tmp_path, planted):
    """FileHandler makes a file, and is none of the names that Hydra itself refuses (os.system is)."""
    mark, folder = tmp_path / "ran", tmp_path / "sweep"
    (tmp_path / "conf" / "scene").mkdir(parents=True)
    evil = f"_target_: logging.FileHandler\nfilename: {mark}\n"
    for name in ("evil.yaml", "scene/npz.yaml"):
        (tmp_path / "conf" / name).write_text(evil)
    planted = planted.replace("MARK", str(mark)).replace("FOLDER", str(tmp_path))
    leave_sweep(folder, planted, "scene=npz", f"scene.path={capture}", *FAST, "seed=0,1")
    said(nerf("train", "-m", "sweep.resume=true", f"paths.output_dir={folder}"), "is not repeated from a file")
    assert not mark.exists()
    assert [path.name for path in folder.iterdir()] == [".hydra"]
    assert [path.name for path in (folder / ".hydra").iterdir()] == ["sweep.yaml"]


@pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need rights there")
@pytest.mark.parametrize("resuming", [True, False])
@pytest.mark.parametrize("name", [".hydra/jobs", ".hydra/stop", "sweep.md", "0_seed=0"])
def test_links_out_of_a_sweep_are_not_written_through(nerf, tmp_path, name, resuming):
    folder, victim = leave_sweep(tmp_path / "sweep", "seed=0,1"), tmp_path / "victim"
    victim.mkdir()
    (victim / "precious.json").write_text("{}")
    (folder / name).symlink_to(victim)
    words = ["sweep.resume=true"] if resuming else ["seed=0,1"]
    said(nerf("train", "-m", *words, f"paths.output_dir={folder}"), "is a symbolic link to", "victim")
    assert [path.name for path in victim.iterdir()] == ["precious.json"]
