"""A character that you steer, dressed by Psi, live in the browser.

    python -m experiments.demo                                      # or: make demo
    python -m experiments.demo --garment dress --port 8080
    python -m experiments.demo --run runs/my_skirt --motions clips/*.motion.h5

Arrow keys: up walks, then runs; down slows; left and right turn; space jumps. The panel has the same, the garment, body
and cloth, and what stands beside Psi: plain skinning, its teacher Phi, and the solver, for which all others then wait.
"""

import argparse
import sys
import time
from collections import deque
from pathlib import Path
from threading import Event

import numpy as np

from clothjax import motion_matching, storage, trained
from clothjax.config import Range
from clothjax.features import scaled
from clothjax.types import Material
from experiments.live import STAGES, TURN, Show, strain
from experiments.session import fail_clearly, setup

CLIPS = tuple(f"{family}_{i}" for family in ("walk", "run", "arms", "jump", "twist", "dance") for i in range(4))
WANDER = ("walk", "run", "arms")
ACTION = 1.2  # s, of a jump that was asked for by a key
BETAS = 4  # sliders
FLAG = 2.0  # m, between the heavy lines of the floor


class Viewer:
    """A `Show` in a browser (viser), with its panel."""

    def __init__(self, show: Show, garments: dict[str, str | Path], garment: str, host: str, port: int):
        import viser

        self.show, self.garments = show, garments
        self.server = server = viser.ViserServer(host, port, label="clothjax", verbose=False)
        self.stop, self.single = Event(), Event()
        server.scene.set_up_direction("+y")
        self.floor = server.scene.add_grid(
            "/floor", 40.0, 40.0, plane="xz", cell_size=0.5, section_size=FLAG, infinite_grid=True
        )
        server.initial_camera.position, server.initial_camera.look_at = (1.5, 1.5, 2.7), (0.0, 0.9, 0.0)
        self.meshes: dict = {}
        self.stale = False
        gui, steering = server.gui, show.steering

        def button(label: str, act, hotkey: str | None = None, hint: str | None = None) -> None:
            gui.add_button(label, hint=hint).on_click(lambda _: act())
            if hotkey:
                gui.add_command(label, hotkey=hotkey).on_trigger(lambda _: act())

        with gui.add_folder("Steer"):
            button("Faster", steering.faster, "arrowup", "arrow up")
            button("Slower", steering.slower, "arrowdown", "arrow down")
            button("Left", lambda: steering.turn(TURN), "arrowleft", "arrow left")
            button("Right", lambda: steering.turn(-TURN), "arrowright", "arrow right")
            self.actions = [name for name in show.clips.families if name not in show.player.wander]
            for name in self.actions:
                button(name.capitalize(), lambda name=name: self._do(name), "space" if name == "jump" else None)
        with gui.add_folder("Garment"):
            self.garment = gui.add_dropdown("Garment", tuple(garments), initial_value=garment)
            self.detail = gui.add_dropdown("Vertices", ("1 000", "4 000"))
            self.count = gui.add_slider("Characters", 1, 100, 1, 1)
            self.betas = [gui.add_slider(f"Body {i + 1}", -3.0, 3.0, 0.1, 0.0) for i in range(BETAS)]
            cloth = show.wardrobe.model.config.material
            self.ranges = {name: getattr(cloth, f"{name}_range") for name in Material._fields}
            self.material = {
                name: gui.add_slider(
                    name.capitalize(), 0.0, 1.0, 0.01, round(float(scaled(getattr(cloth, name), between)), 2)
                )
                for name, between in self.ranges.items()
            }
        with gui.add_folder("Show"):
            self.stages = {name: gui.add_checkbox(name.capitalize(), name == "psi") for name in STAGES}
            self.body = gui.add_checkbox("Body", True)
            self.wireframe = gui.add_checkbox("Wireframe", False)
            self.strain = gui.add_checkbox("Strain", False, hint="points: blue at rest, red from 20 %")
            self.follow = gui.add_checkbox("Follow", True)
            self.pause = gui.add_checkbox("Pause", False)
            button("Single step", self.single.set)
        self.text = gui.add_markdown("")
        for control in (self.garment, self.detail, self.count, *self.betas, *self.material.values()):
            control.on_update(lambda _: setattr(self, "stale", True))
        self.wireframe.on_update(lambda _: self._clear())

    def _do(self, family: str) -> None:
        self.show.steering.do(family, self.show.frames / self.show.clips.fps + ACTION)

    def _clear(self) -> None:
        for mesh in self.meshes.values():
            mesh.remove()
        self.meshes.clear()

    def _dress(self) -> None:
        self.stale = False
        betas = np.zeros(10)
        betas[:BETAS] = [slider.value for slider in self.betas]
        material = Material(*(_within(self.ranges[name], slider.value) for name, slider in self.material.items()))
        fine = self.detail.value != "1 000"
        self.show.dress(self.garments[self.garment.value], betas, material, int(self.count.value), fine)
        self._clear()

    def run(self, frames: int | None = None) -> None:
        """Shows frame after frame, at the clips' rate where it can."""
        done, due, shown_at = 0, time.perf_counter(), deque(maxlen=60)
        while not self.stop.is_set() and (frames is None or done < frames):
            if self.stale:
                self._dress()
            if self.pause.value and not self.single.is_set():
                time.sleep(0.02)
                due = time.perf_counter()
                continue
            self.single.clear()
            self.show.stages = tuple(name for name in STAGES if self.stages[name].value)
            garments, bodies = self.show.frame()
            began = time.perf_counter()
            self._draw(garments, bodies)
            done += 1
            shown_at.append(time.perf_counter())
            if done % 15 == 0:
                rate = (len(shown_at) - 1) / max(shown_at[-1] - shown_at[0], 1e-9)
                milliseconds = {name: 1e3 * seconds for name, seconds in self.show.seconds.items()}
                self.text.content = (
                    f"Psi {milliseconds['garment']:.2f} ms a frame; pose and body {milliseconds['rest']:.2f} ms; "
                    f"sending {1e3 * (shown_at[-1] - began):.2f} ms; {rate:.0f} frames a second"
                )
            due = max(due + 1.0 / self.show.clips.fps, time.perf_counter() - 0.1)
            time.sleep(max(0.0, due - time.perf_counter()))

    def _draw(self, garments: dict[str, np.ndarray], bodies: list[np.ndarray]) -> None:
        wardrobe = self.show.wardrobe
        here = self.show.past[-1].translation * [1, 0, 1] if self.follow.value else np.zeros(3)
        with self.server.atomic():
            self.floor.position = tuple(-(here % FLAG))
            kept = set()
            for stage, crowd in garments.items():
                faces = wardrobe.faces if stage == "psi" else wardrobe.other_faces
                for i, vertices in enumerate(crowd):
                    kept.add(name := f"/{stage}/{i}")
                    self._mesh(name, vertices - here, faces, COLOURS[stage])
                    if self.strain.value and i == 0:
                        kept.add(name := f"/{stage}/strain")
                        self._strain(name, vertices - here, faces)
            for i, vertices in enumerate(bodies if self.body.value else []):
                kept.add(name := f"/body/{i}")
                self._mesh(name, vertices - here, self.show.body_faces, COLOURS["body"])
            for name in set(self.meshes) - kept:
                self.meshes.pop(name).remove()

    def _mesh(self, name: str, vertices: np.ndarray, faces: np.ndarray, colour: tuple[int, int, int]) -> None:
        vertices = vertices.astype(np.float32)
        if name in self.meshes:
            self.meshes[name].vertices = vertices
            return
        body = name.startswith("/body")
        self.meshes[name] = self.server.scene.add_mesh_simple(
            name, vertices, faces, color=colour, side="double", wireframe=self.wireframe.value and not body
        )

    def _strain(self, name: str, vertices: np.ndarray, faces: np.ndarray) -> None:
        sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        edges = np.unique(np.sort(sides, axis=1), axis=0)
        template = np.asarray(self.show.wardrobe.model.wearer.template).T
        rest = np.linalg.norm(template[edges[:, 0]] - template[edges[:, 1]], axis=1)
        share = np.clip(strain(vertices, edges, rest) / 0.2, 0.0, 1.0)[:, None]
        colours = (255 * (share * [0.9, 0.1, 0.1] + (1 - share) * [0.1, 0.3, 0.9])).astype(np.uint8)
        self.meshes[name] = self.server.scene.add_point_cloud(name, vertices, colours, point_size=0.008)


