"""Measure training and rendering speed against plain float32 and against the machine's own matrix rate."""

from omegaconf import DictConfig

from nerf_lightning.bench.benchmark import benchmark


def run(config: DictConfig) -> float:
    """Measure, print a table, write bench.json; return training rays per second."""
    return benchmark(config)
