"""The precision of a device's products with the fields' weights, with the reason for it.

Which CPUs multiply bfloat16, and gain by it: `nerf/matmul_precision.py`.
"""

import logging
import os
from typing import Literal, cast, get_args

import torch

from nerf_lightning.compute.devices import DeviceType
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.matmul_precision import Linear, cpu_gains_by_bfloat16, cpu_multiplies_bfloat16
from nerf_lightning.nerf.models.base import Model

log = logging.getLogger(__name__)

Chosen = Literal["32-true", "tf32", "bf16-mixed"]
Precision = Literal["auto", "32-true", "tf32", "bf16-mixed"]
NATIVE = "native bfloat16"


def choose_precision(requested: Precision, device_type: DeviceType) -> tuple[Chosen, str]:
    """Return the precision and the reason; auto is bf16-mixed if the device computes it natively.

    The environment variable NERF_LIGHTNING_PRECISION overrides what auto means, to try one kind of machine as another.

    Raises:
        InputError: tf32 was requested on a device without it, or the environment names no known precision.
    """
    meant = os.environ.get("NERF_LIGHTNING_PRECISION", "auto")
    if requested == "auto" and meant != "auto":
        if meant not in get_args(Precision):
            raise InputError(
                f"NERF_LIGHTNING_PRECISION={meant} in the environment is not a precision: use one "
                f"of {', '.join(get_args(Precision))}, or unset it."
            )
        precision, reason = cast(Precision, meant), "as NERF_LIGHTNING_PRECISION says"
    else:
        precision, reason = requested, "as asked"
    if precision == "auto":
        return ("bf16-mixed", NATIVE) if has_native_bfloat16(device_type) else ("32-true", "no native bfloat16")
    if precision == "tf32" and not has_tf32(device_type):
        raise InputError(
            "trainer.precision=tf32: TensorFloat-32 needs an NVIDIA GPU of the Ampere generation (2020) or later, "
            "which this device is not. Use trainer.precision=32-true, or auto."
        )
    if requested == "bf16-mixed" and not has_native_bfloat16(device_type):
        instead = "float32 is used instead" if device_type == "cuda" else "it is emulated, slowly"
        log.warning("trainer.precision=%s: this device has no native bfloat16, so %s.", requested, instead)
    return precision, reason


def suited(precision: Chosen, reason: str, device_type: DeviceType, model: Model) -> tuple[Chosen, str]:
    """Return the choice of `choose_precision`, or float32 if that suits the GPU or the model better; and why."""
    if precision == "bf16-mixed" and device_type == "cuda" and not has_native_bfloat16(device_type):
        return "32-true", "bfloat16 products need an NVIDIA GPU from Ampere on, or an AMD GPU"
    wide = any(isinstance(part, Linear) for part in model.modules())
    if reason == NATIVE and device_type == "cpu" and wide and not cpu_gains_by_bfloat16():
        return "32-true", "bfloat16 is native, but slower for layers as wide as this model's"
    return precision, reason


def has_native_bfloat16(device_type: str) -> bool:
    """Return whether the device multiplies bfloat16 matrices in hardware."""
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return cpu_multiplies_bfloat16() if device_type == "cpu" else device_type == "xla"


def has_tf32(device_type: str) -> bool:
    """Return whether the device multiplies matrices in TensorFloat-32."""
    return device_type == "cuda" and torch.cuda.get_device_capability() >= (8, 0)