COLOURS = {
    "body": (214, 178, 152), "psi": (58, 107, 184), "skinning": (150, 150, 150), "phi": (88, 150, 96),
    "solver": (196, 120, 60),
}  # fmt: skip


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--garment", default="skirt", choices=trained.shipped())
    parser.add_argument("--run", type=Path, default=None, help="a folder of your own, instead of those of the library")
    parser.add_argument(
        "--motions", type=Path, nargs="+", default=None, help="clips to walk by; default: embedded ones"
    )
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8080)
    parser.add_argument("--frames", type=int, default=None, help="so many, then stop")
    arguments = parser.parse_args(argv)
    viewer = start(arguments)
    print(f"open http://{arguments.host}:{viewer.server.get_port()} in a browser; stop with Ctrl-C", flush=True)
    try:
        viewer.run(arguments.frames)
    except KeyboardInterrupt:
        print("stopped")
    finally:
        viewer.server.stop()


def start(arguments: argparse.Namespace) -> Viewer:
    """A viewer that waits to be run."""
    garments: dict[str, str | Path] = {name: name for name in trained.shipped()}
    garment = arguments.garment
    if arguments.run is not None:
        garment = arguments.run.name
        garments = {garment: arguments.run}
    config = trained.psi(trained.folder(garment) if arguments.run is None else arguments.run)[0]
    body, names = storage.load_body(config.body), storage.joint_names(config.body)
    if arguments.motions is None:
        motions, wander = {name: storage.load_motion(name, names) for name in CLIPS}, WANDER
    else:
        motions, wander = (
            {path.name.split(".")[0]: storage.load_motion(path, names) for path in arguments.motions},
            None,
        )
    clips = motion_matching.library(motions, np.asarray(body.joints), body.parents, names)
    show = Show(clips, wander or clips.families, garments[garment])
    return Viewer(show, garments, garment, arguments.host, arguments.port)


def _within(between: Range, share: float) -> float:
    """The inverse of `features.scaled`."""
    if between.log:
        return between.low * (between.high / between.low) ** share
    return between.low + share * (between.high - between.low)


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
