"""Say whether this machine computes right: kernels, precisions, trainings, files; a table for a bug report."""

from omegaconf import DictConfig


def run(config: DictConfig) -> None:
    """Check, print a table, write selftest.json.

    Raises:
        SystemExit: something is wrong (exit code 1).
    """
    from nerf_lightning.commands.selftesting import selftest

    if not selftest(config):
        raise SystemExit(1)
