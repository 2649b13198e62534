"""nerf_lightning: learn a radiance field from photographs with known cameras, and render new views."""

__version__ = "0.1.0"
