"""Where alignment by EM and by its rivals breaks: outliers, far starts, few and many points.

    python benchmarks/rivals.py --output FOLDER    # every figure, a picture per view
    python benchmarks/rivals.py --smoke            # a cloud of each of two conditions, to see that it runs

Data: random hand poses, 1.5 mm noise, outliers uniform in the hand's bounding box grown by 5 cm. Around 20 % outliers,
joints 20 degrees off and 500 points, one of the three varies. All methods move the same 500 model points. A failure is
a mean error of the seen fingertips above 1 cm. Three views:

- whole: data and model points on all sides.
- tracked: data on the side that a camera sees; the model points are noisy points that it sees of the start, as in the
  paper, where they are data of the frame before.
- one side: data on the side that a camera sees, model points on all sides; half of them have no data at all.

These methods are compared:

- EM, EM own sigma, SoftAssign, ICP: the paper's comparison, without surface fit, search or prior: 30 iterations at
  most, sigma (ICP: the trimming distance) falling in five steps from 8 % to 2 % of the hand's size. "Own sigma" is
  estimated in every M-step instead, in the same range. SoftAssign and ICP have constants that serve them well on such
  data; EM has the paper's c, and beside it stands EM with a tenth of it, chosen in the same way.
- EM debiased, SoftAssign debiased: with most of the kernel's own pull taken out of the targets.
- EM + surface fit: the library's default without its search. default: all of it.

The paper's claims about its rivals follow, each confirmed or contradicted by a sign test (5 %) over paired alignments;
the one about constants by how much they change the share of true inliers that are matched.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

import torchreg as tr
from torchreg.alignment.fit.annealed_em import CORRESPONDENCES
from torchreg.alignment.fit.softassign import softassign
from torchreg.datasets.hand import HandCloud, make_hand_cloud, random_hand_pose, surface_skin
from torchreg.solvers.e_step import OUTLIER_CONSTANT, EStep, expectation
from torchreg.viz.figures import save_picture

NOISE, TIPS, FAILURE = 0.0015, [4, 8, 12, 16, 20], 0.01
# A fingertip counts with this share of the points on its last phalanx: 8 of 500.
MIN_SEEN = 0.016
START_SIGMA, STOP_SIGMA, STEPS, PER_STEP = 0.08, 0.02, 5, 6
OUTLIERS, STARTS_DEG, POINTS = (0.0, 0.2, 0.4, 0.6), (0, 10, 20, 30, 40), (100, 250, 500, 1500, 5000)
NUM_MODEL_POINTS = 500
VIEWS: dict[str, Tensor | None] = {"whole": None, "tracked": torch.zeros(3), "one side": torch.zeros(3)}
# A tenth of c served EM best on such data, of 0.001 to 10 times.
LIGHT, LIGHT_OUTLIER = "em light", 0.1 * OUTLIER_CONSTANT
FACTORS = (0.01, 0.1, 1.0, 10.0, 100.0)
SIGNIFICANCE = 0.05


@dataclass(frozen=True)
class Condition:
    """What the clouds of a row have in common."""

    view: str
    outliers: float = 0.2
    start_deg: int = 20
    points: int = 500

    def __str__(self) -> str:
        return f"{self.view}, {self.outliers:.0%} outliers, {self.start_deg} deg, {self.points} points"

    @property
    def short(self) -> str:
        """What sets it apart from the middle condition."""
        middle = Condition(self.view)
        parts = [f"{self.outliers:.0%} outliers"] if self.outliers != middle.outliers else []
        parts += [f"{self.start_deg} deg"] if self.start_deg != middle.start_deg else []
        parts += [f"{self.points} points"] if self.points != middle.points else []
        return ", ".join(parts) or "middle"


@dataclass(frozen=True)
class Trial:
    """A cloud, its true keypoints (21, 3), which fingertips (5,) are seen, a start, and the model points."""

    cloud: HandCloud
    keypoints: Tensor
    seen: Tensor
    start: Tensor
    skin: tr.LinearBlendSkin


@dataclass(frozen=True)
class Row:
    """One line of the table; all tensors are (trials,): metres, metres, seconds, iterations at wide sigmas."""

    condition: Condition
    method: str
    tips: Tensor
    joints: Tensor
    seconds: Tensor
    wide: Tensor

    @property
    def failures(self) -> float:
        """Share of the trials with a mean fingertip error above 1 cm."""
        return float((self.tips > FAILURE).double().mean())


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, whether the figures bear it out, and the figures."""

    text: str
    verdict: str
    figures: str


