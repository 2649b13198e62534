"""Where curves and pictures go, under which names: Lightning's own loggers, each opened in a run's folder."""

import importlib.util
import os
import uuid
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxtyping import UInt8
from lightning.pytorch.loggers import CSVLogger, Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from torch import Tensor

from nerf_lightning.messages.errors import InputError

GROUPS = (
    ("train/psnr_", "PSNR/train_"),
    ("val/psnr", "PSNR/validation"),
    ("test/psnr", "PSNR/test"),
    ("train/loss_", "Training loss/"),
    ("train/loss", "Training loss/sum"),
    ("validation/picture", "Pictures/validation"),
    ("scene/cameras", "Pictures/cameras"),
)
"""Prefixes of names and their groups. Pictures come between PSNR and losses, and histograms last."""
ALONG_RAYS, PER_RAY = "weights_along_rays/weight", "weights_per_ray/effective_samples"
WHOLE = ("val/psnr", "test/psnr", "train/loss", "validation/picture", "scene/cameras")
"""Names that are not prefixes of others."""


class OrderedTensorBoard(TensorBoardLogger):
    """TensorBoard's files, by Lightning, with names that put PSNR, pictures and losses on top.

    Args:
        save_dir: the run folder.
        name: the folder of the files, in the run folder.
        version: a folder in that one; empty: none.
        purge_step: the first step of which an earlier start's data is discarded.
    """

    def __init__(
        self, save_dir: str | Path, name: str = "tensorboard", version: str = "", purge_step: int | None = None
    ):
        super().__init__(save_dir, name=name, version=version, purge_step=purge_step)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Write scalars under TensorBoard's names."""
        super().log_metrics({shown_name(name): value for name, value in metrics.items()}, step)


def shown_name(name: str) -> str:
    """Return the name under which TensorBoard shows a scalar or a picture.

    >>> [shown_name(name) for name in ("val/psnr", "val/psnr_standard_error", "train/loss_fine", "speed/rays_per_step")]
    ['PSNR/validation', 'val/psnr_standard_error', 'Training loss/fine', 'speed/rays_per_step']
    """
    for beginning, group in GROUPS:
        if name == beginning if beginning in WHOLE else name.startswith(beginning):
            return group + name.removeprefix(beginning)
    return name


LOG_IN = "Log in with wandb login, keep everything here with logger.wandb.offline=true"


class RunLogger(ABC):
    """Settings of a logger, which is opened once the run has its folder."""

    @abstractmethod
    def open(self, folder: Path, started: str) -> Logger:
        """Return the logger of the run in this folder.

        Args:
            folder: the run folder.
            started: when the run started; the same for each start of a resumed run.

        Raises:
            InputError: it cannot be opened.
        """


class CsvFiles(RunLogger):
    """Every curve in `csv/version_N/metrics.csv` of the run folder, one version per start; it takes no pictures."""

    def open(self, folder: Path, started: str) -> CSVLogger:
        """See `RunLogger`."""
        # With one name for all starts, Lightning's logger would empty the folder of an earlier one.
        return CSVLogger(save_dir=folder, name="csv", flush_logs_every_n_steps=1)


class WeightsAndBiases(RunLogger):
    """Curves, settings and pictures in a project of Weights & Biases; a resumed run continues on its page there.

    Args:
        project: the project of the run; it is created if it is missing.
        entity: the user or team of the project; None: your own.
        offline: keep everything in the run folder (`wandb/`), for `wandb sync`; the environment variable
            WANDB_MODE=offline does the same.

    Raises:
        InputError: wandb is not installed.
    """

    def __init__(self, project: str = "nerf_lightning", entity: str | None = None, offline: bool = False):
        _require("wandb", "logger=wandb", "wandb")
        self.project, self.entity, self.offline = project, entity, offline

    def require_access(self) -> None:
        """Look for an API key before the run has a folder; in a terminal, W&B asks for one.

        Raises:
            InputError: the user is not logged in.
        """
        if self.offline or os.environ.get("WANDB_MODE") in ("offline", "dryrun", "disabled"):
            return
        import wandb
        from wandb.errors import Error

        with _refused(Error, "Weights & Biases", LOG_IN):
            wandb.login(verify=False)

    def open(self, folder: Path, started: str) -> WandbLogger:
        """See `RunLogger`."""
        from wandb.errors import Error

        logger = WandbLogger(
            name=folder.name,
            save_dir=folder,
            project=self.project,
            entity=self.entity,
            offline=self.offline,
            id=uuid.uuid5(uuid.NAMESPACE_URL, f"{folder.absolute()} {started}").hex[:16],
        )
        with _refused(Error, "Weights & Biases", LOG_IN):
            _ = logger.experiment
        return logger


