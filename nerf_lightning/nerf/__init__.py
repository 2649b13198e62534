"""Radiance fields as a library that needs torch, and neither Lightning nor Hydra; `__init__.pyi` has its names."""

from nerf_lightning import lazily

__getattr__, __dir__ = lazily(__name__, __file__)
