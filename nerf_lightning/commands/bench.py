"""Measure training and rendering speed against plain float32 and against the machine's own matrix rate."""

import math

from omegaconf import DictConfig


def run(config: DictConfig) -> float:
    """Measure, print a table, write bench.json; return training rays per second, or the largest exponent of a step."""
    if config.scaling is not False:
        from nerf_lightning.bench.scaling import benchmark_scaling

        # An axis of one size, as threads on one core, has none.
        return max((k for k in benchmark_scaling(config).values() if not math.isnan(k)), default=math.nan)
    from nerf_lightning.bench.benchmark import benchmark

    return benchmark(config)
