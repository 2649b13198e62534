"""What a file may cost without the user's consent: one table of limits on bytes and elements of each container.

Files are untrusted. Each limit is far above what valid files need, and low enough that no file fills the memory or
takes hours. Users raise limits on the command line (`budgets.views=500000`); files cannot.

`conf/budgets/default.yaml` repeats the limits for the command line; a test compares the two.
"""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from nerf_lightning.messages.errors import InputError


@dataclass(frozen=True)
class Budgets:
    """Limits on what is read: `KIND_bytes` of a file of each kind, and its number of elements."""

    json_bytes: int = 1 << 26
    json_values: int = 4_000_000  # keys and values, counted by commas, colons and opening brackets
    xml_bytes: int = 1 << 26
    xml_values: int = 2_000_000  # tags and attributes
    yaml_bytes: int = 1 << 20
    yaml_values: int = 100_000  # keys and values, counted by what begins or separates them
    text_bytes: int = 1 << 24  # of a list of names or numbers, and of one line of a larger text
    text_values: int = 2_000_000  # words and lines
    ply_bytes: int = 1 << 32
    colmap_bytes: int = 1 << 36
    views: int = 200_000  # photographs of a capture
    points: int = 10_000_000  # sparse points of a capture, and entries of their tracks
    npy_bytes: int = 1 << 28
    npz_bytes: int = 2_000_000_000  # unpacked
    npz_arrays: int = 500_000
    image_bytes: int = 1 << 30
    image_header_bytes: int = 1 << 24  # before the first pixel of a JPEG
    megapixels: int = 178  # of an image file, and of a frame of a video
    view_pixels: int = 1 << 28  # of one camera's picture
    video_bytes: int = 1 << 38
    video_frames: int = 1_000_000
    tensor_bytes: int = 1 << 36
    tensor_objects: int = 1 << 23  # bytes of a PyTorch file that are not numbers
    unpacked_bytes: int = 1 << 32  # of a checkpoint's quantized weights (nerf prune), in memory
    event_bytes: int = 1 << 29  # of a run's TensorBoard files
    event_values: int = 1_000_000
    film_frames: int = 100_000  # of a camera path: more than an hour at 24 frames per second
    folders: int = 1_000_000  # that are searched for runs
    samples_per_ray: int = 1 << 12  # points along one ray at which a model evaluates its field at once
    layer_width: int = 1 << 12  # features per point in any layer of a model
    intervals: int = 1 << 17  # steps of a ray through an occupancy grid, from near to far

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if type(value) is not int or value < 1:
                raise InputError(f"budgets.{name}={value}: give a whole number above 0.")


class _Now:
    budgets = Budgets()


def limits() -> Budgets:
    """Return the budgets of this process."""
    return _Now.budgets


def set_limits(budgets: Budgets) -> None:
    """Use these budgets from now on."""
    _Now.budgets = budgets


def allow_as_typed(arguments: Iterable[str]) -> None:
    """Use the defaults with the command line's overrides: files are read before Hydra has composed a config."""
    known, typed = {field.name for field in fields(Budgets)}, dict[str, int]()
    for argument in arguments:
        key, _, value = argument.lstrip("+").partition("=")
        name = key.removeprefix("budgets.")
        if key != name and name in known:  # Hydra reports mistyped names
            if not value.isdecimal():
                raise InputError(f"{key}={value}: give a whole number above 0.")
            typed[name] = int(value)
    set_limits(Budgets(**typed))


def require_within(name: str, count: int | float, where: str | Path, what: str) -> None:
    """Refuse more of `what` than the budget `name` allows; `count` is infinite if counting stopped at the limit."""
    most = getattr(limits(), name)
    if count > most:
        is_known = not math.isinf(count)
        raise InputError(
            f"{where} has {f'{count:,} {what}, more' if is_known else f'more {what}'} than the limit of {most:,}. If "
            f"you trust it, add budgets.{name}={count if is_known else 2 * most}; otherwise use another file."
        )


MARKS = {"json": "[{,:", "xml": "<=", "yaml": "[{,:-?\n", "text": " \t\n"}
"""For each kind of text, what begins or separates its elements: their count is an upper bound before parsing."""


def require_text_within(kind: str, text: str, where: str | Path) -> None:
    """Refuse a text that is too long, or has too many elements."""
    require_within(f"{kind}_bytes", len(text), where, "characters")
    require_within(f"{kind}_values", sum(map(text.count, MARKS[kind])), where, "separators of values")
