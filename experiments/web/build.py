"""Build a page that plays garments in the browser alone, with only a file server and no Python behind it.

    python -m experiments.web.build --out site
    python -m experiments.web.build skirt runs/mine --motions walk_3 dance_3 --out site
    python -m http.server --directory site          # and open the address that it prints

ONNX Runtime Web (WebAssembly, or WebGPU: `?provider=webgpu`) moves the garments, three.js skins the body on the GPU and
draws. It needs Node with npm, which fetches the packages that `package.json` names.
"""

import json
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from clothjax import cli
from clothjax.export import onnx
from clothjax.files import storage
from clothjax.progress import progress_bar
from clothjax.render import ray_cast
from clothjax.runtime import loading, specialise, trained
from clothjax.types import Body

HERE = Path(__file__).parent
SOURCES = ("package.json", "package-lock.json", "main.js", "index.html")
MOTIONS = ("walk_3", "dance_3", "run_3", "jump_3", "twist_3", "arms_3")
INFLUENCES = 4  # joints that move a vertex of the body: what GPU skinning takes


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.web.build", __doc__)
    cli.model_argument(parser, nargs="*", about="; several; default: every one that comes with it")
    parser.add_argument("--out", type=Path, required=True, help="a folder")
    parser.add_argument("--motions", nargs="+", default=MOTIONS, help="asset names or paths")
    arguments = parser.parse_args(argv)
    if shutil.which("npm") is None:
        raise ValueError("npm is not on the path: install Node")
    for folder in ("garments", "motions"):
        (arguments.out / folder).mkdir(parents=True, exist_ok=True)
    names = arguments.model or trained.shipped()
    garments = {Path(name).resolve().name: loading.load(trained.find(name)) for name in names}
    if len(garments) < len(names):
        raise ValueError(f"two models have one name: {', '.join(names)}; rename one")
    first, *others = garments.values()
    if any(model.config.body != first.config.body for model in others):
        raise ValueError(f"{', '.join(garments)} are not all of one body: leave some out")
    clips = {Path(name).stem: storage.load_motion(name, first.names) for name in arguments.motions}
    if len(clips) < len(arguments.motions):
        raise ValueError(f"two motions have one name: {', '.join(arguments.motions)}; rename one")
    for name, timed in (clips | {name: model.config for name, model in garments.items()}).items():
        if abs(timed.fps - first.config.fps) > 1e-3:
            raise ValueError(f"{name} has {timed.fps} frames a second, {next(iter(garments))} {first.config.fps}")
    with progress_bar("exporting", len(garments)) as report:
        for index, (name, model) in enumerate(garments.items()):
            onnx.to_onnx(specialise.specialise(model), arguments.out / "garments" / f"{name}.onnx", int8=True)
            report(index + 1)
    about = body(storage.load_body(first.config.body), arguments.out / "body.bin")
    for name, clip in clips.items():
        place = clip.translation - clip.translation[:1] * [1, 0, 1]
        rows = np.concatenate([np.reshape(clip.rotations, (len(place), -1)), place], axis=1)
        rows.astype("<f4").tofile(arguments.out / "motions" / f"{name}.bin")
    about |= {"garments": list(garments), "motions": list(clips), "fps": first.config.fps}
    about |= {"skin": ray_cast.SKIN, "cloth": ray_cast.CLOTH}
    (arguments.out / "about.json").write_text(json.dumps(about))
    bundle(arguments.out)
    print(f"written to {arguments.out}: python -m http.server --directory {arguments.out}")


def body(rigged_body: Body, path: Path) -> dict:
    """Write the mean body for GPU skinning; return the places of its arrays in the file."""
    weights = np.asarray(rigged_body.weights)
    bones = np.argsort(-weights, axis=1, kind="stable")[:, :INFLUENCES]
    largest = np.take_along_axis(weights, bones, axis=1)
    arrays = {
        "vertices": np.asarray(rigged_body.vertices, "<f4"),
        "weights": (largest / largest.sum(axis=1, keepdims=True)).astype("<f4"),
        "faces": np.asarray(rigged_body.faces, "<u4"),
        "bones": bones.astype("<u2"),
    }
    path.write_bytes(b"".join(array.tobytes() for array in arrays.values()))
    ends = np.cumsum([0, *(array.nbytes for array in arrays.values())])
    places = {name: [int(at), array.size] for (name, array), at in zip(arrays.items(), ends, strict=False)}
    return {
        "body": places,
        "joints": np.asarray(rigged_body.joints).tolist(),
        "parents": [int(p) for p in rigged_body.parents],
    }


def bundle(out: Path) -> None:
    """Bundle the page's program with its libraries, by esbuild."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder) / "web"
        work.mkdir()
        for name in SOURCES:
            shutil.copy(HERE / name, work)
        shutil.copytree(HERE.parent / "deploy", Path(folder) / "deploy")
        _run(["npm", "ci", "--silent"], work)
        _run(
            ["npx", "esbuild", "main.js", "--bundle", "--format=esm", "--minify", f"--outfile={out.resolve()}/main.js"],
            work,
        )
        shutil.copy(HERE / "index.html", out)
        for path in (work / "node_modules" / "onnxruntime-web" / "dist").glob("ort-wasm-simd-threaded*"):
            shutil.copy(path, out)


def _run(command: list[str], folder: Path) -> None:
    done = subprocess.run(
        [shutil.which(command[0]), *command[1:]], cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise ValueError(f"{' '.join(command)} failed: {(done.stderr or done.stdout).strip()}")


if __name__ == "__main__":
    cli.run(main)