def light_expectation(model: Tensor, data: Tensor, sigma: Tensor, outlier: object, *, mask: Tensor) -> EStep:
    """Return the E-step with a tenth of the paper's outlier constant."""
    return expectation(model, data, sigma, LIGHT_OUTLIER, mask=mask)


def methods(size: float) -> dict[str, tr.AlignConfig]:
    """Return the configurations by name; size of the hand in metres."""
    widths = size * START_SIGMA, size * STOP_SIGMA
    em = tr.AlignConfig(
        schedule=tr.SigmaSchedule.geometric(*widths, STEPS), em_steps=PER_STEP, surface_steps=0, search="never",
        debias=0.0, prior_std=None,
    )  # fmt: skip
    CORRESPONDENCES[LIGHT] = light_expectation
    own = tr.SigmaSchedule.adaptive(*widths, STEPS * PER_STEP)
    debias = tr.AlignConfig().debias
    return {
        "EM": em,
        "EM c / 10": replace(em, correspondence=LIGHT),
        "EM own sigma": replace(em, schedule=own, em_steps=1),
        "SoftAssign": replace(em, correspondence="softassign"),
        "ICP": replace(em, correspondence="closest"),
        "EM debiased": replace(em, debias=debias),
        "SoftAssign debiased": replace(em, correspondence="softassign", debias=debias),
        "EM + surface fit": tr.AlignConfig(search="never"),
        "default": tr.AlignConfig(),
    }


def conditions(view: str, *, smoke: bool = False) -> list[Condition]:
    """Return the conditions of a view: the middle one, and those that differ from it in one respect."""
    middle = Condition(view)
    if smoke:
        return [middle, replace(middle, points=100)]
    varied = [replace(middle, outliers=ratio) for ratio in OUTLIERS]
    varied += [replace(middle, start_deg=degrees) for degrees in STARTS_DEG]
    varied += [replace(middle, points=count) for count in POINTS]
    return list(dict.fromkeys(varied))


def make_trial(
    hand: tr.Hand, surface: tr.LinearBlendSkin, skin: tr.LinearBlendSkin, condition: Condition, seed: int
) -> Trial:
    """Return a trial; the same pose and signs of the start's errors for the same seed."""
    generator = torch.Generator().manual_seed(seed)
    pose = random_hand_pose(hand, generator)
    start = pose.clone()
    signs = 2.0 * torch.randint(2, (hand.num_dofs - 6,), generator=generator) - 1.0
    start[6:] += math.radians(condition.start_deg) * signs
    start = hand.clamp(start)
    cloud = make_hand_cloud(
        hand, pose, num_points=condition.points, noise=NOISE, outlier_ratio=condition.outliers,
        camera=VIEWS[condition.view], skin=surface, generator=generator,
    )  # fmt: skip
    counts = torch.stack([(cloud.part_labels == part).sum() for part in hand.fingertip_parts])
    # At least one fingertip counts: the one that is seen best.
    seen = counts >= min(MIN_SEEN * condition.points, int(counts.max()))
    if condition.view == "tracked":
        before = make_hand_cloud(
            hand, start, num_points=NUM_MODEL_POINTS, noise=NOISE, outlier_ratio=0.0, camera=VIEWS["tracked"],
            skin=surface, generator=generator,
        )  # fmt: skip
        skin = tr.BendingSkin(hand, before.points, start)
    with torch.no_grad():
        return Trial(cloud, hand.keypoints(pose), seen, start, skin)


