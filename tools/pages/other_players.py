"""Other players of splats in a page: one instant of a scene as they take it, and seconds until its picture is there.

Spark draws SPZ with three.js. PlayCanvas draws SOG without harmonics, as splat-transform takes too long to pack those
where there is no GPU. Each page is one module, bundled and minified by esbuild. It comes gzipped and is unpacked in the
page, since the package's server zips small files only. What is needed lies in a node_modules: three, @sparkjsdev/spark,
playcanvas, @playcanvas/splat-transform, esbuild.
"""

from __future__ import annotations

import gzip
import json
import math
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.interchange.export import turned_camera, upright
from pd4dgs_codec.scene import Camera, SceneInfo

#: Steps of refinement of an exported file, and its name in the folder of a page.
STEPS, SPLATS = 300, {"Spark": "scene.spz", "PlayCanvas": "scene.sog"}
#: A picture is there when this share of its pixels are no longer the background, by so many of 255.
SHARE, LEVELS = 0.01, 8
INDEX = """<!doctype html>
<meta charset="utf-8">
<link rel="icon" href="data:,">
<style>html, body { margin: 0; background: #000; } canvas { display: block; }</style>
<script type="module">
const packed = await fetch("page.js.gz");
const code = await new Response(packed.body.pipeThrough(new DecompressionStream("gzip"))).blob();
await import(URL.createObjectURL(new Blob([code], { type: "text/javascript" })));
</script>
"""
#: Shared by both: `view`, and `look`, called after each picture, which notes when the scene is seen.
COMMON = """
const { matrix, fov, width, height, background, near, far } = VIEW;
const clear = background.map((value) => Math.round(255 * value));
function look(gl) {
  if (window.seen) return;
  const pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  let count = 0;
  for (let i = 0; i < pixels.length; i += 4) {
    count += [0, 1, 2].some((k) => Math.abs(pixels[i + k] - clear[k]) > LEVELS);
  }
  if (count >= SHARE * width * height) window.seen = performance.now() / 1000;
}
"""
PAGES = {
    "Spark": """
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
COMMON
const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
renderer.setPixelRatio(1);
renderer.setSize(width, height);
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
scene.background = new THREE.Color().setRGB(...background, THREE.SRGBColorSpace);
const camera = new THREE.PerspectiveCamera(fov, width / height, near, far);
camera.matrixAutoUpdate = false;
camera.matrix.fromArray(matrix);
scene.add(camera, new SparkRenderer({ renderer }), new SplatMesh({ url: "scene.spz" }));
renderer.setAnimationLoop(() => {
  renderer.render(scene, camera);
  look(renderer.getContext());
});
""",
    "PlayCanvas": """
import { Application, Asset, Color, Entity, Mat4 } from "playcanvas";
COMMON
const canvas = document.createElement("canvas");
document.body.append(canvas);
const app = new Application(canvas, {
  graphicsDeviceOptions: { antialias: false, preserveDrawingBuffer: true, deviceTypes: ["webgl2"] },
});
app.graphicsDevice.maxPixelRatio = 1;
app.setCanvasFillMode("NONE", width, height);
app.setCanvasResolution("FIXED", width, height);
app.start();
const camera = new Entity();
camera.addComponent("camera", { clearColor: new Color(...background), fov, nearClip: near, farClip: far });
const placed = new Mat4().set(matrix);
camera.setLocalPosition(placed.getTranslation());
camera.setLocalEulerAngles(placed.getEulerAngles());
app.root.addChild(camera);
const asset = new Asset("scene", "gsplat", { url: "scene.sog" });
app.assets.add(asset);
asset.ready(() => {
  const entity = new Entity();
  entity.addComponent("gsplat", { asset });
  app.root.addChild(entity);
});
app.assets.load(asset);
app.on("frameend", () => look(app.graphicsDevice.gl));
""",
}


@dataclass(frozen=True)
class Laid:
    """A page in a folder. page, splats: bytes of what a visit loads, gzipped where it comes so."""

    page: int
    splats: int


def export(scene: Path, source: str, downscale: int, modules: Path, folder: Path) -> None:
    """The scene's first instant as SPZ of degree 3 and as SOG of degree 0 in `folder`, as the training cameras of the
    dataset see it."""
    common = ["--data", source, "--downscale", str(downscale), "--refine", str(STEPS), "--time", "0"]
    for kind, degree in (("spz", "3"), ("ply", "0")):
        target = ["-o", folder / f"scene.{kind}", "--to", kind, "--sh", degree]
        _run(sys.executable, "-m", "pd4dgs_codec", "export", scene, *target, *common)
    transform = _program(modules, "@playcanvas/splat-transform/bin/cli.mjs")
    _run("node", transform, "-g", "cpu", folder / "scene.ply", folder / "scene.sog")


def lay_out(name: str, info: SceneInfo, size: tuple[int, int], splats: Path, modules: Path, folder: Path) -> Laid:
    """The page of one of PAGES in `folder`, with the scene's own camera in a picture of `size` = (width, height)."""
    if info.camera is None:
        raise DataError("the scene has no camera of its own")
    view = _view(turned_camera(info.camera, upright(info.up) if name == "Spark" else None), size)
    view |= {"background": list(info.background), "near": float(info.near), "far": float(info.far)}
    code = PAGES[name].replace("COMMON", COMMON.replace("SHARE", str(SHARE)).replace("LEVELS", str(LEVELS)))
    entry = modules.parent / f"page-{name}.mjs"  # modules are looked for beside it
    entry.write_text(code.replace("VIEW", json.dumps(view)))
    bundle = folder / "page.js"
    try:
        flags = ["--bundle", "--minify", "--format=esm", "--target=es2022", f"--outfile={bundle}", "--log-level=error"]
        _run(_program(modules, ".bin/esbuild"), entry, *flags)
    finally:
        entry.unlink()
    packed = gzip.compress(bundle.read_bytes(), 9, mtime=0)
    bundle.unlink()
    (folder / "page.js.gz").write_bytes(packed)
    (folder / "index.html").write_text(INDEX)
    scene = (splats / SPLATS[name]).read_bytes()
    (folder / SPLATS[name]).write_bytes(scene)
    return Laid(len(packed) + len(gzip.compress(INDEX.encode(), 9, mtime=0)), len(scene))


def _view(camera: Camera, size: tuple[int, int]) -> dict[str, object]:
    """The camera as WebGL has it: columns of its matrix to the world, vertical field of view in degrees; the picture's
    middle is in the middle, and all of the camera's picture is seen."""
    width, height = size
    pose = np.linalg.inv(camera.viewmat.astype(np.float64)) @ np.diag([1.0, -1.0, -1.0, 1.0])
    scale = min(width / camera.width, height / camera.height)
    fov = 2 * math.degrees(math.atan(height / (2 * scale * float(camera.K[1, 1]))))
    return {"matrix": pose.T.reshape(-1).tolist(), "fov": fov, "width": width, "height": height}


def _program(modules: Path, name: str) -> Path:
    """A program in a folder of npm."""
    if not (modules / name).exists():
        raise DataError(f"{modules / name}: is not there; npm install makes it")
    return modules / name


def _run(*command: object) -> None:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or "it failed").splitlines()[-1]
        raise DataError(f"{Path(str(command[0])).name}: {said}")
