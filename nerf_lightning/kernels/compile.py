"""Compile the CPU kernels ahead of their first use (`python -m nerf_lightning.kernels.compile`); numba keeps them."""

from nerf_lightning.kernels.backends import twin

CPU_TWINS = ("hash_grid_numba", "march_numba", "packed_numba", "adam_numba", "carving_numba")


def compile_kernels() -> None:
    """Run every kernel once on next to nothing."""
    for module in CPU_TWINS:
        twin(module)


if __name__ == "__main__":
    compile_kernels()
