"""What loggers show of a run besides its curves: the config as text, and a row in the hyperparameter table.

Which settings have a column: `has_column` in `config/setting_rules.py`.
"""

from itertools import islice
from typing import Any

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.config.setting_rules import meaning_of, names_a_class
from nerf_lightning.messages.escaping import for_terminal
from nerf_lightning.training.callbacks.watcher import tensorboard_writers
from nerf_lightning.training.loggers import shown_name

MOST = 15
"""Maximum number of columns of the hyperparameter table: with more, those that matter are hard to find."""
FINAL_METRICS = ("test/psnr", "test/ssim")


def describe_run(loggers: list[Logger], config: DictConfig) -> None:
    """Write the hyperparameters, and for TensorBoard the config as text.

    TensorBoard fills in the metrics of its table from the scalars of the same names.
    """
    from torch.utils.tensorboard.summary import hparams

    values = hyper_parameters(config, list(HydraConfig.get().overrides.task))
    for logger in loggers:
        if not isinstance(logger, TensorBoardLogger):
            logger.log_hyperparams(values)
    for writer in tensorboard_writers(loggers):
        text = OmegaConf.to_yaml(config, resolve=True)
        writer.add_text("config", "\n".join(f"    {for_terminal(line)}" for line in text.split("\n")), 0)
        for summary in hparams(values, dict.fromkeys(map(shown_name, FINAL_METRICS), 0.0)):
            writer._get_file_writer().add_summary(summary)


def hyper_parameters(config: DictConfig, overrides: list[str]) -> dict[str, Any]:
    """Return scene, model, seed and other settings in which runs may differ, as TensorBoard takes them.

    Args:
        config: all settings.
        overrides: of the command line; all else has its default.
    """
    choices = HydraConfig.get().runtime.choices
    values = {"model": str(choices.get("model")), "scene": str(choices.get("scene")), "seed": config.get("seed")}
    for key, _, text in (override.lstrip("+~").partition("=") for override in overrides):
        if key not in values and _is_compared(key):
            value = OmegaConf.select(config, key, default=text)
            values[key] = value if isinstance(value, (bool, int, float, str)) else text
    return dict(islice(values.items(), MOST))


def _is_compared(key: str) -> bool:
    meaning = meaning_of(key.partition("@")[0])
    return meaning.has_column and (meaning.identity or meaning.learnt) and not names_a_class(key)
