"""The demo: a character that is steered wears what the library makes of its poses, and a browser shows it."""

import argparse
import re
import shutil
import subprocess
import sys
import threading
import time

import jax.numpy as jnp
import numpy as np
import pytest

import clothjax as cj
from clothjax import motion_matching, storage
from clothjax.types import Material, Pose
from experiments import demo, live

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def clips():
    body, names = storage.load_body("body"), storage.joint_names("body")
    motions = {name: storage.load_motion(name, names) for name in ("walk_0", "run_0", "arms_0", "jump_0")}
    return motion_matching.library(motions, np.asarray(body.joints), body.parents, names)


def test_what_is_shown_is_psi_on_the_pose_of_the_player(clips):
    show = live.Show(clips, ("walk", "run", "arms"), "skirt")
    model, state = cj.load("skirt"), None
    show.steering.faster()
    for _ in range(40):
        garments, bodies = show.frame()
        pose = show.past[-1]
        pose = Pose(jnp.asarray(pose.rotations), jnp.asarray(pose.translation))
        state = cj.initial_state(model, pose) if state is None else state
        state, vertices = cj.step(model, state, pose)
        assert list(garments) == ["psi"] and len(bodies) == 1
        np.testing.assert_allclose(garments["psi"][0], vertices, atol=1e-4)
    assert pose.translation[2] > 0.5  # it walked
    waist = garments["psi"][0].mean(axis=0) - bodies[0].mean(axis=0)
    assert np.linalg.norm(waist[[0, 2]]) < 0.2


@pytest.mark.slow
def test_stages_beside_each_other_wear_the_same_skirt(clips):
    show = live.Show(clips, ("walk", "run", "arms"), "skirt")
    show.stages = live.STAGES
    show.steering.faster()
    for _ in range(6):
        garments, bodies = show.frame()
    assert tuple(garments) == live.STAGES and len(bodies) == len(live.STAGES)
    skinned = garments["skinning"][0] - [live.APART, 0, 0]
    for i, stage in enumerate(live.STAGES):
        apart = garments[stage][0] - [i * live.APART, 0, 0] - skinned
        distance = np.linalg.norm(apart, axis=-1)
        assert np.isfinite(distance).all() and distance.max() < 0.2
        assert stage == "skinning" or distance.max() > 1e-3
    assert show.wardrobe.other_faces.shape == show.wardrobe.faces.shape


def test_a_crowd_wears_what_is_chosen(clips):
    show = live.Show(clips, ("walk", "run", "arms"), "skirt")
    show.dress("tshirt", np.linspace(-1, 1, 10), Material(0.2, 3e4, 2e4, 1e-4), count=6)
    show.steering.faster()
    for _ in range(70):
        garments, bodies = show.frame()
    assert garments["psi"].shape == (6, 1016, 3) and len(bodies) == live.BODIES
    centres = garments["psi"].mean(axis=1)
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)[~np.eye(6, dtype=bool)]
    assert apart.min() > 0.5
    # each is where the one before it was, in another place
    garments_later = [show.frame()[0]["psi"] for _ in range(live.BEHIND)][-1]
    np.testing.assert_allclose(garments_later[1].mean(axis=0) - centres[0], [-1.4, 0, -1.4], atol=0.1)
    show.dress("tshirt", np.zeros(10), None, count=1, fine=True)
    assert show.frame()[0]["psi"].shape == (1, 4086, 3)


@pytest.mark.parametrize("frames", [300, pytest.param(18000, marks=pytest.mark.slow, id="ten_minutes")])
def test_random_steering_leaves_nothing_infinite(clips, frames):
    show, random = live.Show(clips, ("walk", "run", "arms"), "dress"), np.random.default_rng(0)
    steer = show.steering
    turns = (lambda: steer.turn(0.8), lambda: steer.turn(-2.0))
    acts = (steer.faster, steer.slower, *turns, lambda: steer.do("jump", 1e9))
    for t in range(frames):
        if t % 12 == 0:
            steer.do(None, 0.0)
            random.choice(acts)()
        garments, bodies = show.frame()
        assert np.isfinite(garments["psi"]).all() and np.isfinite(bodies[0]).all()
        height = garments["psi"][0][:, 1]
        assert height.min() > bodies[0][:, 1].min() - 0.3 and height.max() < bodies[0][:, 1].max() + 0.1