def measure(
    hand: tr.Hand, condition: Condition, configs: dict[str, tr.AlignConfig], trials: list[Trial]
) -> Iterator[Row]:
    """Yield a row per method, all on the same trials."""
    schedule = configs["EM"].schedule
    narrow = 2 * (schedule.values[-1] if schedule is not None else math.nan)
    for name, config in configs.items():
        figures = []
        for trial in trials:
            begin = time.perf_counter()
            found = tr.align(hand, trial.cloud.points, trial.start, model_points=trial.skin, config=config)
            seconds = time.perf_counter() - begin
            far = (found.keypoints - trial.keypoints).norm(dim=-1)
            wide = sum(float(record.sigma.max()) > 1.01 * narrow for record in found.history if record.stage == "em")
            figures.append([float(far[TIPS][trial.seen].mean()), float(far.mean()), seconds, wide])
        yield Row(condition, name, *torch.tensor(figures, dtype=torch.float64).unbind(-1))


def sign_test(wins: int, losses: int) -> float:
    """Return the probability of a split as uneven or more, if wins and losses were equally likely."""
    count, fewer = wins + losses, min(wins, losses)
    return min(1.0, 2 * sum(math.comb(count, k) for k in range(fewer + 1)) / 2**count)


def verdict(wins: int, losses: int) -> str:
    """Return what a sign test says about a claim that predicts wins."""
    if sign_test(wins, losses) >= SIGNIFICANCE:
        return "NOT DECIDED"
    return "CONFIRMED" if wins > losses else "CONTRADICTED"


def pairs(rows: Sequence[Row], one: str, other: str) -> list[tuple[Row, Row]]:
    """Return the rows of two methods, condition by condition."""
    by_key = {(row.condition, row.method): row for row in rows}
    return [(row, by_key[row.condition, other]) for row in rows if row.method == one]


def better_claim(rows: Sequence[Row], text: str, one: str, other: str) -> Claim:
    """Return the claim that one method is nearer to the truth and fails less than another."""
    both = pairs(rows, one, other)
    mine, theirs = (torch.cat([pair[side].tips for pair in both]) for side in (0, 1))
    # Where both fail, which of them is nearer is chance.
    told = torch.minimum(mine, theirs) <= FAILURE
    wins, losses = int((mine < theirs)[told].sum()), int((mine > theirs)[told].sum())
    ratio = float((theirs / mine)[told].median()) if bool(told.any()) else math.nan
    failed, rival_failed = (float((errors > FAILURE).double().mean()) for errors in (mine, theirs))
    figures = f"{one} nearer in {wins} of {wins + losses} alignments that either solves; error of {other} {ratio:.2f} "
    figures += f"times as large (median); failures {failed:.0%} against {rival_failed:.0%}"
    worse = [a.condition.short for a, b in both if float(a.tips.median()) > float(b.tips.median())]
    where = f" ({' | '.join(worse)})" if worse else ""
    figures += f"; {other} has the lower median in {len(worse)} of {len(both)} conditions{where}"
    return Claim(text, verdict(wins, losses), figures)


def faster_claim(rows: Sequence[Row], text: str, one: str, other: str) -> Claim:
    """Return the claim that one method takes less time than another."""
    both = pairs(rows, one, other)
    mine, theirs = (torch.cat([pair[side].seconds for pair in both]) for side in (0, 1))
    wins = int((mine < theirs).sum())
    figures = f"{other} takes {float((theirs / mine).median()):.2f} times as long (median)"
    return Claim(text, verdict(wins, len(mine) - wins), figures)


