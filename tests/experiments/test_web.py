"""The page that plays garments in the browser alone shows what Python shows."""

import functools
import http.server
import shutil
import threading

import jax.numpy as jnp
import numpy as np
import pytest

import clothjax as cj
from clothjax.body import skinning
from clothjax.export import onnx
from clothjax.files import storage
from clothjax.render import ray_cast
from clothjax.render.ray_cast import Surface
from clothjax.runtime import specialise
from experiments.web import build

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
GRAPHICS = ["--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SIZE = (600, 800)


def test_the_body_for_the_gpu_is_the_body(tmp_path):
    whole = storage.load_body("body")
    about = build.body(whole, tmp_path / "body.bin")
    data = (tmp_path / "body.bin").read_bytes()

    def part(name, kind):
        at, count = about["body"][name]
        return np.frombuffer(data, kind, count, at)

    np.testing.assert_allclose(part("vertices", "<f4").reshape(-1, 3), whole.vertices, atol=1e-6)
    np.testing.assert_array_equal(part("faces", "<u4").reshape(-1, 3), whole.faces)
    weights, bones = part("weights", "<f4").reshape(-1, 4), part("bones", "<u2").reshape(-1, 4)
    dense = np.zeros(whole.weights.shape)
    np.put_along_axis(dense, bones.astype(int), weights, axis=1)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
    assert np.abs(dense - whole.weights).max() < 0.1 and np.abs(dense - whole.weights).mean() < 1e-3


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A browser, and the address of the page."""
    if CHROMIUM is None or shutil.which("npm") is None:
        pytest.skip("needs Chromium and Node")
    playwright = pytest.importorskip("playwright.sync_api")
    site = tmp_path_factory.mktemp("site")
    build.main(["--out", str(site)])
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=site))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with playwright.sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=CHROMIUM, args=GRAPHICS)
        shown = browser.new_page(viewport=dict(zip(("width", "height"), SIZE)))
        wrong = []
        shown.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        shown.on("pageerror", lambda error: wrong.append(str(error)))
        yield shown, f"http://127.0.0.1:{server.server_port}/", wrong, site
        browser.close()
    server.shutdown()


@pytest.mark.slow
def test_it_animates_fast_enough_without_an_error(page):
    shown, address, wrong, _ = page
    for garment in ("tshirt", "skirt"):
        shown.goto(f"{address}?fast&garment={garment}&motion=dance_3")
        shown.wait_for_function("window.clothjax && clothjax.steps >= 300", timeout=120000)
        told = shown.evaluate("clothjax")
        print(f"{garment}: {told['milliseconds']:.2f} ms a frame of garment, WebAssembly, one thread")
        assert told["finite"] and told["milliseconds"] < 1000 / 60
        shown.select_option("#garment", "tshirt_pose")
        shown.select_option("#motion", "jump_3")
        shown.wait_for_function("clothjax.steps >= 340", timeout=120000)
        assert shown.evaluate("clothjax.finite")
    assert not wrong


@pytest.mark.slow
@pytest.mark.parametrize("garment, motion, frame", [("skirt", "walk_3", 40), ("tshirt", "dance_3", 60)])
def test_it_shows_what_python_shows(page, garment, motion, frame, tmp_path):
    shown, address, wrong, site = page
    model, whole = specialise.specialise(cj.load(garment)), storage.load_body("body")
    clip = storage.load_motion(motion, model.names)
    place = (clip.translation - clip.translation[:1] * [1, 0, 1]).astype(np.float32)
    clip = clip._replace(translation=place)
    cloth = onnx.run_onnx(site / "garments" / f"{garment}.onnx", model, clip)[frame]
    pose = cj.Pose(jnp.asarray(clip.rotations[frame], jnp.float32), jnp.asarray(place[frame]))
    skin = np.asarray(skinning.pose_body(whole, jnp.asarray(whole.vertices), jnp.asarray(whole.joints), pose))
    camera = ray_cast.camera_for(skin)
    faces = np.asarray(model.faces)
    surfaces = [Surface(skin, whole.faces, ray_cast.SKIN), Surface(cloth, faces)]
    expected = ray_cast.render(surfaces, camera, SIZE)
    where = ",".join(f"{x:.6f}" for x in (*camera.eye, *camera.target, camera.height))
    shown.goto(f"{address}?fast&garment={garment}&motion={motion}&frames={frame + 1}&camera={where}")
    shown.wait_for_function(f"window.clothjax && clothjax.steps === {frame + 1}", timeout=60000)
    shown.evaluate("document.querySelector('form').hidden = true")
    shown.wait_for_timeout(500)
    shown.screenshot(path=tmp_path / "page.png")
    from PIL import Image

    Image.fromarray(expected).save(tmp_path / "python.png")
    with Image.open(tmp_path / "page.png") as page:
        found = np.asarray(page.convert("RGB"))

    def cloth_and_skin(picture):
        red, _, blue = np.moveaxis(picture.astype(float), -1, 0)  # hues, for only one of the two has shadows
        return blue > 1.3 * red, red > 1.1 * blue

    for a, b in zip(cloth_and_skin(found), cloth_and_skin(expected), strict=True):
        assert b.sum() > 2000
        assert (a & b).sum() > 0.95 * (a | b).sum()
    assert not wrong
