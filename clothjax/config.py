"""Every setting of an experiment, with its unit and default, as frozen dataclasses."""

from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

# parts of the names, in lower case, of joints from the wrists on in CMU and SMPL
HANDS = ("hand", "finger", "thumb", "wrist", "index", "middle", "pinky", "ring")


ANYTHING = object()  # any value of a retired setting, which is no longer read


def _require(condition: bool, message: str) -> None:
    """Raise a ValueError with `message` unless the condition holds."""
    if not condition:
        raise ValueError(message)


@dataclass(frozen=True)
class Range:
    """The range of a material constant in training; networks read the constant scaled to [0, 1] over it."""

    low: float
    high: float
    log: bool = False
    """Uniform in the logarithm."""

    def __post_init__(self):
        _require(0 < self.low <= self.high, f"need 0 < low <= high, got low {self.low}, high {self.high}")


@dataclass(frozen=True)
class MaterialConfig:
    """The cloth. Training draws from the ranges (the thesis's), evaluation uses the single values (HOOD's)."""

    density: float = 0.20022  # kg/m^2
    mu: float = 23600.0  # Pa
    lam: float = 44400.0  # Pa
    bending: float = 3.9625778e-5  # N m
    density_range: Range = Range(4.34e-2, 7e-1)
    mu_range: Range = Range(15909.0, 63636.0, log=True)
    lam_range: Range = Range(3535.41, 93333.73)
    bending_range: Range = Range(6.37e-8, 1.31e-3, log=True)
    sample: bool = True
    """Draw materials from the ranges in training; false keeps the single values."""


@dataclass(frozen=True)
class PhysicsConfig:
    """The forces on the cloth, and their constants.

    The compiled programs of training, Phi and the reference solver leave out the terms that a scene does not have.
    """

    body: Literal["moving", "still", "none"] = "moving"
    """The body that the cloth can touch; it moves, stands still or does not exist. Without one, the rig only carries
    the pins."""
    without: tuple[Literal["bending", "gravity", "friction"], ...] = ()
    """Energies that the scene does not have."""
    collision_stiffness: float = 1e5  # J/m^3, of the cubic penetration
    collision_offset: float = 3e-3  # m
    friction_coefficient: float = 0.5
    shaped_rest: bool = True
    """The rest shape follows the character's betas (a graded garment); false: always the template, as in HOOD."""
    contact_surface: Literal["triangles", "centroids"] = "triangles"
    """Surface that a garment vertex can touch: the nearest triangle of the body (`triangles`), or the plane of the face
    whose centroid is nearest, as in HOOD (`centroids`)."""
    edge_contact: bool = True
    """Edges of the garment touch the body between their ends too, so that a limb does not slip through. Triangles only.
    """
    self_contact: bool = False
    """Vertices of the garment keep a distance from its triangles."""
    self_offset: float = 2e-3  # m, that distance
    reach: float = 0.6  # m, body farther than this from the garment at rest is never searched

    RETIRED: ClassVar[dict[str, Any]] = {"friction_radius": 3e-3, "friction_smoothing": 1e-4, "flat_hinges": True}

    def __post_init__(self):
        _require(
            self.contact_surface == "triangles" or not self.edge_contact,
            "edge_contact needs contact_surface: triangles; set edge_contact: false",
        )
        _require(len(set(self.without)) == len(self.without), f"without names an energy twice: {self.without}")


@dataclass(frozen=True)
class Ramp:
    """A loss weight relative to the physical one: constant, or linear between two training steps."""

    start: float = 1.0
    end: float | None = None
    first_step: int = 0
    last_step: int = 0

    def __post_init__(self):
        _require(self.start >= 0 and (self.end is None or self.end >= 0), "loss weights must be >= 0")
        _require(self.end is None or self.last_step > self.first_step, "a ramp needs last_step > first_step")

    @property
    def absent(self) -> bool:
        """True if the weight is always zero, so that programs can leave the term out."""
        return self.start == 0 and not self.end


@dataclass(frozen=True)
class LossConfig:
    """Weights w_k of the energies E_k [J] in the training loss sum_k w_k E_k / scale (METHOD.md, Training)."""

    stretching: Ramp = Ramp()
    bending: Ramp = Ramp()
    gravity: Ramp = Ramp()
    inertia: Ramp = Ramp()
    friction: Ramp = Ramp()
    collision: Ramp = Ramp()
    edge_collision: Ramp = Ramp()
    self_collision: Ramp = Ramp()
    scale: float = 0.02  # J, the energy that counts as a loss of 1


