"""Random numbers and permutations by kernels; None where there is none for what is given."""

from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.kernels.backends import backend_for, cpu_backend


def uniform(
    key: Int[Tensor, "*rays"], slots: Int[Tensor, "*rays"], word: int, count: int
) -> Float[Tensor, "*rays {count}"] | None:
    """Do what `RayRandom.uniform` does, for rays in a row."""
    kernels = backend_for("random", slots.device) if slots.dim() == 1 else None
    return None if kernels is None else kernels.uniform(key, slots, word, count)


def permute(index: Int[Tensor, "*n"], size: int, key: Int[Tensor, "*#n"]) -> Int[Tensor, "*n"] | None:
    """Do what `randomness.permute` does, where all have one key."""
    from nerf_lightning.nerf.randomness import grid_of, round_words

    kernels = cpu_backend("random.cpu", index.device) if key.numel() == 1 and index.dim() == 1 else None
    return None if kernels is None else kernels.permute(index, *grid_of(size), size, round_words(int(key)))
