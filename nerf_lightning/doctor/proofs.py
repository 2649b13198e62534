"""What can be shown to a person for a verdict on poses: two photographs with matched details."""

from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from nerf_lightning.doctor.matches import Matches
from nerf_lightning.nerf.types.scene import Cameras


@dataclass(frozen=True)
class Proof:
    """Two photographs with details that a person can find in both, and that the cameras contradict."""

    matches: Matches
    """Details of the two, all of which speak against the cameras."""
    fits: Cameras | None
    """All cameras as the details say that they are, where that is known."""


def strongest_proof(
    matches: Matches, against: Bool[Tensor, "matches"], fits: Cameras | None, view: int | None = None
) -> tuple[Proof, ...]:
    """Return the pair of photographs with most matches that speak against the cameras; none where none does.

    Args:
        matches: all of them.
        against: those that speak against the cameras.
        fits: the cameras that they speak for.
        view: which view must be the first of the two; by default, any.
    """
    matches = matches.where(against) if view is None else matches.where(against).with_first(view)
    if not len(matches.view):
        return ()
    _, pair, count = matches.view.unique(dim=0, return_inverse=True, return_counts=True)
    return (Proof(matches.where(pair == count.argmax()), fits),)