@dataclass(frozen=True)
class Stack:
    """Consecutive message-passing blocks on the same edge sets: `mesh` and `coarse0`, `coarse1`, ..."""

    edges: tuple[str, ...]
    blocks: int

    @property
    def lowest_level(self) -> int:
        """Lowest vertex level that this stack touches: 0 = fine mesh, i + 1 = coarse level i."""
        return min(0 if name == "mesh" else 1 + int(name.removeprefix("coarse")) for name in self.edges)


@dataclass(frozen=True)
class Level:
    """One mesh-convolution block. It keeps vertices `stride` hops apart; each reads those within `radius` hops."""

    features: int | None = None
    """Output channels. Null, allowed for the last block: the number that gives the latent size, with no layer after it.
    """
    stride: int = 2
    radius: int = 2


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of Phi (Encode, Process, Convolve, Decode) and of the blend shapes."""

    width: int = 48
    mlp_layers: int = 2
    """Linear layers of every encoder and processor MLP."""
    processor: tuple[Stack, ...] = (Stack(("mesh", "coarse1"), 4),)
    body_nodes: Literal["updated", "encoded"] = "encoded"
    """Body nodes take part in message passing (`updated`), or only send their encoding to the garment (`encoded`)."""
    canonical_features: bool = True
    """Give Phi the garment's state in the canonical pose of the next frame, beside HOOD's features."""
    convolution: tuple[Level, ...] = (Level(64), Level(64))
    convolution_bases: int = 8
    latent: int = 400
    """Wanted size L of the code; the actual one is the nearest multiple of the vertices that the convolution leaves."""
    latent_update: Literal["absolute", "descent"] = "descent"
    """Output of Phi's network: the next code, as in the thesis (`absolute`), or a correction added to a guess of it
    (`descent`). The guess starts at the current code, plus its last change if the potential is lower there, and takes
    `descent_steps` steps down the potential."""
    descent_steps: int = 32
    """Steps of L-BFGS that find the guess."""
    descent_samples: int = 24
    """Rollouts of Phi, at whose last frames the Hessian of the potential by the code is evaluated. The mean Hessian
    preconditions the descent. 0: the Hessian of the garment at rest, unrelaxed, takes its place."""
    descent_damping: float = 0.02
    """J, added to the eigenvalues of that Hessian before it is inverted. It shortens steps: folds are stiffer than the
    mean Hessian says."""
    decoder: tuple[int, ...] = (256, 256)
    """Hidden layers of the decoder, before the blend-shape weights."""
    decoder_skip: bool = True
    """Add a linear map of the code to the decoder's output, unlike the thesis. Narrow ReLU layers alone leave the
    blend-shape weights few directions to move in."""
    blendshapes: int = 384
    relaxation: int = 0
    """Jacobi steps down the stretching energy that end the decoder. They let blend shapes fold without stretching. Only
    with `stage2.forces`."""
    relaxation_momentum: float = 0.0
    """Share of the last step that such a step goes on with (heavy ball, Polyak 1964); its own part is longer by the
    same share. Then as many steps reach farther."""
    shown_relaxation: int = 0
    """Steps that relax the garment where it is shown and another mesh feels, with a momentum of 0.8. Twice six steps
    with one of 0.5 follow, in turn with being pushed out of the body. They take out stretch that the code leaves, and
    no training knows of them. 0: as `relaxation`, and as many in turn. Only with `felt`."""
    felt: str = ""
    """The same garment with fewer vertices, by asset name or path. It feels the forces in place of the garment itself,
    and is its level of detail. Empty: the garment itself. Only with `stage2.forces`."""
    blendshape_relu: bool = False
    """A ReLU on the blend-shape weights, as in the thesis."""
    remat: bool = False
    """Recompute each message-passing block in the backward pass: several times less memory, a little slower."""

    RETIRED: ClassVar[dict[str, Any]] = {
        "body_radius": 0.03,
        "residual_rate": 0.5,
        "descent_bound": 0.3,
        "normalizer_steps": 2000,
        "bfloat16": False,
    }

    def __post_init__(self):
        _require(self.width > 0 and self.latent > 0 and self.blendshapes > 0, "sizes must be > 0")
        _require(0 <= self.relaxation <= 16, f"relaxation must be 0 to 16, got {self.relaxation}")
        momentum = self.relaxation_momentum
        _require(0 <= momentum < 1, f"relaxation_momentum must be at least 0 and below 1, got {momentum}")
        _require(momentum == 0 or self.relaxation > 0, "relaxation_momentum needs relaxation > 0")
        steps = self.shown_relaxation
        _require(0 <= steps <= 64, f"shown_relaxation must be 0 to 64, got {steps}")
        _require(
            steps == 0 or (self.relaxation > 0 and self.felt != ""), "shown_relaxation needs relaxation > 0 and felt"
        )
        _require(self.mlp_layers >= 2, f"mlp_layers must be >= 2, got {self.mlp_layers}")
        _require(len(self.convolution) > 0, "the convolution needs a block")
        _require(
            all(level.features is not None for level in self.convolution[:-1]),
            "only the last convolution block may leave its features open",
        )
        known = {"mesh", "coarse0", "coarse1", "coarse2", "coarse3"}
        for stack in self.processor:
            unknown = set(stack.edges) - known
            _require(not unknown, f"unknown edge sets {sorted(unknown)}; allowed: {sorted(known)}")


@dataclass(frozen=True)
class ShapesConfig:
    """The simulations whose principal components are the first blend shapes: pure physics, all vertices free."""

    sequences: int = 44
    """Autoregressive rollouts, each of its own clip, betas and material. 0: smooth shapes, eigenvectors of the
    Laplacian."""
    frames: int = 60
    descent_steps: int = 30
    """Steps of L-BFGS in a frame."""
    seed: int = 0

    RETIRED: ClassVar[dict[str, Any]] = {"farthest": 0.4}


@dataclass(frozen=True)
class PhysicsTrainingConfig:
    """Training of a network on the physics, in rollouts of a pool of persistent simulations."""

    steps: int = 12000
    batch: int = 1
    """Simulations that one training step advances."""
    pool: int = 48
    """Simulations that training advances in turn and keeps from step to step."""
    restart_probability: float = 1.0 / 90.0
    """Chance, at each turn, that a simulation starts again. 1 is HOOD's restart curriculum, whatever the pool."""
    lost: float | None = None
    """A simulation with this loss or more starts again at its next turn, as does one with a vertex 5 m from the root.
    Null: only the latter, for an untrained Phi needs time to recover from its own errors."""
    rollout: int = 1
    """Frames that a training step rolls out, at the start."""
    rollout_end: int = 1
    """The most frames that a training step rolls out."""
    rollout_every: int = 5000
    """Training steps after which the rollout grows by one frame."""
    gradient_frames: int = 1
    """Frames of a rollout that gradients go through. As in HOOD, 1 makes every frame's input state a constant."""
    learning_rate: float = 1e-3
    decay_start: float = 0.4
    """Fraction of the steps at full rate, before exponential decay."""
    decay_end: float = 0.03
    """Final learning rate as a fraction of the full one."""
    adam_b2: float = 0.99
    clip: float = 1.0
    ema: float = 0.995
    """Decay per step of the averaged parameters that evaluation uses."""
    seed: int = 0

    def __post_init__(self):
        _require(self.gradient_frames >= 1, f"gradient_frames must be >= 1, got {self.gradient_frames}")
        whole = self.batch <= self.pool or self.restart_probability == 1
        _require(whole, f"a batch of {self.batch} needs a pool of as many simulations, got {self.pool}")


