"""What other programs make of the files: splat-transform (npm), and Spark and SuperSplat's viewer in Chromium.

    npm install --prefix DIR @playcanvas/splat-transform@2.7.1 @playcanvas/supersplat-viewer @sparkjsdev/spark three
    NODE_PATH=DIR/node_modules pytest nerf_lightning/extensions/splats/tests/test_other_programs.py

splat-transform 2 runs on Node 18, 3 needs 22. Without them, or without Chromium, these tests are skipped.
"""

import base64
import io
import json
import os
import shutil
import subprocess
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree
from support.browser import opened, wait_until

from nerf_lightning.extensions.splats.files import save_splats
from nerf_lightning.extensions.splats.gaussians import Gaussians, Pinhole, dc_of_color
from nerf_lightning.extensions.splats.rasterizer import rasterize

SIZE, FOCAL, AWAY = 240, 300.0, 5.0
SPARK = """<!doctype html><canvas id="c"></canvas>
<script type="importmap">{"imports": {"three": "./node_modules/three/build/three.module.js",
  "three/addons/": "./node_modules/three/examples/jsm/",
  "@sparkjsdev/spark": "./node_modules/@sparkjsdev/spark/dist/spark.module.js"}}</script>
<script type="module">
import * as THREE from "three"; import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
const about = await (await fetch("about.json")).json(), [file, turned] = location.hash.slice(1).split(",");
const canvas = document.getElementById("c");
const renderer = new THREE.WebGLRenderer({ canvas, preserveDrawingBuffer: true });
renderer.setSize(about.width, about.height, false);
const scene = new THREE.Scene(), camera = new THREE.Camera();
camera.projectionMatrix.fromArray(about.projection);
camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
camera.applyMatrix4(new THREE.Matrix4().fromArray(about.c2w));
const splats = new SplatMesh({ url: file }); if (turned) splats.quaternion.set(1, 0, 0, 0);
// Our dilation; Spark's own default dims small splats as it widens them.
scene.add(new SparkRenderer({ renderer, preBlurAmount: 0.1, blurAmount: 0.0 }), splats);
await splats.initialized;
for (let frame = 0; frame < 20; frame++) {
  renderer.render(scene, camera); await new Promise(done => setTimeout(done, 100));
}
window.picture = canvas.toDataURL();
</script>"""


def modules(*names):
    """The folder of node's modules, or a skipped test."""
    folder = Path(os.environ.get("NODE_PATH", "node_modules")).absolute()
    missing = [name for name in names if not (folder / name).is_dir()]
    if missing or shutil.which("node") is None:
        pytest.skip(f"{', '.join(missing) or 'node'} is not installed: npm install, and NODE_PATH=DIR/node_modules")
    return folder


