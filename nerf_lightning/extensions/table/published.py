"""Published results for well-known scenes, with their sources.

The numbers are in `published.yaml`.
"""

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import yaml

FILE = Path(__file__).with_name("published.yaml")


@dataclass(frozen=True)
class Published:
    """One method's result on one scene."""

    benchmark: str
    scene: str
    method: str
    psnr: float
    resolution: str
    """Resolution of the test pictures."""
    steps: int | None
    time: str | None
    source: str
    measured: str
    """How it was measured: views, size, background."""
    readers: tuple[str, ...]
    """The formats of such a capture."""


def published_for(scene: str, reader: str) -> list[Published]:
    """Return the results for a scene (its name, or a name that begins with it), the best first.

    >>> [found.psnr for found in published_for("lego_200", "blender")][-1]
    31.37
    >>> published_for("bricks", "bricks")
    []

    The user's own chair is not the benchmark's: the format must match.
    """
    names = {scene.lower(), re.split(r"[\W_]", scene.lower())[0]}
    found = [result for result in _all() if result.scene in names and reader in result.readers]
    return sorted(found, key=lambda result: -result.psnr)


@cache
def _all() -> tuple[Published, ...]:
    benchmarks = yaml.safe_load(FILE.read_text(encoding="utf-8"))["benchmarks"]
    results = [(benchmark, result) for benchmark in benchmarks for result in benchmark["results"]]
    return tuple(
        Published(
            *(benchmark["name"], scene, result["method"], float(psnr), benchmark["resolution"], result.get("steps")),
            *(result["time"], result["source"], benchmark["measured"], tuple(benchmark["readers"])),
        )
        for benchmark, result in results
        for scene, psnr in result["psnr"].items()
    )
