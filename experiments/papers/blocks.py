"""What there is in the three papers: a block per figure and table, in their order, light to import."""

from __future__ import annotations

from dataclasses import dataclass

PAPERS = {
    "p1": "Dewaele, Devernay, Horaud, Forbes 2006: The alignment between 3-D data and articulated shapes with bending "
    "surfaces",
    "p2": "Chang, Zwicker 2009: Range scan registration using reduced deformable models",
    "p3": "Brostow, Essa, Steedly, Kwatra 2004: Novel skeletal representation for articulated creatures",
}


@dataclass(frozen=True)
class Block:
    """A figure or table of a paper.

    Args:
        id: such as p2-fig-4, its anchor on the page.
        title: of it.
        printed: what the paper shows and says there.
        data: what stands in for the paper's data; empty where there are none.
        why_not: why it is not made again; empty if it is.
        extra: whether it is beside the tables and figures that measure or show results.
    """

    id: str
    title: str
    printed: str
    data: str = ""
    why_not: str = ""
    extra: bool = False

    @property
    def paper(self) -> str:
        """Its paper, p1 to p3."""
        return self.id.partition("-")[0]


_HAND = "made-up clouds of a hand as a stereo pair measures them; the paper's videos are not public"
_WALK = "a made-up walking figure of 4,500 points a scan; the paper's, by Pinocchio, is not public as scans"
_FOUR = "made-up scans of a walking figure, a robot, an excavator and a hand; the paper's are not public"
_CREATURE = "made-up starfish and octopuses, meshed anew in each frame; the paper's captured animals are not public"
_DRAWING = "a drawing of the method: nothing is measured in it"

BLOCKS = (
    Block("p1-fig-1", "Model, data, alignment", "model before, stereo points, aligned model", _HAND),
    Block("p1-fig-2", "Sliding of the skin", "a finger at a = 2, whose texture slides, and at a = 10, near rigid"),
    Block(
        "p1-fig-3", "Three sequences", "a hand rotates, and bends seen from palm and back; about 100 frames each", _HAND
    ),
    Block(
        "p1-timings",
        "Frames, data and inliers",
        "20 frames/s, 500 to 1,000 data a frame, about 250 inliers; no seconds given",
        _HAND,
    ),
    Block(
        "p1-rivals",
        "Section 4: other methods",
        "SoftAssign hangs on its outlier row and column, an estimated sigma is trapped; no numbers given",
        _HAND,
    ),
    Block(
        "p2-fig-1", "Source and target, result, weights", "two scans, the moved source, its weights", _WALK, extra=True
    ),
    Block(
        "p2-table-1",
        "Pairs registered, and seconds",
        "first try: car 85 of 89, robot 67 of 89, walk 167 of 189, hand 31 of 46; after retries 89, 85, 183 of the "
        "first three; seconds a pair 24.4, 50.6, 39.2, 53.7",
        _FOUR,
    ),
    Block("p2-fig-2", "Bones, weights, grid", "bones and weights on the grid around a scan", _WALK),
    Block("p2-fig-3", "Overview of the optimization", "the loop of T-step and W-step", why_not=_DRAWING, extra=True),
    Block("p2-fig-4", "Joint constraint on and off", "without it the scan does not register, with it it does", _WALK),
    Block("p2-fig-5", "Labels of cells", "grid cells as sites of a labeling", why_not=_DRAWING, extra=True),
    Block(
        "p2-fig-6",
        "Before and after weight refinement",
        "hard labels make the deformation discontinuous, smooth weights do not",
        _WALK,
    ),
    Block("p2-fig-7", "Examples of all sets", "car, robot, walk and hand: source, target, result, weights", _FOUR),
    Block("p2-fig-8", "Registration error in colors", "distance to the closest point, % of the diagonal", _FOUR),
    Block(
        "p2-fig-9",
        "Much motion and occlusion",
        "an arm, a torso or most of the surface is missing; all register",
        _FOUR,
    ),
    Block(
        "p2-fig-10",
        "Holes",
        "scans of a body, also with holes cut into them; both register",
        "a made-up walking figure, also with eight holes; the paper's body scans are not free",
    ),
    Block("p2-fig-11", "Failures", "local minima, parts glued together, both legs on one, too little data", _WALK),
    Block("p2-fig-12", "Posing", "handles on a registered scan are dragged to a new pose", _WALK),
    Block("p3-fig-1", "Subject, surface, skeleton, spine", "from a body to its spine over time", _CREATURE, extra=True),
    Block(
        "p3-fig-2",
        "The steps for a starfish",
        "surface, distance from a tip, level sets, tree, merged skeleton",
        _CREATURE,
    ),
    Block("p3-fig-3", "Level sets, metanodes", "clustering in 2-D; two trees merged", why_not=_DRAWING),
    Block("p3-fig-4", "Before and after imposing one graph", "skeletons of single frames, and the spine's", _CREATURE),
    Block("p3-fig-5", "Cameras", "the cage of twenty cameras", why_not="a photograph of the capture room"),
    Block("p3-fig-6", "Subjects", "baby, dog, camel: surface, distance, level sets, spine", _CREATURE),
    Block("p3-fig-7", "Tips found in each frame", "the number of tips per frame, most often the right one", _CREATURE),
    Block(
        "p3-timings",
        "Seconds",
        "under four minutes a mesh for the skeleton; correspondences ten minutes for 495 frames, else under three",
        _CREATURE,
    ),
)
# Pairs of each column of table 1, spread over its sequence: with all else about an hour on two cores.
DEFAULT_PAIRS = 100
BLOCK_IDS = tuple(block.id for block in BLOCKS)


@dataclass(frozen=True)
class PairSet:
    """A column of the second paper's table 1.

    Args:
        name: of it.
        dataset: of the trials that stand in for it.
        pairs: that the paper registers.
        first_try: of them, registered at first.
        retried: registered after retries with other parameters; None if the paper does not say.
        bones: B.
        correspondences: n.
        reach: largest distance of a correspondence, sampling distances.
        resolution: of the grid.
        seconds: per pair in total, on one core of 2006.
        near: whether scans are near enough for closest points to start from (RANSAC: N/A).
    """

    name: str
    dataset: str
    pairs: int
    first_try: int
    retried: int | None
    bones: int
    correspondences: int
    reach: float
    resolution: int
    seconds: float
    near: bool = False


# References: Chang and Zwicker 2009, table 1 and section 5.
PAIR_SETS = (
    PairSet("walk", "figure", 189, 167, 183, 7, 1000, 20.0, 50, 39.242),
    PairSet("robot", "robot", 89, 67, 85, 7, 1200, 40.0, 65, 50.591),
    PairSet("car", "car", 89, 85, 89, 7, 1200, 20.0, 60, 24.355),
    PairSet("hand", "hand", 46, 31, None, 12, 1500, 30.0, 40, 53.684, near=True),
)
