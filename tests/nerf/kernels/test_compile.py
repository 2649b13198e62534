from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.compile import compile_kernels


def test_every_cpu_kernel_compiles():
    compile_kernels()
    assert all(backends.twin(f"{name}.cpu") for name in ("hash_grid", "march", "packed", "adam", "carving"))
