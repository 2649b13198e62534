"""Two processes on the CPU that add up by gloo, as those of a run do."""

from pathlib import Path
from typing import Any

import torch
from support.running import output_of, start_code

JOIN = """
import sys
sys.path[:0] = ["tests", "tests/training"]
import torch
from torch import distributed
rank, folder = int(sys.argv[1]), sys.argv[2]
torch.set_num_threads(1)
distributed.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2)
"""
SAVE = """
torch.save(result, f"{folder}/{rank}.pt")
distributed.destroy_process_group()
"""


def in_two_processes(code: str, folder: Path) -> list[Any]:
    """Run code that knows its `rank` in two processes, and return the `result` of each."""
    processes = [start_code(JOIN + code + SAVE, str(rank), str(folder)) for rank in range(2)]
    for process in processes:
        output_of(process)
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]
