"""Read an exported page again."""

import base64
import gzip
import json
import re
from dataclasses import fields

import numpy as np

from nerf_lightning.extensions.splats.gaussians import Gaussians
from nerf_lightning.extensions.splats.quantized import QuantizedSplats


def read_page(page) -> tuple[dict, Gaussians]:
    """What a page says of its scene, and the splats in it."""
    text = page.read_text()
    about, packed = (re.search(rf'id="{name}">([^<]*)</script>', text)[1] for name in ("about", "splats"))
    about, planes = json.loads(about), np.frombuffer(gzip.decompress(base64.b64decode(packed)), np.uint8)
    known = {field.name: about[field.name] for field in fields(QuantizedSplats) if field.name != "content"}
    known |= {name: tuple(known[name]) for name in ("scales", "colors")}
    return about, QuantizedSplats(**known, content=planes.reshape(-1, about["splats"])).gaussians()
