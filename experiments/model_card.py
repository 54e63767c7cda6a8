"""Write the card of each garment that comes with the library: `clothjax/assets/models/<name>/README.md`.

    python -m experiments.model_card

A card says what the garment was trained on, what it is good for, how good it is and where it is worst. All of it is
from the configuration and the report beside it. `experiments.ship` writes the card too.
"""

import json
from pathlib import Path

from clothjax import cli
from clothjax.config import Config
from clothjax.evaluation.report import CHARACTERS_FRAMES
from clothjax.files import configuration, storage
from clothjax.runtime import trained
from clothjax.simulation import assembly

CARD = "README.md"
MEASURES = {
    "energy_gap": "energy gap: 0 the solver, 1 plain skinning",
    "hold_gap": "hold gap: 0 the solver, 1 cloth that keeps its last shape",
    "hold_gap_median": "its median over frames",
    "step_error_mm": "distance of a step to the solver's, mm",
    "swing_ratio": "swing over the solver's",
    "swing_correlation": "correlation of the swing with the solver's",
    "wrinkle_ratio": "wrinkles over the solver's",
    "edge_strain_ratio": "edge strain over the solver's",
    "jitter": "jitter over the solver's",
    "penetration_percent": "vertices inside the body, %",
    "penetration_percent_max": "... in the worst frame",
}
METHODS = {"lbs": "skinning", "phi": "Phi", "psi": "Psi"}


def main(argv: list[str]) -> None:
    cli.Parser("experiments.model_card", __doc__).parse_args(argv)
    for name in trained.shipped():
        print(write(trained.MODELS / name))


def write(folder: Path) -> Path:
    """Write the card of a packed model into its folder; return the file."""
    (folder / CARD).write_text(card(folder))
    return folder / CARD


def card(folder: Path) -> str:
    """Return the card of a packed model, in Markdown."""
    config = configuration.load(Config, folder / trained.CONFIG, stored=True)
    report = json.loads((folder / trained.REPORT).read_text())
    return (
        "\n\n".join(
            [f"# {folder.name}", *_about(config, folder.name, report), *_figures(report), *_worst(report)]
            + _training(folder, report)
        )
        + "\n"
    )


def _about(config: Config, name: str, report: dict) -> list[str]:
    """Return the paragraphs on what the garment is, what it was trained on, what it is for, and its known faults."""
    garment = storage.load_garment(config.garment, storage.load_body(config.body))
    reads = "the forces on the cloth" if config.stage2.forces else "the pose"
    felt = f" A mesh of it with fewer vertices, `{config.model.felt}`, feels the forces." if config.model.felt else ""
    motions = assembly.training_motions(config)
    files, most = [motion for motion in motions if "/" in motion], config.stage1.betas
    seen = [
        "- Physics alone: the energy of the cloth is the loss, and no data is needed.",
        f"- {len(motions)} motions, {len(files)} of them from files that do not come with the library.",
        f"- Bodies with betas of -{most:g} to {most:g} standard deviations.",
        f"- Cloth: {_cloth(config)}.",
    ]
    suits = [
        f"- Characters on the skeleton of `{config.body}`, in the bodies and cloth above, at {config.fps:.0f} frames a "
        "second.",
        "- Wind, and gravity from any side."
        if config.stage2.forces
        else "- Crowds: a frame takes a fraction of the time that forces take.",
    ]
    if config.model.felt:
        suits.append(f'- Levels of detail: `cj.load("{name}", coarse=True)` has the same states.')
    faults = ["- It touches the body, and nothing else."]
    if not config.physics.self_contact:
        faults.append("- Layers of it pass through each other.")
    if not config.stage2.forces:
        faults.append("- It feels no wind.")
    held = [motion.removesuffix(".motion") for motion, each in report["motions"].items() if _hold_gap(each) > 1.0]
    if held:
        faults.append(f"- Cloth that keeps its last shape has less energy on {', '.join(f'`{it}`' for it in held)}.")
    return [
        f"`{config.garment}`, {len(garment.vertices)} vertices. Psi reads {reads}.{felt}",
        "## Trained on",
        "\n".join(seen),
        "## Good for",
        "\n".join(suits),
        "## Known faults",
        "\n".join(faults),
    ]


def _cloth(config: Config) -> str:
    """Return the constants of the cloth of training: their ranges, if it was drawn."""
    cloth = config.material
    units = {"density": "kg/m^2", "mu": "Pa", "lam": "Pa", "bending": "J"}
    if not cloth.sample:
        return ", ".join(f"{name} {getattr(cloth, name):g} {unit}" for name, unit in units.items())
    ranges = {name: getattr(cloth, f"{name}_range") for name in units}
    return ", ".join(f"{name} {ranges[name].low:g} to {ranges[name].high:g} {unit}" for name, unit in units.items())


def _figures(report: dict) -> list[str]:
    """Return the section of measures, means over motions."""
    methods = [method for method in METHODS if method in report]
    rows = [f"| | {' | '.join(METHODS[method] for method in methods)} |", "|---" * (len(methods) + 1) + "|"]
    for key, meaning in MEASURES.items():
        rows.append(f"| {meaning} | {' | '.join(_figure(report[method].get(key)) for method in methods)} |")
    names = ", ".join(f"`{name.removesuffix('.motion')}`" for name in report["motions"])
    earlier = ", ".join(f"{METHODS[method]} at {commit}" for method, commit in report.get("commits", {}).items())
    commit = report.get("commit", "unknown") + (f" ({earlier})" if earlier else "")
    return [
        "## How good it is",
        f"Means over {names}, on a body that was not trained on, at commit {commit}.",
        "\n".join(rows),
    ]


def _worst(report: dict) -> list[str]:
    """Return the section on the motion, the character and the push on which Psi is worst."""
    rows = ["| | worst | hold gap there | mean |", "|---|---|---|---|"]
    groups = {"motion": "motions", "character": "wearers", "push": "pushed"}
    for kind, group in groups.items():
        gaps = {name: _hold_gap(each) for name, each in report.get(group, {}).items()}
        if gaps:
            name = max(gaps, key=gaps.__getitem__)
            shown = {"none": "no push"}.get(name, name.removesuffix(".motion"))
            rows.append(f"| {kind} | {shown} | {gaps[name]:.2f} | {sum(gaps.values()) / len(gaps):.2f} |")
    clip = next(iter(report["motions"])).removesuffix(".motion")
    kinds = [name for name, group in (("characters", "wearers"), ("pushes", "pushed")) if report.get(group)]
    about = f"{' and '.join(kinds).capitalize()} are of the first {CHARACTERS_FRAMES} frames of `{clip}`."
    if not kinds:
        about = "Other characters, and pushes, were not measured."
    return ["## Where it is worst", about, "\n".join(rows)]


def _training(folder: Path, report: dict) -> list[str]:
    """Return the section on how to train it again, of what the report knows."""
    megabytes = (folder / trained.WEIGHTS).stat().st_size / 1e6
    facts = [f"The weights are {megabytes:.1f} MB."]
    if "hours" in report:
        facts.insert(0, f"Training took {report['hours']:.1f} hours.")
    if "made" in report:
        facts.insert(0, report["made"])
    command = [f"```sh\n{report['command']}\n```"] if "command" in report else []
    return ["## To train it again", *command, " ".join(facts)]


def _hold_gap(measured: dict) -> float:
    return measured.get("psi", measured)["hold_gap"]


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"


if __name__ == "__main__":
    cli.run(main)
