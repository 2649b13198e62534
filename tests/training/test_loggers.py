"""Loggers beside TensorBoard: what each keeps of a run, and what is said where its package is missing."""

import csv
import importlib.util
import sys
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch
from hydra.errors import HydraException
from lightning.pytorch.loggers import CSVLogger, WandbLogger
from support.captures import write_npz
from support.configs import composed, options
from support.running import FAST, refused, start_code

import nerf_lightning as nl
from nerf_lightning.config.instantiate import build
from nerf_lightning.training import loggers
from nerf_lightning.training.loggers import WeightsAndBiases, opened_loggers, show_picture

PICTURE = torch.zeros(4, 5, 3, dtype=torch.uint8)


@pytest.fixture
def trained(tmp_path):
    capture = write_npz(tmp_path / "capture.npz")

    def train(*overrides):
        place = ("scene=npz", f"scene.path={capture}", f"paths.output_dir={tmp_path / 'run'}", "trainer=cpu")
        return nl.train(*place, *FAST, "final.video=false", "evaluation.num_pictures=0", *overrides)

    return train


def rows(folder):
    return list(csv.DictReader((folder / "metrics.csv").read_text().splitlines()))


def test_curves_are_kept_as_tables_of_each_start(trained):
    run = trained("logger=csv", "callbacks.monitor.every_steps=2", "resume=auto")
    first = rows(run.folder / "csv" / "version_0")
    assert [row["step"] for row in first if row["train/loss"]] == ["2", "4"]
    assert [float(row["test/psnr"]) for row in first if row["test/psnr"]] == [pytest.approx(run.psnr)]
    assert (run.folder / "tensorboard").is_dir()
    assert "model: nerf_tiny" in (run.folder / "csv" / "version_0" / "hparams.yaml").read_text()
    trained("logger=csv", "callbacks.monitor.every_steps=2", "resume=auto", "trainer.max_steps=6")
    assert rows(run.folder / "csv" / "version_0") == first
    assert [row["step"] for row in rows(run.folder / "csv" / "version_1") if row["train/loss"]] == ["6"]


@pytest.mark.parametrize("option", options("logger"))
def test_every_logger_builds_or_names_its_extra(option):
    with pytest.raises(HydraException) if missing(option) else nullcontext() as refusal:
        assert build(composed("train", f"logger={option}").logger) is not None
    assert refusal is None or "pip install '.[" in str(refusal.value.__cause__)


def missing(option):
    needed = {"wandb": ("wandb",), "mlflow": ("mlflow",), "many": ("wandb", "mlflow")}.get(option, ())
    return [each for each in needed if importlib.util.find_spec(each) is None]


@pytest.mark.parametrize(("logger", "package"), [("wandb", "wandb"), ("mlflow", "mlflow"), ("many", "wandb")])
def test_a_missing_package_is_named_before_a_folder_is_taken(trained, tmp_path, monkeypatch, logger, package):
    found = importlib.util.find_spec
    absent = ("wandb", "mlflow")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name in absent else found(name, *rest))
    refused(trained, f"logger={logger}", parts=(package, f".[{package}]", f"~logger.{package}"))
    assert not (tmp_path / "run").exists()


def test_who_is_not_logged_in_is_told_before_a_folder_is_taken(trained, tmp_path, monkeypatch):
    class Refusal(Exception):
        pass

    def login(verify):
        raise Refusal("No API key configured. Use `wandb login` to log in.")

    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(login=login))
    monkeypatch.setitem(sys.modules, "wandb.errors", SimpleNamespace(Error=Refusal))
    monkeypatch.setattr(loggers, "_require", lambda *_: None)
    refused(trained, "logger=wandb", parts=("No API key configured", "logger.wandb.offline=true", "logger=tensorboard"))
    assert not (tmp_path / "run").exists()
    WeightsAndBiases(offline=True).require_access()
    monkeypatch.setenv("WANDB_MODE", "offline")
    WeightsAndBiases().require_access()


class Takes(WandbLogger):
    """Stands for W&B's logger: it keeps what it is given, and needs no package."""

    def __init__(self):
        self.pictures, self.codes = [], []

    def log_image(self, key, images, step=None, **more):
        self.pictures.append((key, images[0].shape, step))

    @property
    def experiment(self):
        return SimpleNamespace(finish=lambda exit_code: self.codes.append(exit_code))


def test_pictures_go_to_those_who_take_them_and_a_run_of_weights_and_biases_ends_with_ours(tmp_path):
    taker = Takes()
    show_picture([taker, CSVLogger(tmp_path)], "validation/picture", PICTURE, 7)
    assert taker.pictures == [("validation/picture", (4, 5, 3), 7)]
    chosen = {"wandb": lambda **given: taker}
    chosen["wandb"].func = None
    with opened_loggers(chosen, tmp_path, "now"):
        pass
    with pytest.raises(KeyError), opened_loggers(chosen, tmp_path, "now"):
        raise KeyError
    assert taker.codes == [0, 1]


# Fails from the given write, or the given flush, on, as a full disk does.
RUN = """
import errno, os, sys
from nerf_lightning.cli import main as cli
from tensorboard.summary.writer import record_writer

what, first = sys.argv[1], int(sys.argv[2])
real, calls = getattr(record_writer.RecordWriter, what), []

def full(self, *arguments):
    calls.append(1)
    if len(calls) >= first:
        raise OSError(errno.ENOSPC, "No space left on device")
    return real(self, *arguments)

setattr(record_writer.RecordWriter, what, full)
sys.argv = ["nerf", *sys.argv[3:]]
cli.main()
"""


@pytest.mark.parametrize(("what", "first"), [("write", 12), ("flush", 2)])
def test_is_one_paragraph(tmp_path, what, first):
    capture = write_npz(tmp_path / "small.npz")
    short = ("callbacks.monitor.every_steps=1", "trainer.max_steps=10", "final.evaluate=false", "final.video=false")
    arguments = ("train", "scene=npz", f"scene.path={capture}", *FAST, *short, f"paths.output_dir={tmp_path}/run")
    process = start_code(RUN, what, str(first), *arguments)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 2, errors
    assert "Traceback" not in errors
    assert "Exception in thread" not in errors
    (paragraph,) = [line for line in errors.splitlines() if line.startswith("nerf: ")]
    assert "No space left on device. Check that the folder exists, is writable, and has free space." in paragraph
    assert errors.splitlines()[-1] == paragraph
