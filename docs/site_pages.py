"""Pages of the site that are not files in docs/: its index, the API, and documents from elsewhere in the repository.

Documents are written to be read where they lie, with ordinary links. Here these links become links within the site.
"""

import inspect
import os
import re
from collections.abc import Iterator
from pathlib import Path

import nerf_lightning

DOCS = Path(__file__).parent
ROOT = DOCS.parent
ELSEWHERE = {ROOT / f"{name}.md": name.lower() for name in ("SECURITY", "CONTRIBUTING", "CHANGELOG")} | {
    page: f"extension_{page.parent.name}" for page in sorted((ROOT / "nerf_lightning/extensions").glob("*/README.md"))
}
"""Documents outside of docs/, and the names of their pages in the site."""
WITHOUT_LINKS = {"Concepts": [name for name in ELSEWHERE.values() if "_" in name], "Reference": ["settings", "api"]}
"""Pages at the end of a section that docs/README.md does not link."""
LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)\s#]+)")
LIBRARY = {
    "From a pixel to a ray": [
        "geometry.cameras.pinhole_cameras",
        "geometry.cameras.rays_through_pixels",
        "geometry.poses.look_at",
        "geometry.contraction.contract",
        "types.rays.RayBundle",
    ],
    "Samplers": [
        "samplers.base.Sampler",
        "samplers.stratified.StratifiedSampler",
        "samplers.importance.ImportanceSampler",
    ],
    "Encoders and fields": [
        "encoders.base.Encoder",
        "encoders.base.ConeEncoder",
        "encoders.frequency.FrequencyEncoder",
        "encoders.hash_grid.HashGridEncoder",
        "fields.base.Field",
        "fields.nerf_mlp.NerfMLP",
        "fields.ngp_field.NGPField",
        "types.renderings.FieldOutput",
    ],
    "Volume rendering": [
        "rendering.quadrature.weights_from_density",
        "rendering.quadrature.composite",
        "rendering.histograms.sample_histogram",
        "types.renderings.Rendering",
    ],
    "Models": ["models.base.Model", "models.radiance_model.RadianceModel", "models.dense_level.DenseLevel"],
    "Losses": ["losses.base.Loss", "losses.mse.MeanSquaredError", "losses.weighted_sum.WeightedSum"],
}
"""What of `nerf_lightning.nerf` the API page shows."""


def write() -> None:
    """Write the pages into docs/, where git ignores them."""
    for source, name in ELSEWHERE.items():
        _write(name, within_site(source.read_text(encoding="utf-8"), source.parent))
    _write("index", "\n".join(_index()))
    _write("api", "\n".join(_api()))


def within_site(text: str, folder: Path) -> str:
    """Return a document with its relative links, which start from `folder`, pointing to pages of the site."""

    def target(link: re.Match[str]) -> str:
        file = Path(os.path.normpath(folder / link[1]))
        return f"{ELSEWHERE[file]}.md" if file in ELSEWHERE else os.path.relpath(file, DOCS)

    return LINK.sub(target, text)


def _index() -> Iterator[str]:
    """Yield docs/README.md, whose lists of links become the sidebar."""
    introduction, *sections = within_site((DOCS / "README.md").read_text(encoding="utf-8"), DOCS).split("\n## ")
    yield introduction
    for section in sections:
        caption, _, links = section.partition("\n")
        pages = [os.path.splitext(page)[0] for page in LINK.findall(links)] + WITHOUT_LINKS.get(caption, [])
        yield from ("```{toctree}", f":caption: {caption}", ":maxdepth: 1", ":hidden:", "", *pages, "```", "")


def _api() -> Iterator[str]:
    yield '# API\n\nShapes are in the annotations: `Float[Tensor, "*rays 3"]` is any number of rays by 3.\n'
    yield "## nerf_lightning\n"
    stub = Path(nerf_lightning.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    names = re.findall(r"^from \S+ import (\w+) as", stub, re.MULTILINE)
    yield from (_documented(f"nerf_lightning.{name}", getattr(nerf_lightning, name)) for name in sorted(names))
    yield "## The library: nerf_lightning.nerf\n"
    for section, paths in LIBRARY.items():
        yield f"### {section}\n"
        for path in paths:
            module, _, name = f"nerf_lightning.nerf.{path}".rpartition(".")
            found = getattr(__import__(module, fromlist=[name]), name)
            yield _documented(f"{module}.{name}", found)


def _documented(path: str, found: object) -> str:
    kind = "autoclass" if inspect.isclass(found) else "autofunction" if callable(found) else "autodata"
    return f"```{{eval-rst}}\n.. {kind}:: {path}\n```\n"


def _write(name: str, text: str) -> None:
    (DOCS / f"{name}.md").write_text(text + "\n", encoding="utf-8")