def falls_claim(rows: Sequence[Row], text: str, one: str, other: str) -> Claim:
    """Return the claim that the other method's sigma falls faster than the first one's."""
    both = pairs(rows, one, other)
    mine, theirs = (torch.cat([pair[side].wide for pair in both]) for side in (0, 1))
    figures = f"iterations above twice the last sigma (median): {float(theirs.median()):.0f} with {other}, "
    figures += f"{float(mine.median()):.0f} with {one}"
    return Claim(text, verdict(int((theirs < mine).sum()), int((theirs > mine).sum())), figures)


def held_shares(trials: Sequence[Trial], sigma: Tensor, e_step: Callable[..., EStep]) -> Tensor:
    """Return the mean posterior (factors, 2) of true inliers and of outliers in the true pose, for scaled constants."""
    shares = []
    for factor in FACTORS:
        found = []
        for trial in trials:
            with torch.no_grad():
                step = e_step(trial.skin(trial.cloud.pose), trial.cloud.points, sigma, factor * OUTLIER_CONSTANT)
            inside = trial.cloud.inliers
            found.append(torch.stack([step.inlier_posterior[inside].mean(), step.inlier_posterior[~inside].mean()]))
        shares.append(torch.stack(found).mean(0))
    return torch.stack(shares)


def constant_claim(trials: Sequence[Trial], sigma: Tensor) -> Claim:
    """Return the claim that SoftAssign depends more on its outlier constants than EM does."""
    em, soft = (held_shares(trials, sigma, e_step) for e_step in (expectation, softassign))
    spread = [float(shares[:, 0].max() - shares[:, 0].min()) for shares in (em, soft)]
    lines = [
        f"share of inliers / outliers matched in the true pose, constant times {', '.join(f'{f:g}' for f in FACTORS)}:"
    ]
    for name, shares in (("EM", em), ("SoftAssign", soft)):
        lines.append(f"{name} " + ", ".join(f"{inside:.2f} / {outside:.2f}" for inside, outside in shares.tolist()))
    return Claim(
        "SoftAssign depends a lot upon the entries for 'no partner', more than EM upon c",
        "CONFIRMED" if spread[1] > spread[0] else "CONTRADICTED",
        "; ".join([*lines, "rows and columns are normalized with their extra entries, as Gold et al. do"]),
    )


def claims(rows: Sequence[Row], trials: Sequence[Trial], sigma: Tensor) -> list[Claim]:
    """Return the paper's claims about its rivals, held to the rows of one view; trials of its middle condition."""
    return [
        better_claim(rows, "one-to-many (EM) is more reliable than one-to-one (SoftAssign)", "EM", "SoftAssign"),
        better_claim(rows, "... also when its constant is chosen as freely", "EM c / 10", "SoftAssign"),
        better_claim(rows, "... also when both are debiased", "EM debiased", "SoftAssign debiased"),
        faster_claim(rows, "one-to-many is more efficient than one-to-one", "EM", "SoftAssign"),
        constant_claim(trials, sigma),
        better_claim(rows, "annealing sigma aligns better than estimating it", "EM", "EM own sigma"),
        falls_claim(rows, "an estimated sigma falls more quickly than an annealed one", "EM", "EM own sigma"),
        better_claim(rows, "EM stands outliers and far starts better than closest points", "EM", "ICP"),
        better_claim(rows, "fitting the surface after EM corrects the pose", "EM + surface fit", "EM"),
    ]


def render(rows: Sequence[Row]) -> str:
    """Return the table of all rows, in millimeters and milliseconds."""
    lines = [f"{'method':20} {'tips':>7} {'p90':>7} {'joints':>7} {'fail':>5} {'ms':>6}"]
    condition = None
    for row in rows:
        if row.condition != condition:
            condition = row.condition
            lines.append(f"-- {condition}")
        tips, joints = 1e3 * row.tips, 1e3 * row.joints
        line = f"{row.method:20} {tips.median():7.2f} {tips.quantile(0.9):7.2f} {joints.median():7.2f} "
        lines.append(f"{line}{row.failures:5.0%} {1e3 * row.seconds.median():6.0f}")
    return "\n".join(lines)