@pytest.fixture
def site(tmp_path):
    """A folder as a site."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=tmp_path))
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def signposts():
    """Red to the right, green on top, yellow in the middle and before blue; a haze of others, with harmonics."""
    generator = torch.Generator().manual_seed(3)
    means = torch.cat([torch.tensor([[1.2, 0, 0], [0, -1.2, 0], [0, 0, -1], [0, 0, 1.0]]), normal(generator, 200, 3)])
    rgb = torch.tensor([[1.0, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1]])
    scales = torch.cat([torch.full((4, 3), 0.25).log(), -3.0 + 0.5 * normal(generator, 200, 3)])
    logits = torch.cat([torch.full((4,), 4.0), -1.5 + normal(generator, 200)])
    dc = torch.cat([dc_of_color(rgb), 0.5 * normal(generator, 200, 3)])
    rest = torch.cat([torch.zeros(4, 8, 3), 0.2 * normal(generator, 200, 8, 3)])
    return Gaussians(means, scales, normal(generator, 204, 4), logits, dc, rest)


def normal(generator, *shape):
    return torch.randn(*shape, generator=generator)


def upright(picture):
    """Whether red is right, green up, and yellow before blue."""
    middle, tall = np.array(picture.shape[:2]) // 2, FOCAL / SIZE * picture.shape[0] / AWAY

    def color(right, up):
        y, x = (middle + 1.2 * tall * np.array([-up, right])).astype(int)
        return (picture[y - 5 : y + 5, x - 5 : x + 5].mean(axis=(0, 1)) > 128).tolist()

    return [color(1, 0), color(0, 1), color(0, 0)] == [[True, False, False], [False, True, False], [True, True, False]]


def seen_by_spark(site, folder, camera, name):
    """What Spark draws of a file through a camera of its splats. It takes axes as they are: a PLY has to be turned."""
    (folder / "node_modules").symlink_to(modules("three", "@sparkjsdev/spark"))
    (folder / "spark.html").write_text(SPARK)
    (fx, fy), (cx, cy), width, height = camera.focal, camera.center, camera.width, camera.height
    projection = [[2 * fx / width, 0, 1 - 2 * cx / width, 0], [0, 2 * fy / height, 2 * cy / height - 1, 0]]
    projection += [[0, 0, -1, -0.02], [0, 0, -1, 0]]
    turn, c2w = np.diag([1.0, -1.0, -1.0]), np.eye(4)
    c2w[:3, :3], c2w[:3, 3] = turn @ camera.rotation.numpy().T @ turn, turn @ camera.eye.numpy()
    matrices = {"projection": projection, "c2w": c2w}
    about = {key: np.array(each).T.flatten().tolist() for key, each in matrices.items()}
    (folder / "about.json").write_text(json.dumps(about | {"width": width, "height": height}))
    with opened(f"{site}/spark.html#{name}{',turned' if name.endswith('.ply') else ''}") as driver:
        driver.set_script_timeout(120)
        wait = "const done = arguments[0]; setInterval(() => window.picture && done(window.picture), 100)"
        return read(base64.b64decode(driver.execute_async_script(wait).partition(",")[2]))


def read(png):
    return np.array(Image.open(io.BytesIO(png)).convert("RGB"))


@pytest.mark.parametrize("end", ["ply", "spz"])
def test_spark_draws_what_the_rasterizer_does(site, tmp_path, end):
    if end == "spz":
        pytest.importorskip("gsply", reason="gsply is not installed (the extra splats)")
    center = SIZE / 2 - 10.0, SIZE / 2 + 5.0
    camera = Pinhole(torch.eye(3), torch.tensor([0.0, 0.0, -AWAY]), (FOCAL, FOCAL), center, SIZE, SIZE, 0.1)
    save_splats(tmp_path / f"splats.{end}", signposts())
    found = seen_by_spark(site, tmp_path, camera, f"splats.{end}")
    expected = 255 * rasterize(signposts(), camera, torch.zeros(3)).clamp(0, 1).numpy()
    assert 10 * np.log10(255**2 / np.square(found - expected).mean()) > 33.0


def test_supersplat_shows_it_upright(site, tmp_path):
    """Its viewer turns a PLY until its y points down, and looks along z."""
    viewer = modules("@playcanvas/supersplat-viewer") / "@playcanvas" / "supersplat-viewer" / "public"
    shutil.copytree(viewer, tmp_path, dirs_exist_ok=True)
    save_splats(tmp_path / "splats.ply", signposts())
    fov = float(np.degrees(2 * np.arctan(SIZE / 2 / FOCAL)))
    pose = {"position": [0, 0, -AWAY], "target": [0, 0, 0], "fov": fov}
    settings = {"version": 2, "tonemapping": "linear", "background": {"color": [0, 0, 0]}, "startMode": "default"}
    settings |= {"highPrecisionRendering": False, "cameras": [{"initial": pose}], "animTracks": [], "annotations": []}
    effects = ("sharpness", "bloom", "grading", "vignette", "fringing")
    settings["postEffectSettings"] = {name: {"enabled": False} for name in effects}
    (tmp_path / "settings.json").write_text(json.dumps(settings))
    with opened(f"{site}/index.html?content=splats.ply&webgl&noui&noanim", 600, 600) as driver:
        wait_until(driver, lambda _: upright(read(driver.get_screenshot_as_png())))


@pytest.mark.parametrize("end", ["ply", "spz", "sog"])
def test_splat_transform_finds_the_same_in_each_file(tmp_path, end):
    if end == "spz":
        pytest.importorskip("gsply", reason="gsply is not installed (the extra splats)")
    splats = signposts()
    save_splats(tmp_path / f"splats.{end}", splats)
    transform(tmp_path / f"splats.{end}", tmp_path / "splats.csv")
    table = np.genfromtxt(tmp_path / "splats.csv", delimiter=",", names=True)
    means = np.stack([table[column] for column in "xyz"], axis=-1)
    apart, order = cKDTree(means).query(splats.means.numpy())  # SOG has an order of its own
    assert apart.max() < 0.01
    for column, expected in {"scale_0": splats.log_scales[:, 0], "f_dc_1": splats.sh_dc[:, 1]}.items():
        np.testing.assert_allclose(table[column][order], expected.numpy(), atol=0.07)


def test_a_glb_is_the_one_that_splat_transform_makes_of_the_ply(tmp_path):
    """But for its front: half a turn about what is up."""
    for name in ("splats.ply", "ours.glb"):
        save_splats(tmp_path / name, signposts())
    transform(tmp_path / "splats.ply", tmp_path / "theirs.glb")
    for name, factor in {"POSITION": [-1, 1, -1], "SCALE": 1, "OPACITY": 1, "SH_DEGREE_0_COEF_0": 1}.items():
        ours, theirs = (attribute(tmp_path / f"{each}.glb", name) for each in ("ours", "theirs"))
        np.testing.assert_allclose(ours * factor, theirs, atol=1e-5)


def transform(*arguments):
    program = modules("@playcanvas/splat-transform") / ".bin" / "splat-transform"
    done = subprocess.run([program, *arguments], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


def attribute(path, name):
    content = path.read_bytes()
    length = int.from_bytes(content[12:16], "little")
    tree, body = json.loads(content[20 : 20 + length]), content[28 + length :]
    (primitive,) = tree["meshes"][0]["primitives"]
    found = [k for key, k in primitive["attributes"].items() if key.removeprefix("KHR_gaussian_splatting:") == name]
    accessor = tree["accessors"][found[0]]
    width, view = {"SCALAR": 1, "VEC3": 3}[accessor["type"]], tree["bufferViews"][accessor["bufferView"]]
    return np.frombuffer(body, "<f4", accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
