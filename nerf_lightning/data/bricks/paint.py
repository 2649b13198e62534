"""The materials of the model: cheerful plastic, rubber, glass and chrome."""

from nerf_lightning.data.bricks.parts import Material

RED = Material((0.86, 0.10, 0.08))
WHITE = Material((0.94, 0.94, 0.92))
YELLOW = Material((0.99, 0.79, 0.08))
BLUE = Material((0.05, 0.35, 0.92), specular=0.6, sharpness=6, mirror=0.06)
SKIN = Material((0.98, 0.82, 0.20))
GREY = Material((0.62, 0.64, 0.66))
DARK = Material((0.20, 0.21, 0.23))
BLACK = Material((0.10, 0.10, 0.11), specular=0.12, sharpness=3, mirror=0.02)
SILVER = Material((0.78, 0.80, 0.82), specular=0.4, mirror=0.08)
LAMP = Material((1.0, 0.93, 0.70), specular=0.6, sharpness=6, mirror=0.08)
GLASS = Material((0.10, 0.20, 0.32), specular=1.0, sharpness=7, mirror=0.22)
CHROME = Material((0.86, 0.88, 0.92), specular=1.5, sharpness=6, mirror=0.75)
