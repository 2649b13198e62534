"""One point of `nerf bench scaling=true`, measured in processes of its own."""

import multiprocessing
import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import psutil
import torch
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.compute.machine import peak_memory, seconds_of
from nerf_lightning.config.instantiate import build
from nerf_lightning.messages.errors import InputError

WARMUP_STEPS, WINDOWS, LEAST_SECONDS = 3, 5, 0.15


@dataclass(frozen=True)
class Point:
    """What was measured at one size."""

    step_seconds: float
    """Of a step of training, loading and all."""
    processor_seconds: float
    """That the step took of the first process's cores: other work on the machine changes it little."""
    batch_seconds: float
    """Of making its batch alone."""
    gigabytes: float
    """That the process held at most, less what it held before anything was read."""
    reading_seconds: float
    """Until the scene is there."""
    again_seconds: float
    """The same once more: of photographs, the pixels that were kept are mapped."""
    setup_seconds: float
    """From the scene to the first step: the model, fitted to the scene, and what its first step prepares."""


def measure_point(config: DictConfig, processes: int = 1) -> Point:
    """Measure the config, on so many processes that share each step's rays.

    Raises:
        InputError: what the config asks for cannot be built; the paragraph is the process's own.
    """
    context = multiprocessing.get_context("spawn")
    plain, port = OmegaConf.to_container(config, resolve=True), _free_port()
    pipes = [context.Pipe(duplex=False) for _ in range(processes)]
    running = [
        context.Process(target=_measure, args=(plain, number, processes, port, pipe[1]), daemon=True)
        for number, pipe in enumerate(pipes)
    ]
    for each, (_, end) in zip(running, pipes, strict=True):
        each.start()
        end.close()  # the child's alone: where it ends without a word, reading says so
    try:
        said = pipes[0][0].recv()
    except EOFError:
        said = "A process that measured ended without a word, probably for want of memory. Measure smaller sizes."
    for each in running:
        if isinstance(said, str):
            each.terminate()
        each.join()
    if isinstance(said, str):
        raise InputError(said)
    return Point(*said)


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def _measure(plain: Any, rank: int, world: int, port: int, pipe: Connection) -> None:
    try:
        if world > 1:
            os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
            torch.distributed.init_process_group("gloo", rank=rank, world_size=world)
        pipe.send(_numbers(OmegaConf.create(plain)))
    except InputError as error:
        pipe.send(str(error))
    finally:
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()


def _numbers(config: DictConfig) -> tuple[float, ...]:
    """Return the fields of a point, in order."""
    from nerf_lightning.bench.benchmark import prepare

    before = psutil.Process().memory_info().rss / 1e9
    made: list[Any] = []
    reading, again = (seconds_of(lambda: made.append(build(config.scene).read())) for _ in range(2))
    scene = made.pop()
    made.clear()  # a scene that is no mapped file lies in memory
    setup = seconds_of(lambda: made.append(prepare(config, scene)))
    bench = made[0]
    setup += seconds_of(bench.take_step)
    for _ in range(WARMUP_STEPS):
        bench.take_step()
    # As many steps in every process: the first one's pace decides.
    steps = torch.tensor(max(1, round(LEAST_SECONDS / seconds_of(bench.take_step))))
    if torch.distributed.is_initialized():
        torch.distributed.broadcast(steps, src=0)
    windows = [_window(bench.take_step, int(steps)) for _ in range(WINDOWS)]
    step, processor = (min(each) for each in zip(*windows, strict=True))
    progress = bench.batches.progress
    batches = [seconds_of(lambda: bench.batches.at(progress.attempt, progress.rays_seen)) for _ in range(WINDOWS)]
    return step, processor, min(batches), peak_memory() - before, reading, again, setup


def _window(take_step: Callable[[], None], steps: int) -> tuple[float, float]:
    """Return seconds, and seconds of this process on all cores, per step."""

    def take() -> None:
        for _ in range(steps):
            take_step()

    before = time.process_time()
    seconds = seconds_of(take)
    return seconds / steps, (time.process_time() - before) / steps
