"""How many points go through a field at once: the default of each device, and the bounds of what a run has measured.

`training/fastest_tile.py` measures the fastest size; `nerf/models/tiles.py` cuts rays into tiles of it.
"""

CPU_TILE_POINTS = 8_192
GPU_TILE_POINTS = 1 << 20
MOST_CPU_TILE_POINTS = 1 << 18
MOST_GPU_TILE_POINTS = 1 << 22
LEAST_TILE_POINTS = 1 << 10


def default_tile_points(device_type: str) -> int:
    """Return the number of points of a tile that was not measured."""
    return CPU_TILE_POINTS if device_type == "cpu" else GPU_TILE_POINTS


def bounded_tile_points(measured: int, device_type: str) -> int:
    """Return a measured number within bounds: from an untrusted file, it may be tiny (slow) or huge (out of memory)."""
    most = MOST_CPU_TILE_POINTS if device_type == "cpu" else MOST_GPU_TILE_POINTS
    return min(max(measured, LEAST_TILE_POINTS), most)