@dataclass(frozen=True)
class Stage1Config(PhysicsTrainingConfig):
    """Stage 1: training of Phi on the physics."""

    start_timestep: float = 1.0 / 3.0  # s, of the quasi-static first step (HOOD); 0: start as skinned
    blendshape_rate: float = 0.0
    """Learning rate of the blend shapes, as a fraction of `learning_rate`. 0 keeps the first ones: once trained,
    principal shapes represent less of the cloth's motion on new clips."""
    betas: float = 2.0  # standard deviations, drawn uniformly from +-this


@dataclass(frozen=True)
class TuningConfig(PhysicsTrainingConfig):
    """Fine-tuning of Psi after its regression, on the bodies of `stage1.betas`.

    A Psi with forces does not read `preconditioning`: its whitening takes that place.
    """

    steps: int = 0
    pool: int = 192
    lost: float | None = 1e4
    """As in stage 1. An ordinary loss is 1 (skirt) to 20 (dress); cloth that stays inside the body may have 1e5. Below
    this limit cloth can still come out, and training sees it do so."""
    learning_rate: float = 1.5e-4
    clip: float = 1.5
    """Largest norm of a gradient; a longer one is scaled to it. Nearly every gradient is longer, so that all
    simulations count alike, soft cloth and cloth inside the body too."""
    preconditioning: float = 0.5
    """Power of the two matrices that gradients are multiplied by; 0: none.

    They are Phi's inverse Hessian, for gradients of codes, and the inverse covariance of the pose inputs, for those of
    the first layer. The first is there only if `model.latent_update` is `descent`. In standard deviations, the cloth is
    up to 4 000 times stiffer along some codes than along others. With 1, errors of all codes would count alike, unlike
    their energies."""

    RETIRED: ClassVar[dict[str, Any]] = {"start_timestep": 0.0, "blendshape_rate": 0.0, "betas": ANYTHING}