def test_strain_is_that_of_the_edges():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    edges = np.array([[0, 1], [1, 2]])
    rest = np.ones(2)
    np.testing.assert_allclose(live.strain(square * [1.1, 1.0, 1.0], edges, rest), [0.1, 0.1, 0.0], atol=1e-12)
    np.testing.assert_allclose(live.strain(square * [1.1, 0.7, 1.0], edges, rest), [0.1, 0.3, 0.3], atol=1e-12)


@pytest.fixture
def viewer():
    pytest.importorskip("viser")
    given = argparse.Namespace(garment="skirt", run=None, motions=None, host="127.0.0.1", port=8123)
    viewer = demo.start(given)
    yield viewer
    viewer.server.stop()


def test_the_panel_reaches_what_is_shown(viewer):
    viewer.run(20)
    assert set(viewer.meshes) == {"/psi/0", "/body/0"} and "frames a second" in viewer.text.content
    before = np.array(viewer.meshes["/psi/0"].vertices)
    viewer.betas[0].value = 2.0
    viewer._dress()
    viewer.run(5)
    assert np.abs(np.array(viewer.meshes["/psi/0"].vertices) - before).max() > 0.01
    viewer.strain.value = viewer.stages["skinning"].value = True
    viewer.body.value = False
    viewer.run(2)
    assert set(viewer.meshes) == {"/psi/0", "/psi/strain", "/skinning/0", "/skinning/strain"}
    viewer.pause.value = True
    frames = viewer.show.frames
    viewer.single.set()
    viewer.run(1)
    assert viewer.show.frames == frames + 1
    assert demo._within(viewer.ranges["mu"], 0.5) == pytest.approx(np.sqrt(15909.0 * 63636.0))
    assert demo._within(viewer.ranges["density"], 1.0) == pytest.approx(0.7)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_browser_steers_and_sees_the_garment_move(tmp_path):
    """From the command to a picture, keys and a slider; the rate of garments with the viewer running."""
    playwright = pytest.importorskip("playwright.sync_api")
    began = time.perf_counter()
    command = [sys.executable, "-m", "experiments.demo", "--port", "8124"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process, playwright.sync_playwright() as tool:
        try:
            watchdog = threading.Timer(120, process.kill)
            watchdog.start()
            address = next(line for line in process.stdout if line.startswith("open http")).split()[1]
            graphics = ["--use-gl=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
            browser = tool.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *graphics])
            page = browser.new_page(viewport={"width": 900, "height": 700})
            wrong = []
            page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
            page.goto(address)
            page.get_by_text("frames a second").wait_for(timeout=30000)
            print(f"interactive {time.perf_counter() - began:.1f} s after the command")
            pictures = [page.screenshot(path=tmp_path / "0.png")]
            page.keyboard.press("ArrowUp")
            time.sleep(3)
            pictures.append(page.screenshot(path=tmp_path / "1.png"))
            page.keyboard.press("Space")
            time.sleep(0.8)
            pictures.append(page.screenshot(path=tmp_path / "2.png"))
            field = page.locator("//*[text()='Body 1']/following::input[not(@type='hidden')][1]")
            field.fill("2.5")
            field.press("Enter")
            time.sleep(4)
            pictures.append(page.screenshot(path=tmp_path / "3.png"))
            assert len(set(pictures)) == 4 and not wrong
            rate = int(re.search(r"(\d+) frames a second", page.inner_text("body"))[1])
            print(f"{rate} frames a second")
            assert rate >= 20
            browser.close()
        finally:
            watchdog.cancel()
            process.kill()
