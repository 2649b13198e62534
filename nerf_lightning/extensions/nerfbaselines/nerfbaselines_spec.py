"""The entry point that NerfBaselines reads each time it starts: torch is not imported here."""

from nerfbaselines import register

register(
    {
        "id": "nerf-lightning",
        "method_class": "nerf_lightning.extensions.nerfbaselines.nerfbaselines:NerfLightning",
        "backends_order": ["python"],
        "metadata": {"name": "nerf_lightning", "licenses": [{"name": "Apache-2.0"}]},
        "presets": {
            "blender": {"@apply": [{"dataset": "blender"}], "model": "fast"},
            "llff": {"@apply": [{"dataset": "llff"}], "model": "fast_proposal"},
            "mipnerf360": {"@apply": [{"dataset": "mipnerf360"}], "model": "fast_proposal", "max_steps": 40_000},
        },
    }
)
