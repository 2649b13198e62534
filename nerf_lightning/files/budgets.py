"""What a file may cost before a person has agreed: the one table of sizes that are taken from a file unasked.

Files come from anybody. Each limit is far above what sound files need, and low enough that nothing fills the memory or
runs for hours. A person who knows better raises it on the command line (`budgets.views=500000`); no file can.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields

from nerf_lightning.messages.errors import InputError


@dataclass(frozen=True)
class Budgets:
    """How much of each kind, at most."""

    views: int = 200_000
    """Photographs of a capture."""
    points: int = 10_000_000
    """Sparse points of a capture."""
    view_pixels: int = 1 << 28
    """Pixels of one camera's picture."""
    megapixels: int = 178
    """Size of a picture file that is decoded, in millions of pixels."""
    samples_per_ray: int = 1 << 12
    """Points that a model asks its field about along one ray, at once."""
    layer_width: int = 1 << 12
    """Features that a model holds of one point, in any of its layers."""
    intervals: int = 1 << 17
    """Steps of a march through an occupancy grid, from near to far."""
    json_bytes: int = 1 << 26
    """Of a json file."""
    json_lists: int = 2_000_000
    """Lists and objects in a json file, each of which takes a hundred times its bytes in memory."""
    yaml_characters: int = 1 << 20
    """Of a yaml text."""
    tensor_bytes: int = 1 << 36
    """Of a PyTorch file."""
    unpacked_bytes: int = 1 << 32
    """Of the weights that a checkpoint keeps in fewer bytes (nerf prune), as they are in memory."""
    event_bytes: int = 1 << 29
    """Of a run's TensorBoard files."""
    film_frames: int = 100_000
    """Of a camera path; an hour at 24 frames per second is less."""
    folders: int = 1_000_000
    """That are searched for runs."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if type(value) is not int or value < 1:
                raise InputError(f"budgets.{name}={value}: give a whole number above 0.")


class _Now:
    budgets = Budgets()


def limits() -> Budgets:
    """Return the budgets that hold in this process."""
    return _Now.budgets


def set_limits(budgets: Budgets) -> None:
    """Let these budgets hold from now on."""
    _Now.budgets = budgets


def allow_as_typed(arguments: Iterable[str]) -> None:
    """Let the defaults hold, but for what the command line says: files are read before Hydra has composed a config."""
    known, typed = {field.name for field in fields(Budgets)}, dict[str, int]()
    for argument in arguments:
        key, _, value = argument.lstrip("+").partition("=")
        name = key.removeprefix("budgets.")
        if key != name and name in known:  # what is mistyped is named by Hydra
            if not value.isdecimal():
                raise InputError(f"{key}={value}: give a whole number above 0.")
            typed[name] = int(value)
    set_limits(Budgets(**typed))


def require_within(name: str, found: int, where: str, what: str) -> None:
    """Refuse what costs more than a person has agreed to: `found` of a `what`, where the budget `name` allows fewer."""
    most = getattr(limits(), name)
    if found > most:
        raise InputError(
            f"{where} has {found:,} {what}, more than the limit of {most:,}. If you trust it, add "
            f"budgets.{name}={found}; otherwise use another file."
        )