@dataclass(frozen=True)
class PeerConfig:
    """A baseline in place of Phi and Psi (`clothjax/networks/baselines.py`), trained with the settings of stage 1.

    Gradients pass through its memory over a whole rollout.
    """

    network: Literal["", "ncs", "snug", "direct"] = ""
    """NCS, SNUG's recurrent network, or Psi itself trained directly on the physics. The last is the thesis's ablation,
    with the sizes of `model` and `stage2`."""
    width: int = 512
    """Width of the layers of NCS (512 as published) and of each of SNUG's four units (256)."""
    blendshapes: int = 512
    """Number of blend shapes of NCS."""

    def __post_init__(self):
        _require(self.width > 0 and self.blendshapes > 0, "peer: sizes must be > 0")


@dataclass(frozen=True)
class Stage2Config:
    """Stage 2: training of the latent predictor.

    With `forces` only `hidden` and `gated` are read, and `labels` has the rest.
    """

    steps: int = 6000
    batch: int = 32
    rollout: int = 16
    """Frames that a training step predicts in a row."""
    noise: float = 0.3
    """Standard deviation of the noise on the first code of a rollout, in standard deviations of the codes."""
    vertex_share: float = 0.8
    """Share of the decoded vertices' error in the loss; the rest is the code's. Both errors are fractions of a
    variance, so that parts of the code that move nothing do not crowd out the others."""
    latent_decay: float = 0.1
    """Share of the code that decays in a frame unless the network restores it. Without it, rollouts drift."""
    hidden: tuple[int, ...] = (512, 512)
    gated: bool = False
    """With forces, the network also gates them: it predicts how much each direction's own code, change and forces
    count in a frame. Without, the character alone scales them."""
    forces: bool = True
    """Psi reads the forces on the held garment, and learns from `labels`. False: it reads the pose, and learns from
    rollouts of Phi. Then a frame takes an eighth of the time or less, by runtime, and the cloth has half the swing.
    Fine-tuning of a Psi with forces needs a tenth of the usual rate."""
    learning_rate: float = 1e-3
    clip: float = 1.0
    sequences: int = 96
    """Teacher rollouts, each of its own betas and material."""
    frames: int = 160
    """Frames of each teacher rollout."""
    excluded_joints: tuple[str, ...] = (*HANDS, "toe", "jaw", "eye")
    """Joints whose names contain one of these, in upper or lower case, are not inputs."""
    seed: int = 0

    RETIRED: ClassVar[dict[str, Any]] = {"pushforward": False}
    BEFORE: ClassVar[dict[str, Any]] = {"forces": False}


