"""What loggers show of a run besides its curves: the config as text, and a row in the hyper-parameter table."""

from typing import Any

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.config.key_meanings import meaning_of, names_a_class
from nerf_lightning.config.overrides import flatten
from nerf_lightning.escaping import for_terminal
from nerf_lightning.training.callbacks.watcher import tensorboard_writers

CHOICES = ("encoder", "experiment", "field", "model", "scene")
FINAL_METRICS = ("test/psnr", "test/ssim")


def describe_run(loggers: list[Logger], config: DictConfig) -> None:
    """Write the hyper-parameters, and for TensorBoard the config as text.

    TensorBoard fills in the metrics of its table from the scalars of the same names.
    """
    from torch.utils.tensorboard.summary import hparams

    values = hyper_parameters(config)
    for logger in loggers:
        if not isinstance(logger, TensorBoardLogger):
            logger.log_hyperparams(values)
    for writer in tensorboard_writers(loggers):
        text = OmegaConf.to_yaml(config, resolve=True)
        writer.add_text("config", "\n".join(f"    {for_terminal(line)}" for line in text.split("\n")), 0)
        for summary in hparams(values, dict.fromkeys(FINAL_METRICS, 0.0)):
            writer._get_file_writer().add_summary(summary)


def hyper_parameters(config: DictConfig) -> dict[str, Any]:
    """Return the settings by which runs differ, flat, as TensorBoard takes them."""
    resolved = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    assert isinstance(resolved, DictConfig)
    compared = {key: value for key, value in flatten(resolved).items() if _is_compared(key)}
    # TensorBoard sorts by name and shows the first few: what was chosen comes first.
    chosen = {f"choice.{group}": HydraConfig.get().runtime.choices.get(group) for group in CHOICES}
    return {name: str(choice) for name, choice in chosen.items()} | {
        key: value if isinstance(value, (bool, int, float, str)) else str(value) for key, value in compared.items()
    }


def _is_compared(key: str) -> bool:
    meaning = meaning_of(key)
    return (meaning.identity or meaning.learnt) and not names_a_class(key)
