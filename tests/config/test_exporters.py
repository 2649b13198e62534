"""What exporters say they need is found without naming them anywhere."""

from nerf_lightning.config.exporters import exporter_class, kernel_modules
from nerf_lightning.export.page import PageExport
from nerf_lightning.nerf.kernels.backends import backend


def test_every_kernel_of_models_and_of_exporters_compiles():
    modules = kernel_modules()
    assert {"nerf_lightning.nerf.kernels.march.cpu", "nerf_lightning.export.voxel_kernels.texels"} <= set(modules)
    assert all(backend(module) for module in modules)


def test_an_exporter_is_known_by_its_yaml_and_one_of_somebody_else_is_not():
    assert exporter_class("page") is PageExport
    assert exporter_class("my_own") is None