class MLflow(RunLogger):
    """Curves, settings and pictures in an experiment of MLflow; each start of a run is a separate run there.

    Args:
        experiment: the experiment of the run; it is created if it is missing.
        tracking_uri: the server, or a database such as `sqlite:///mlflow.db`; None: the environment variable
            MLFLOW_TRACKING_URI, otherwise `mlflow.db` in the run folder.

    Raises:
        InputError: mlflow is not installed.
    """

    def __init__(self, experiment: str = "nerf_lightning", tracking_uri: str | None = None):
        _require("mlflow", "logger=mlflow", "mlflow")
        self.experiment, self.tracking_uri = experiment, tracking_uri

    def open(self, folder: Path, started: str) -> MLFlowLogger:
        """See `RunLogger`."""
        from mlflow.exceptions import MlflowException

        given = self.tracking_uri or os.environ.get("MLFLOW_TRACKING_URI")
        pictures = None if given else (folder / "mlflow").absolute().as_uri()
        uri = given or f"sqlite:///{(folder / 'mlflow.db').absolute()}"
        with _refused(MlflowException, f"MLflow at {uri}", "Give another logger.mlflow.tracking_uri"):
            logger = MLFlowLogger(self.experiment, run_name=folder.name, tracking_uri=uri, artifact_location=pictures)
            _ = logger.experiment
        return logger


@contextmanager
def opened_loggers(chosen: Mapping[str, Any], folder: Path, started: str, **purge: int) -> Iterator[list[Logger]]:
    """Open the config's loggers, and close them when the run ends, for whatever reason.

    Args:
        chosen: loggers built from the config: classes of this file, or Lightning's own that lack only `save_dir`.
        folder: the run folder.
        started: when the run started.
        **purge: `purge_step`, from which TensorBoard discards what an earlier start has logged.

    Raises:
        InputError: one cannot be opened.
    """
    loggers: list[Logger] = []
    code = 1
    try:
        for each in chosen.values():
            if isinstance(each, RunLogger):
                loggers.append(each.open(folder, started))
            else:
                forgets = isinstance(each.func, type) and issubclass(each.func, TensorBoardLogger)
                loggers.append(each(save_dir=folder, **(purge if forgets else {})))
        yield loggers
        code = 0
    finally:
        for logger in loggers:
            if isinstance(logger, WandbLogger):
                logger.experiment.finish(exit_code=code)  # else the next job of a sweep would continue it


def show_picture(loggers: list[Logger], tag: str, picture: UInt8[Tensor, "height width 3"], step: int) -> None:
    """Log a picture with the loggers that support pictures: TensorBoard, Weights & Biases, MLflow."""
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(shown_name(tag), picture.numpy(), step, dataformats="HWC")
        elif isinstance(logger, WandbLogger):
            logger.log_image(tag, [picture.numpy()], step)
        elif isinstance(logger, MLFlowLogger):
            logger.experiment.log_image(logger.run_id, picture.numpy(), f"{tag}/step_{step:07d}.png")


@contextmanager
def _refused(error: type[Exception], what: str, cure: str) -> Iterator[None]:
    try:
        yield
    except error as refusal:
        reason = " ".join(str(refusal).split()).rstrip(".")
        raise InputError(
            f"{what} cannot be used: {reason}. {cure}, or leave it out with logger=tensorboard."
        ) from refusal


def _require(package: str, setting: str, extra: str) -> None:
    if importlib.util.find_spec(package) is None:
        raise InputError(
            f"{setting} needs {package}, which is not installed: pip install '.[{extra}]'. Or leave it "
            f"out: logger=tensorboard, logger=csv, or ~logger.{package}."
        )
