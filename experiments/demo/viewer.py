"""Steer a character, dressed by Psi, live in the browser.

    python -m experiments.demo                                      # or: make demo
    python -m experiments.demo dress_fine --port 8080
    python -m experiments.demo runs/my_skirt --motions clips/*.motion.h5

Keys: I walks, then runs; K slows; J and L turn; space jumps, if there is a clip called jump. W, A, S, D, Q, E and the
arrows are the viewer's own, for its camera. The panel repeats the keys and chooses garment, body and cloth, wind for
garments with forces, and the methods beside Psi: plain skinning, Phi, and the solver, for which all others then wait.
"""

import argparse
import time
import webbrowser
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from clothjax import cli
from clothjax.body import motion_matching
from clothjax.evaluation import metrics
from clothjax.files import storage
from clothjax.material import scaled, unscaled
from clothjax.runtime import trained
from clothjax.types import Material, Motion
from experiments.demo.live import APART, METHODS, TURN, Show, finer, strain

CLIPS = tuple(f"{family}_{i}" for family in ("walk", "run", "arms", "jump", "twist", "dance") for i in range(4))
WANDER = ("walk", "run", "arms")  # families that are for going about; others are done when they are asked for
ACTION = 36  # frames, of what was asked for
BETAS = 4  # sliders
GRID = 2.0  # m, between the heavy lines of the floor
STRAINED, DEEP = 0.2, 0.005  # strain, and m inside the body, that are drawn red
COLOURS = {
    "body": (214, 178, 152), "psi": (58, 107, 184), "skinning": (150, 150, 150), "phi": (88, 150, 96),
    "solver": (196, 120, 60),
}  # fmt: skip


