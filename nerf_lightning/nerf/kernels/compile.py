"""Compile the CPU kernels ahead of their first use; numba keeps them.

As a program: `python -m nerf_lightning.nerf.kernels.compile`.
"""

from nerf_lightning.nerf.kernels.backends import twin

CPU_TWINS = (
    *("hash_grid.cpu", "march.cpu", "packed.cpu", "adam.cpu", "carving.cpu", "bricks.cpu", "bricks.contracted"),
    *("bricks.gradients", "fusion.cpu", "texels.cpu", "mlp.cpu", "render.cpu", "render.gradients"),
)


def compile_kernels() -> None:
    """Run every kernel once on next to nothing."""
    for module in CPU_TWINS:
        twin(module)


if __name__ == "__main__":
    compile_kernels()