def draw(rows: Sequence[Row], view: str, path: Path) -> Path:
    """Return the path of a picture of median error and failures against what varies."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.2), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2, 3, sharey="row")
    axes: list[tuple[str, str, Callable[[Condition], float]]] = [
        ("outliers", "outliers, % of all points", lambda condition: 100 * condition.outliers),
        ("start_deg", "joints of the start off, degrees", lambda condition: condition.start_deg),
        ("points", "points on the hand", lambda condition: condition.points),
    ]
    middle = Condition(view)
    for column, (field, label, value) in enumerate(axes):
        for number, name in enumerate(dict.fromkeys(row.method for row in rows)):
            along = [row for row in rows if row.method == name and row.condition.view == view]
            along = [row for row in along if replace(row.condition, **{field: getattr(middle, field)}) == middle]
            along.sort(key=lambda row: value(row.condition))
            x, style = [value(row.condition) for row in along], {"marker": "o", "markersize": 3, "color": f"C{number}"}
            grid[0, column].plot(x, [1e3 * float(row.tips.median()) for row in along], label=name, **style)
            grid[1, column].plot(x, [100 * row.failures for row in along], **style)
        grid[0, column].set_yscale("log")
        grid[1, column].set_xlabel(label)
        for ax in grid[:, column]:
            ax.set_xscale("log" if field == "points" else "linear")
            ax.grid(alpha=0.3)
    grid[0, 0].set_ylabel("fingertips, median error, mm")
    grid[1, 0].set_ylabel("failures, %")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return save_picture(figure, path)


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=10, help="clouds per condition (default 10)")
    parser.add_argument("--view", choices=(*VIEWS, "all"), default="all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--output", type=Path, help="folder for the pictures and the text")
    parser.add_argument("--smoke", action="store_true", help="one cloud of each of two conditions, all sides seen")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    trials, views = (1, ["whole"]) if options.smoke else (options.trials, list(VIEWS))
    views = views if options.view == "all" else [options.view]
    hand = tr.Hand()
    surface, skin = surface_skin(hand), tr.sample_skin(hand, NUM_MODEL_POINTS)
    size = float((skin.points.amax(0) - skin.points.amin(0)).norm())
    configs = methods(size)
    cells = [condition for view in views for condition in conditions(view, smoke=options.smoke)]
    rows: list[Row] = []
    middle: dict[str, list[Trial]] = {}
    for number, condition in enumerate(tqdm(cells, leave=False, disable=None)):
        clouds = [make_trial(hand, surface, skin, condition, 1000 * options.seed + seed) for seed in range(trials)]
        if condition == Condition(condition.view):
            middle[condition.view] = clouds
        if number == 0 and not options.smoke:
            # What is set up at the first call is not timed.
            list(measure(hand, condition, configs, clouds[:1]))
        rows += measure(hand, condition, configs, clouds)
    text = f"seen fingertips and all joints, distance to the truth in mm; {trials} clouds per condition, seed "
    text += f"{options.seed}; failure: fingertips off by more than {1e3 * FAILURE:.0f} mm\n{render(rows)}"
    for view in views:
        text += f"\n\nclaims, {view}"
        of_view = [row for row in rows if row.condition.view == view]
        for claim in claims(of_view, middle[view], torch.tensor(STOP_SIGMA * size)):
            text += f"\n- {claim.text}: {claim.verdict}\n    " + claim.figures.replace("; ", "\n    ")
    print(text)
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        (options.output / "rivals.txt").write_text(text + "\n", encoding="utf-8")
        for view in views:
            print("wrote", draw(rows, view, options.output / f"rivals_{view.replace(' ', '_')}.png"))
    return rows


if __name__ == "__main__":
    main()