class Viewer:
    """A `Show` in a browser (viser), with its panel.

    The panel's callbacks run in other threads: they only set flags, and `run` acts on them.

    Args:
        server: viser's.
        garments: folders of runs or packed models, by name.
    """

    def __init__(self, server, show: Show, garments: dict[str, Path], garment: str):
        self.server, self.show, self.garments = server, show, garments
        self.meshes: dict = {}
        self._shown: tuple | None = None
        self._dress_anew = self._draw_anew = self._one_more = False
        server.scene.set_up_direction("+y")
        self.floor = server.scene.add_grid(
            "/floor", 40.0, 40.0, plane="xz", cell_size=0.5, section_size=GRID, infinite_grid=True
        )
        # the panel takes the right of the page
        server.initial_camera.position, server.initial_camera.look_at = (0.6, 1.4, 3.1), (0.4, 0.85, 0.0)
        gui, steering = server.gui, show.steering
        with gui.add_folder("Steer"):
            self._button("Faster", steering.faster, "I")
            self._button("Slower", steering.slower, "K")
            self._button("Left", lambda: steering.turn(TURN), "J")
            self._button("Right", lambda: steering.turn(-TURN), "L")
            for name in show.player.clips.families:
                if name not in show.player.wander:
                    key = "space" if name == "jump" else None
                    self._button(name.capitalize(), lambda name=name: steering.do(name, show.frames + ACTION), key)
        with gui.add_folder("Garment"):
            self.garment = gui.add_dropdown("Garment", tuple(garments), initial_value=garment)
            config = show.outfit.model.config
            self.fine = gui.add_checkbox("4 000 vertices", False, visible=finer(config) is not None)
            self.count = gui.add_slider("Characters", 1, 100, 1, 1)
            self.betas = [gui.add_slider(f"Body {i + 1}", -3.0, 3.0, 0.1, 0.0) for i in range(BETAS)]
            self.ranges = {name: getattr(config.material, f"{name}_range") for name in Material._fields}
            values = {name: float(scaled(getattr(config.material, name), self.ranges[name])) for name in self.ranges}
            self.material = {
                name: gui.add_slider(name.capitalize(), 0.0, 1.0, 0.01, round(share, 2))
                for name, share in values.items()
            }
            hint = "m/s^2 from the side; only garments with forces feel it, and only Psi"
            self.wind = gui.add_slider("Wind", 0.0, 20.0, 0.5, 0.0, hint=hint, visible=show.outfit.feels_wind)
            self.wind.on_update(lambda _: setattr(steering, "wind", float(self.wind.value)))
        with gui.add_folder("Show"):
            self.methods = {name: gui.add_checkbox(name.capitalize(), name == "psi") for name in METHODS}
            self.body = gui.add_checkbox("Body", True)
            self.wireframe = gui.add_checkbox("Wireframe", False)
            hint = f"strain: red from {STRAINED:.0%}; penetration: red from {1e3 * DEEP:.0f} mm inside the body"
            self.points = gui.add_dropdown("Points", ("none", "strain", "penetration"), hint=hint)
            self.follow = gui.add_checkbox("Follow", True)
            self.pause = gui.add_checkbox("Pause", False)
            self._button("Single step", lambda: setattr(self, "_one_more", True))
        self.text = gui.add_markdown("")
        for control in (self.garment, self.fine, self.count, *self.betas, *self.material.values()):
            control.on_update(lambda _: setattr(self, "_dress_anew", True))
        for control in (self.body, self.wireframe, self.points, self.follow):
            control.on_update(lambda _: setattr(self, "_draw_anew", True))

    def _button(self, label: str, act: Callable, hotkey: str | None = None) -> None:
        shown = label if hotkey is None else f"{label} ({hotkey})"
        self.server.gui.add_button(shown).on_click(lambda _: act())
        if hotkey:
            self.server.gui.add_command(label, hotkey=hotkey).on_trigger(lambda _: act())

    def run(self, frames: int | None = None) -> None:
        """Show frame after frame, at the clips' rate if possible, until the given number is reached."""
        done, due, shown_at = 0, time.perf_counter(), deque(maxlen=60)
        while frames is None or done < frames:
            if self._dress_anew:
                self._dress()
            if self.pause.value and not self._one_more:
                if self._draw_anew:
                    self._draw()
                time.sleep(0.02)
                due = time.perf_counter()
                continue
            self._one_more = False
            methods = tuple(name for name in METHODS if self.methods[name].value)
            if set(methods) - set(self.show.methods) - {"psi"}:
                self.text.content = "Compiling what stands beside Psi: up to a minute, the first time"
            self.show.methods = methods
            self._shown = self.show.frame()
            began = time.perf_counter()
            self._draw()
            done += 1
            shown_at.append(time.perf_counter())
            if done % 15 == 0:
                rate = (len(shown_at) - 1) / (shown_at[-1] - shown_at[0])
                psi, pose = (1e3 * self.show.seconds[name] for name in ("psi", "pose"))
                self.text.content = (
                    f"Psi {psi:.2f} ms a frame; pose and body {pose:.2f} ms; "
                    f"sending {1e3 * (shown_at[-1] - began):.2f} ms; {rate:.0f} frames a second"
                )
            due = max(due + 1.0 / self.show.player.clips.fps, time.perf_counter() - 0.1)
            time.sleep(max(0.0, due - time.perf_counter()))

    def _dress(self) -> None:
        """Dress by the panel's settings; a paused show advances one frame, so that the change is seen."""
        self._dress_anew, self._draw_anew, self._one_more = False, True, True
        betas = np.array([slider.value for slider in self.betas])
        material = Material(*(unscaled(self.material[name].value, self.ranges[name]) for name in Material._fields))
        run = self.garments[self.garment.value]
        self.show.dress(run, betas, material, int(self.count.value), self.fine.value)
        self.wind.visible = self.show.outfit.feels_wind
        self.fine.visible = finer(trained.configured(run)) is not None

    def _remove_meshes(self) -> None:
        self._draw_anew = False
        for mesh in self.meshes.values():
            mesh.remove()
        self.meshes.clear()

    def _draw(self) -> None:
        if self._draw_anew:  # other faces, or another look
            self._remove_meshes()
        if self._shown is None:
            return
        garments, bodies = self._shown
        others = [method for method in garments if method != "psi"]
        worn_by = {"psi": bodies[0]} | dict(zip(others, bodies[len(bodies) - len(others) :], strict=True))
        here = self.show.past[-1].translation * [1, 0, 1] if self.follow.value else np.zeros(3)
        here = here + [0.65 * APART * len(others), 0, 0]  # all in what the panel leaves free
        drawn = set()
        with self.server.atomic():
            self.floor.position = tuple(-(here % GRID))
            for method, crowd in garments.items():
                faces, rest = self.show.outfit.mesh(method)
                if others:
                    drawn.add(self._label(method, worn_by[method] - here))
                for i, vertices in enumerate(crowd):
                    drawn.add(self._mesh(f"/{method}/{i}", vertices - here, faces, COLOURS[method]))
                if self.points.value == "strain":
                    drawn.add(
                        self._points(f"/{method}/strain", crowd[0] - here, strain(crowd[0], rest, faces) / STRAINED)
                    )
                elif self.points.value == "penetration":
                    depth, _ = metrics.penetration(crowd[0], worn_by[method], self.show.body_faces)
                    drawn.add(self._points(f"/{method}/penetration", crowd[0] - here, depth / DEEP))
            for i, vertices in enumerate(bodies if self.body.value else []):
                drawn.add(self._mesh(f"/body/{i}", vertices - here, self.show.body_faces, COLOURS["body"]))
            for name in set(self.meshes) - drawn:
                self.meshes.pop(name).remove()

    def _mesh(self, name: str, vertices: np.ndarray, faces: np.ndarray, colour: tuple[int, int, int]) -> str:
        vertices = vertices.astype(np.float32)
        if name in self.meshes:
            self.meshes[name].vertices = vertices
        else:
            wires = self.wireframe.value and not name.startswith("/body")
            self.meshes[name] = self.server.scene.add_mesh_simple(
                name, vertices, faces, color=colour, side="double", wireframe=wires
            )
        return name

    def _label(self, method: str, body: np.ndarray) -> str:
        """Draw the name of a method over its head."""
        name, place = f"/{method}/name", (body[:, 0].mean(), body[:, 1].max() + 0.1, body[:, 2].mean())
        if name in self.meshes:
            self.meshes[name].position = place
        else:
            self.meshes[name] = self.server.scene.add_label(
                name, method.capitalize(), position=place, anchor="bottom-center"
            )
        return name

    def _points(self, name: str, vertices: np.ndarray, share: np.ndarray) -> str:
        share = np.clip(share, 0.0, 1.0)[:, None]
        colours = (255 * (share * [0.9, 0.1, 0.1] + (1 - share) * [0.1, 0.3, 0.9])).astype(np.uint8)
        vertices = vertices.astype(np.float32)
        if name in self.meshes:
            self.meshes[name].points, self.meshes[name].colors = vertices, colours
        else:
            self.meshes[name] = self.server.scene.add_point_cloud(name, vertices, colours, point_size=0.008)
        return name


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.demo", __doc__)
    cli.model_argument(parser, nargs="?", default="skirt", about="; default: the skirt")
    parser.add_argument("--motions", type=Path, nargs="+", help="clips to go about by; default: the embedded ones")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8080)
    parser.add_argument("--no-browser", action="store_true", help="do not open the page")
    parser.add_argument("--frames", type=int, help="so many, then stop")
    arguments = parser.parse_args(argv)
    viewer = start(arguments)
    try:
        viewer.run(arguments.frames)
    except KeyboardInterrupt:
        print("stopped")
    finally:
        viewer.server.stop()


