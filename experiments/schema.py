"""The schema of configurations: frozen dataclasses, plain data, light to import.

What a trial is made of is a task's dataclass; a `SweepConfig` says which trials there are and what is asked of them.
Every field is part of a trial's identity.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal


def _require(good: bool, message: str) -> None:
    if not good:
        raise ValueError(message)


@dataclass(frozen=True)
class ScheduleConfig:
    """The sigmas of an alignment; widths are shares of the shape's size.

    Args:
        kind: "default" takes the library's; "geometric" and "linear" fall from start to stop; "constant" stays at
            start; "adaptive" is estimated from the residuals, between the two.
        start: first sigma.
        stop: last sigma.
        steps: number of sigmas, or for "adaptive" of estimates.
        kappa: of "geometric": the ratio of neighbors, never below ``stop``; None: it follows from the ends.
    """

    kind: Literal["default", "geometric", "linear", "constant", "adaptive"] = "geometric"
    start: float = 0.08
    stop: float = 0.02
    steps: int = 5
    kappa: float | None = None

    def __post_init__(self) -> None:
        _require(0 < self.stop <= self.start, f"stop must be positive and at most start, got {self.stop}")
        _require(self.steps >= 1, f"steps must be at least 1, got {self.steps}")
        _require(self.kappa is None or 0 < self.kappa <= 1, f"kappa must be above 0 and at most 1, got {self.kappa}")


@dataclass(frozen=True)
class HandScene:
    """A cloud of a hand in a random pose, and the error of the start.

    Args:
        view: "whole": data and model points on all sides. "tracked": data on the side that a camera sees; the model
            points are noisy points that it sees of the start, as in a sequence. "side": data on the side that a camera
            sees, model points on all sides.
        num_points: on the hand.
        noise_mm: standard deviation of each coordinate.
        outlier_ratio: share of all points, uniform in the hand's box grown by 5 cm.
        start_deg: every joint of the start is off by as much.
        sharpness: a of the true skin.
    """

    view: Literal["whole", "tracked", "side"] = "whole"
    num_points: int = 500
    noise_mm: float = 1.5
    outlier_ratio: float = 0.2
    start_deg: float = 20.0
    sharpness: float = 2.0

    def __post_init__(self) -> None:
        _require(self.num_points >= 1, f"num_points must be at least 1, got {self.num_points}")
        _require(0 <= self.outlier_ratio < 1, f"outlier_ratio must be at least 0 and below 1, got {self.outlier_ratio}")
        _require(self.noise_mm >= 0, f"noise_mm must not be negative, got {self.noise_mm}")


@dataclass(frozen=True)
class AlignSolver:
    """Settings of the alignment of a hand.

    Args:
        method: of the library "em", "softassign", "closest" (ICP), or "paper", the alignment as printed, which keeps of
            these settings the number of model points and the sharpness; of others "cpd" (pycpd, deformable) and "gicp"
            (small_gicp, rigid), which know nothing of hands.
        em_steps: iterations per sigma.
        surface_steps: of the surface fit after EM, at each width.
        search: "auto", "always" or "never".
        debias: share of the kernel's own pull that is taken out.
        prior: whether joints are held weakly near the start.
        sharpness: a of the model's skin.
        num_model_points: that are moved.
    """

    method: Literal["em", "softassign", "closest", "paper", "cpd", "gicp"] = "em"
    em_steps: int = 6
    surface_steps: int = 0
    search: Literal["auto", "always", "never"] = "never"
    debias: float = 0.0
    prior: bool = False
    sharpness: float = 2.0
    num_model_points: int = 500

    def __post_init__(self) -> None:
        for name in ("em_steps", "num_model_points"):
            _require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("surface_steps", "debias"):
            _require(getattr(self, name) >= 0, f"{name} must not be negative, got {getattr(self, name)}")
        _require(self.sharpness > 0, f"sharpness must be positive, got {self.sharpness}")


@dataclass(frozen=True)
class AlignmentTrial:
    """A hand aligned to one cloud.

    Args:
        seed: of pose and cloud.
        scene: the cloud.
        schedule: the sigmas.
        solver: the method.
        config: any fields of `torchreg.AlignConfig`, by dotted name, that replace what the solver says.
        pictures: whether a picture and a glTF file are kept.
    """

    seed: int = 0
    scene: HandScene = field(default_factory=HandScene)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    solver: AlignSolver = field(default_factory=AlignSolver)
    config: dict[str, Any] = field(default_factory=dict)
    pictures: bool = False


@dataclass(frozen=True)
class ScanPairConfig:
    """Two range scans.

    Args:
        dataset: "figure" walks, "animal" trots, "toy" is a robot that lacks a part in one scan, "robot" has them all,
            "car" is an excavator, "hand" bends its fingers; "file" is the file ``name`` of ``folder`` (NPZ:
            source_points, source_faces, target_points, target_faces, source_truth, diagonal).
        apart: frames between the two; of "file" without meaning.
        frame: number of the first of the two.
        frames: length of the sequence; 0 for as many as the pair needs.
        num_points: of a scan.
        folder: of "file"; relative to where the experiment is run.
        name: of "file", without its ending.
    """

    dataset: Literal["figure", "animal", "toy", "robot", "car", "hand", "file"] = "figure"
    apart: int = 1
    frame: int = 0
    frames: int = 0
    num_points: int = 4500
    folder: str = ""
    name: str = ""

    def __post_init__(self) -> None:
        _require(self.apart >= 1, f"apart must be at least 1, got {self.apart}")
        _require(self.dataset != "file" or bool(self.name), "name must be given with dataset file")
        _require(self.frame >= 0, f"frame must not be negative, got {self.frame}")
        last = self.frame + self.apart
        _require(not self.frames or last < self.frames, f"frames must be above {last}, or 0, got {self.frames}")


@dataclass(frozen=True)
class RegistrationTrial:
    """A scan registered to another.

    Args:
        seed: of the motion and the scans.
        pair: the scans.
        method: "reduced" is the library's; "paper" the algorithm as printed, which takes of the following settings the
            bones and the grid; "cpd" (pycpd, deformable) and "gicp" (small_gicp, rigid) are others'.
        num_bones: at most.
        grid_resolution: cells along the longest axis.
        joint_weight: of the joint term in the end, from ten times as much on; 0 leaves it out.
        refine_steps: rounds of refining weights.
        num_samples: source points that are matched.
        retries: times that "paper" tries again with other parameters where a pair was not registered, as the truth
            tells.
        config: any fields of `torchreg.RegisterConfig`, by dotted name, that replace what these say.
        pictures: whether a picture and a glTF file are kept.
    """

    seed: int = 0
    pair: ScanPairConfig = field(default_factory=ScanPairConfig)
    method: Literal["reduced", "paper", "cpd", "gicp"] = "reduced"
    num_bones: int = 20
    grid_resolution: int = 50
    joint_weight: float = 0.001
    refine_steps: int = 1
    num_samples: int = 4000
    retries: int = 0
    config: dict[str, Any] = field(default_factory=dict)
    pictures: bool = False

    def __post_init__(self) -> None:
        for name in ("num_bones", "grid_resolution", "num_samples"):
            _require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")
        _require(self.grid_resolution <= 256, f"grid_resolution must be at most 256, got {self.grid_resolution}")
        for name in ("joint_weight", "refine_steps", "retries"):
            _require(getattr(self, name) >= 0, f"{name} must not be negative, got {getattr(self, name)}")


@dataclass(frozen=True)
class SpineTrial:
    """One spine of a sequence of surfaces.

    Args:
        seed: of form and motion.
        creature: "starfish" or "octopus"; "file" is the sequence ``name`` of ``folder`` (NPZ: vertices, faces).
        frames: number of them; of "file" every n-th, so that there are about as many; 0 for all.
        touching: whether two arms merge, see the dataset.
        noise: in voxels.
        resolution: voxels along the longest side.
        folder: of "file".
        name: of "file", without its ending.
        method: "spine" is the library's; "paper" the algorithm as printed. "skeletor" counts the tips of another
            program's skeletons.
        config: any fields of `torchreg.SpineConfig`, by dotted name.
        pictures: whether a picture and a glTF file are kept.
    """

    seed: int = 0
    creature: Literal["starfish", "octopus", "file"] = "starfish"
    frames: int = 12
    touching: Literal["none", "flanks", "tips"] = "none"
    noise: float = 0.0
    resolution: int = 96
    folder: str = ""
    name: str = ""
    method: Literal["spine", "paper", "skeletor"] = "spine"
    config: dict[str, Any] = field(default_factory=dict)
    pictures: bool = False

    def __post_init__(self) -> None:
        _require(self.creature != "file" or bool(self.name), "name must be given with creature file")
        for name in ("frames", "noise"):
            _require(getattr(self, name) >= 0, f"{name} must not be negative, got {getattr(self, name)}")
        _require(self.resolution >= 8, f"resolution must be at least 8, got {self.resolution}")


@dataclass(frozen=True)
class PaperTrial:
    """A figure or table of one of the three papers, made again.

    Args:
        seed: of what is made up.
        block: its name, such as p2-fig-4; see experiments/papers/blocks.py.
        smoke: small and coarse, in seconds.
    """

    seed: int = 0
    block: str = ""
    smoke: bool = False


@dataclass(frozen=True)
class CloudScene:
    """Clouds of hands before a camera that networks learn poses from.

    Args:
        train: number of clouds to learn from.
        held_out: number of clouds to measure with.
        num_points: of a cloud, outliers among them.
        noise_mm: standard deviation of each coordinate.
        outlier_ratio: share of all points, uniform in the hand's box grown by 5 cm.
        tilt_deg: hands are turned by up to this from upright with the palm to the camera, about any axis.
        bend: share of its range by which each joint is bent at most.
        seed: of all clouds.
        folder: where they are kept once they are made, relative to where the experiment is run; if empty, every trial
            makes them anew.
    """

    train: int = 2048
    held_out: int = 512
    num_points: int = 512
    noise_mm: float = 1.0
    outlier_ratio: float = 0.1
    tilt_deg: float = 45.0
    bend: float = 0.5
    seed: int = 0
    folder: str = ""

    def __post_init__(self) -> None:
        for name in ("train", "held_out", "num_points"):
            _require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")
        _require(0 <= self.outlier_ratio < 1, f"outlier_ratio must be at least 0 and below 1, got {self.outlier_ratio}")
        _require(0 <= self.bend <= 1, f"bend must be from 0 to 1, got {self.bend}")


@dataclass(frozen=True)
class NeuralTrial:
    """A network that learns hand poses from clouds.

    Args:
        seed: of its first weights, and of the order of the clouds.
        variant: how it is trained, see experiments/neural_init/train.py. "initializer" is no network but
            `PoseInitializer` alone.
        scene: the clouds.
        width: of its first layer; the others are 2 to 8 times as wide.
        normalized: whether what the last layer sees has zero mean and unit variance, as `PosePrior.init_head_` assumes.
        steps: of the optimizer.
        batch: clouds per step.
        learning_rate: of AdamW, after a short warm-up.
        averaging: share of the old weights in the moving average that is measured.
        report_every: steps between points of the learning curve.
    """

    seed: int = 0
    variant: Literal["scratch", "head", "labels", "refiner", "em", "initializer"] = "scratch"
    scene: CloudScene = field(default_factory=CloudScene)
    width: int = 32
    normalized: bool = False
    steps: int = 1000
    batch: int = 32
    learning_rate: float = 1e-3
    averaging: float = 0.98
    report_every: int = 50

    def __post_init__(self) -> None:
        for name in ("width", "steps", "batch", "report_every"):
            _require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")
        _require(self.learning_rate > 0, f"learning_rate must be positive, got {self.learning_rate}")
        _require(0 <= self.averaging < 1, f"averaging must be at least 0 and below 1, got {self.averaging}")


@dataclass(frozen=True)
class ProbeTrial:
    """A trial of given cost, to measure and test the runner.

    Args:
        seed: of the numbers.
        size: of the matrices that are multiplied; 0 for none.
        rounds: of multiplying.
        seconds: to sleep.
        outcome: "done"; "failed" raises; "skipped"; "killed" ends the process, "killed once" only the first time.
        log: file to which a line is written at the start of every run; none if empty.
        scale: of the result.
    """

    seed: int = 0
    size: int = 8
    rounds: int = 1
    seconds: float = 0.0
    outcome: Literal["done", "failed", "skipped", "killed", "killed once"] = "done"
    log: str = ""
    scale: float = 1.0


@dataclass(frozen=True)
class ReportConfig:
    """The focus of a report.

    Args:
        metrics: of the table, in this order; all if empty. Names of seconds are "seconds.NAME".
        heat: two axes; the first goes to the right.
        heat_metrics: of the heat maps; the first of the table if empty.
        curves: that are drawn; all if empty.
        curve_steps: curve that tells at which steps the values of the others were taken; 1, 2, ... if empty.
        curve_spread: whether curves are means over trials in bands from the lowest to the highest, instead of medians.
        curve_log: whether the values of curves are drawn on a logarithmic axis.
        group: axis by which curves are colored; the first one if empty.
        share: metrics that are shares or counts, for which the mean over seeds is told instead of the median.
        higher: metrics of which more is better; of others, less.
        neutral: metrics of which neither is better.
    """

    metrics: tuple[str, ...] = ()
    heat: tuple[str, ...] = ()
    heat_metrics: tuple[str, ...] = ()
    curves: tuple[str, ...] = ()
    curve_steps: str = ""
    curve_spread: bool = False
    curve_log: bool = False
    group: str = ""
    share: tuple[str, ...] = ()
    higher: tuple[str, ...] = ()
    neutral: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _require(len(self.heat) in (0, 2), f"heat must name two axes, got {len(self.heat)}")


@dataclass(frozen=True)
class SweepConfig:
    """The trials of a sweep: all cases, times all points of the grid, times all seeds.

    Args:
        name: of the sweep and its folder of results.
        task: name in the registry.
        question: that the sweep answers.
        trial: the task's configuration, of which the rest changes some fields.
        cases: each changes several fields at once; the key "case" names it.
        grid: per field (a path with dots) its values.
        seeds: number of seeds, from ``trial.seed`` on.
        picture_seeds: of them, those whose pictures are kept.
        report: what the report shows.
    """

    name: str
    task: str
    question: str
    trial: Any
    cases: tuple[dict[str, Any], ...] = ()
    grid: dict[str, Any] = field(default_factory=dict)
    seeds: int = 1
    picture_seeds: int = 0
    report: ReportConfig = field(default_factory=ReportConfig)

    def __post_init__(self) -> None:
        parts = self.name.replace("\\", "/").split("/")
        _require(
            bool(self.name.strip())
            and not {"", ".", ".."} & set(parts)
            and ":" not in self.name
            and self.name.isprintable(),
            f"name must be that of a folder below the results, such as alignment/rivals, got {self.name!r}",
        )
        _require(self.seeds >= 1, f"seeds must be at least 1, got {self.seeds}")
        _require(bool(self.question), "question must say what the sweep is for")
