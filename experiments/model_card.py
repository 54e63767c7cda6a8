"""Write the card of each garment that comes with the library: `clothjax/assets/models/<name>/README.md`.

    python -m experiments.model_card

A card says what the garment was trained on, what it is good for, how good it is and where it is worst. All of it is
from the configuration and the report beside it. `experiments.ship` writes the card too.
"""

import json
from pathlib import Path

from clothjax import cli
from clothjax.config import Config, Range
from clothjax.files import configuration, storage
from clothjax.runtime import trained

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
    megabytes = (folder / trained.WEIGHTS).stat().st_size / 1e6
    sections = [f"# {folder.name}", *_about(config, folder.name), *_figures(report), *_worst(report)]
    sections += ["## Made by", f"```sh\n{report['command']}\n```"]
    sections.append(
        f"Seed {report['seed']}, {report['hours']:.1f} hours, measured at commit {report['commit']}. "
        f"The weights are {megabytes:.1f} MB. How it came about is in `experiments/RESULTS.md` of the project."
    )
    return "\n\n".join(sections) + "\n"


def _about(config: Config, name: str) -> list[str]:
    """Return the paragraphs on what the garment is, what it was trained on and what it is for."""
    garment = storage.load_garment(config.garment, storage.load_body(config.body))
    cloth, takes = config.material, [motion for motion in config.motions if "/" in motion]
    felt = f" A mesh of it with fewer vertices, `{config.model.felt}`, feels the forces." if config.model.felt else ""
    reads = "the forces on the cloth" if config.stage2.forces else "the pose"
    ranges = {
        "density": (cloth.density_range, "kg/m^2"),
        "mu": (cloth.mu_range, "Pa"),
        "lambda": (cloth.lam_range, "Pa"),
        "bending": (cloth.bending_range, "J"),
    }
    seen = [
        "- Physics alone: no simulated cloth.",
        f"- {len(config.motions)} motions, {len(takes)} of them takes of CMU's motion capture.",
        f"- Bodies with betas of -{config.stage1.betas:g} to {config.stage1.betas:g} standard deviations.",
        "- Cloth: " + ", ".join(f"{name} {_range(limits)} {unit}" for name, (limits, unit) in ranges.items()) + ".",
    ]
    suits = [
        "- Characters on the embedded body's skeleton, in the bodies and cloth above, at "
        f"{config.fps:.0f} frames a second.",
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
    return [
        f"`{config.garment}`, {len(garment.vertices)} vertices. Psi reads {reads}.{felt}",
        "## Trained on",
        "\n".join(seen),
        "## Good for",
        "\n".join(suits),
        "## Known faults",
        "\n".join(faults),
    ]


def _figures(report: dict) -> list[str]:
    stages = [stage for stage in METHODS if stage in report]
    rows = [f"| | {' | '.join(METHODS[stage] for stage in stages)} |", "|---" * (len(stages) + 1) + "|"]
    for key, meaning in MEASURES.items():
        rows.append(f"| {meaning} | {' | '.join(_figure(report[stage].get(key)) for stage in stages)} |")
    names = ", ".join(f"`{name.removesuffix('.motion')}`" for name in report["motions"])
    return ["## How good it is", f"Means over {names}, on a body that was not trained on.", "\n".join(rows)]


def _worst(report: dict) -> list[str]:
    """Return the section on the motion, the character and the push on which Psi is worst."""
    rows = ["| | worst | hold gap there | mean |", "|---|---|---|---|"]
    groups = {"motion": "motions", "character": "wearers", "push": "pushed"}
    for kind, group in groups.items():
        gaps = {name: each.get("psi", each)["hold_gap"] for name, each in report.get(group, {}).items()}
        if gaps:
            name = max(gaps, key=gaps.__getitem__)
            mean = sum(gaps.values()) / len(gaps)
            rows.append(f"| {kind} | {name.removesuffix('.motion')} | {gaps[name]:.2f} | {mean:.2f} |")
    return ["## Where it is worst", "\n".join(rows)]


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


def _range(limits: Range) -> str:
    return f"{limits.low:g} to {limits.high:g}"


if __name__ == "__main__":
    cli.run(main)