def start(arguments: argparse.Namespace) -> Viewer:
    """Start a viewer that waits to be run; the browser fetches its page meanwhile.

    Raises:
        ImportError: if viser is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise ImportError("the demo needs viser: pip install clothjax[demo]") from error
    server = viser.ViserServer(arguments.host, arguments.port, label="clothjax", verbose=False)
    address = f"http://{arguments.host}:{server.get_port()}"
    print(f"open {address} in a browser; stop with Ctrl-C", flush=True)
    if not arguments.no_browser:
        webbrowser.open(address)
    garments, garment = {name: trained.find(name) for name in trained.shipped()}, arguments.model
    if garment not in garments:  # a folder stands alone: its body may be another
        folder = trained.find(garment)
        garments, garment = {folder.name: folder}, folder.name
    config = trained.configured(garments[garment])
    body, names = storage.load_rig(config.body)
    motions = clips(arguments.motions, names)
    library = motion_matching.library(motions, np.asarray(body.joints), body.parents, names)
    wander = tuple(name for name in library.families if name in WANDER) or library.families
    return Viewer(server, Show(library, wander, garments[garment]), garments, garment)


def clips(paths: list[Path] | None, names: tuple[str, ...]) -> dict[str, Motion]:
    """Load clips by their names; the embedded ones for None.

    Raises:
        ValueError: if two files have one name.
    """
    if paths is None:
        return {name: storage.load_motion(name, names) for name in CLIPS}
    loaded: dict[str, Motion] = {}
    for path in paths:
        name = path.name.removesuffix(".h5").removesuffix(".motion")
        if name in loaded:
            raise ValueError(f"{path}: another clip is called {name} too: rename one")
        loaded[name] = storage.load_motion(path, names)
    return loaded