@dataclass(frozen=True)
class LabelsConfig:
    """Labels of a Psi with forces: where the descent goes from states of Psi's own rollouts (DAgger)."""

    rounds: int = 20
    """Rounds of labelling and training, each with the Psi of the round before. All frames stay in memory, 10 kB each
    for a garment of 1 000 vertices."""
    simulations: int = 512
    """Simulations that are labelled in a round, each of its own clip, betas and material. They go on in the next."""
    frames: int = 8
    """Labelled frames of a simulation in a round."""
    stride: int = 1
    """A label on every so many frames of a simulation that Psi alone moves: what labels ask for lasts, and those of
    frames in a row tell little more than one of them. One with a share below 1 has them all: Psi drifts at first."""
    renewed: float = 0.1
    """Share of the simulations that begin anew after a round."""
    descent_steps: int = 48
    """Most descent steps of a label. They start where Psi is, so that later rounds go on from earlier."""
    tolerance: float = 1e-4
    """Share of the energy gained that a label may leave."""
    shares: tuple[float, ...] = (0.3, 0.7, 0.9, 1.0, 1.0)
    """How far a simulation goes from the label to Psi's own code; each draws one in a round."""
    noise: float = 0.35
    """Most noise on a whitened code, as its length in sqrt(J), in one frame of five."""
    external: float = 12.0
    """Largest acceleration of wind in m/s^2. About one simulation of seven draws wind, no gravity, or another direction
    of gravity in a round. 0: none of these."""
    steps: int = 200
    """Training steps of a round."""
    anew: bool = False
    """Each round begins with the linear map of all frames so far, and keeps it as it is: for few frames and steps."""
    last_steps: int = 8000
    """Training steps on all frames after the last round, by a network drawn anew. 0: none."""
    batch: int = 512
    learning_rate: float = 5e-4
    decay: float = 2.0
    """Weight decay, relative to the rate. Without it the network overfits."""
    ridge: float = 300.0
    """Penalty on the linear map that training begins with."""
    seed: int = 0

    RETIRED: ClassVar[dict[str, Any]] = {"candidates": ANYTHING, "candidate_rollouts": ANYTHING}

    def __post_init__(self):
        for name in ("rounds", "simulations", "frames", "stride"):
            _require(getattr(self, name) >= 1, f"labels.{name} must be >= 1, got {getattr(self, name)}")
        _require(all(0 <= share <= 1 for share in self.shares), f"labels.shares must be in [0, 1]: {self.shares}")

    @property
    def all_steps(self) -> int:
        """Training steps of all rounds and after them."""
        return self.rounds * self.steps + self.last_steps


@dataclass(frozen=True)
class EvaluationConfig:
    """The defaults of `clothjax evaluate`."""

    motions: tuple[str, ...] = ("walk_3",)
    betas_seed: int = 12345
    betas: float = 1.5  # standard deviations
    frames: int = 300
    """Most frames of each motion."""
    gap_frames: int = 10
    """Frames at which the reference solver runs."""
    solver_frames: int = 60
    """Frames of the reference solver's own rollout. Swing, wrinkles, jitter, the ratio of strains and the error of a
    rollout are measured over these, and pictures show it."""
    long_frames: int = 1000
    """Frames of the long autoregressive rollout, with the motion repeated."""
    wearers: bool = False
    """Measure nine characters too: a thin, the mean and a heavy body in soft, middling and stiff cloth."""
    animation_frames: int = 120
    """Most frames of an animation."""


@dataclass(frozen=True)
class Config:
    """The settings of one training and of its evaluation."""

    garment: str = "tshirt_1000"
    """Asset name or path of the garment."""
    body: str = "body"
    """Asset name or path of the body that it was made for."""
    motions: tuple[str, ...] = ()
    """Training motions: asset names or paths; empty: every embedded clip except those of `evaluation`."""
    fps: float = 30.0
    material: MaterialConfig = field(default_factory=MaterialConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    shapes: ShapesConfig = field(default_factory=ShapesConfig)
    stage1: Stage1Config = field(default_factory=Stage1Config)
    stage2: Stage2Config = field(default_factory=Stage2Config)
    labels: LabelsConfig = field(default_factory=LabelsConfig)
    tuning: TuningConfig = field(default_factory=TuningConfig)
    peer: PeerConfig = field(default_factory=PeerConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    directory: str = ""
    """Folder of the run; empty: runs/<name of the config file>."""

    def __post_init__(self):
        _require(
            not self.peer.network or self.stage1.start_timestep == 0,
            "a baseline (peer.network) does not know the time step: set stage1.start_timestep to 0",
        )
        _require(
            not self.stage2.forces or self.model.latent_update == "descent",
            "stage2.forces needs the inverse Hessian of model.latent_update: descent",
        )
        _require(
            self.stage2.forces or self.model.relaxation == 0,
            "model.relaxation needs stage2.forces: a Psi without forces does not know the cloth",
        )
        _require(self.stage2.forces or not self.model.felt, "model.felt needs stage2.forces: nothing is felt without")
        _require(
            not self.stage2.forces or (self.physics.body == "moving" and not self.peer.network),
            "stage2.forces needs a body that moves (physics.body: moving), and is not of a baseline (peer.network)",
        )
