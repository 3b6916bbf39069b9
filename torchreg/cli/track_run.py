"""What ``torchreg track`` does: frames one after another, progress on disk, reports, outputs."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import typer

from torchreg.cli.known_options import Known
from torchreg.cli.outputs import check_outputs
from torchreg.cli.reporting import OptionalOutput, show_warning
from torchreg.cli.upright import remembering
from torchreg.cli.writers import Source, write_optional
from torchreg.errors import FormatError, InputError, UnitsWarning

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

    from torchreg.capture.depth_frames import DepthFrames
    from torchreg.capture.stereo_frames import StereoFrames
    from torchreg.cli.track_checkpoint import TrackProgress
    from torchreg.geometry.upright import Direction
    from torchreg.io.frames import Frames
    from torchreg.shapes.skin import LinearBlendSkin
    from torchreg.tracking.results import FrameResult, TrackResult, TrackState
    from torchreg.tracking.tracker import Tracker

    OnFrame = Callable[[Tensor, FrameResult], object]


@dataclass(frozen=True)
class TrackFiles:
    """Where the outputs go."""

    result: Path
    movie: Path | None
    gltf: Path | None
    pictures: Path | None
    poses: Path | None
    bvh: Path | None

    @property
    def progress(self) -> Path:
        """The file that keeps how far a run got."""
        return self.result.with_suffix(".progress")

    def frame(self, number: int) -> Path:
        """Return where the picture of a frame goes."""
        return (self.pictures or Path()) / f"frame_{number:04d}.png"

    def check(self, force: bool, resume: bool) -> bool:
        """Return whether an earlier run is resumed; raise if an output cannot be written or may not be overwritten."""
        resumed = resume and self.progress.exists()
        force = force or resumed
        if self.progress.exists() and not force:
            raise InputError(f"{self.progress} is how far an earlier run got; pass --resume to go on, or --force")
        others = self.result.with_suffix(".json"), self.movie, self.gltf, self.progress, self.poses, self.bvh
        check_outputs([self.result, *others], force)
        if self.pictures is not None:
            if self.pictures.is_dir():
                check_outputs([next(self.pictures.glob("frame_*.png"), None)], force)
            self.pictures.mkdir(exist_ok=True)
        return resumed


class Clouds(Sequence["Tensor"]):
    """The clouds (M, 3) in metres, empty where they cannot be read; far from zero they begin at `origin`."""

    def __init__(self, frames: Frames | StereoFrames | DepthFrames, floating: bool = True) -> None:
        self.names, self._frames, self._floating = frames.names, frames, floating
        self.on_drop: Callable[[int, str], None] | None = None
        self._contents: dict[int, str] = {}

    def content(self, index: int) -> str:
        """Return a digest of what a frame held when it was first asked for."""
        if index not in self._contents:
            self._contents[index] = self._frames.fingerprint(index)
        return self._contents[index]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: Any) -> Any:
        from torchreg.geometry.loaded import as_points

        return as_points(self.frame(index))

    @property
    def measured(self) -> Sequence[Any]:
        """What the tracker is given, each read when it is asked for."""
        return _Measured(self)

    def frame(self, index: Any) -> Any:
        """Return what the tracker is given: a cloud, or a depth picture, see `DepthFrame`."""
        try:
            found = self._frames[index]
            if self.origin is None:
                return found
            return found.near(self.origin) if hasattr(found, "near") else found.double() - self.origin
        except (FormatError, OSError) as error:
            if self.on_drop is not None:
                self.on_drop(index, " ".join(str(error).split()))
        import torch

        return torch.zeros(0, 3)

    @cached_property
    def origin(self) -> Tensor | None:
        """Where coordinates begin (3,), float64; None at zero."""
        from torchreg.geometry.far_origin import far_origin
        from torchreg.geometry.loaded import as_points

        for index in range(len(self) if self._floating else 0):
            try:
                first = as_points(self._frames[index])
            except (FormatError, OSError):
                continue
            if len(first):
                return far_origin(first)
        return None


class _Measured(Sequence["Tensor"]):
    """Clouds or depth pictures as the tracker is given them."""

    def __init__(self, clouds: Clouds) -> None:
        self._clouds = clouds

    def __len__(self) -> int:
        return len(self._clouds)

    def __getitem__(self, index: Any) -> Any:
        return self._clouds.frame(index)


@dataclass
class Report:
    """Prints how a run goes on, if ``quiet`` only what went wrong with files."""

    bar: Any
    clouds: Clouds
    quiet: bool
    usable: bool = True
    warned: bool = False

    def frame(self, result: FrameResult) -> None:
        """Show a frame that is done; say when the shape was lost and when it is back."""
        status = result.statuses[0]
        if not self.quiet:
            self.bar.update()
            self.bar.set_postfix_str(result.acquired)
            if status.usable != self.usable:
                what = f"back ({result.acquired})" if status.usable else status.value
                self.bar.write(f"{self.clouds.names[result.frame]}: {what}")
        self.usable = status.usable

    def dropped(self, number: int, reason: str) -> None:
        """Print that a frame cannot be read."""
        self.bar.clear()
        typer.echo(f"torchreg: warning: frame {number} is dropped: {reason}", err=True)

    @contextmanager
    def warnings(self) -> Iterator[None]:
        """Print the first warning of other units only: all frames have the same."""

        def show(
            message: Warning | str, category: type[Warning], filename: str, lineno: int, file: TextIO | None = None,
            line: str | None = None,
        ) -> None:  # fmt: skip
            if not (self.warned and issubclass(category, UnitsWarning)):
                self.bar.clear()
                show_warning(message, category, filename, lineno)
            self.warned = self.warned or issubclass(category, UnitsWarning)

        with warnings.catch_warnings():
            warnings.showwarning = show
            yield


@dataclass
class TrackRun:
    """Tracks frame after frame, and keeps on disk how far it got."""

    tracker: Tracker
    clouds: Clouds
    fps: float
    job: dict[str, Any]  # all that decides about the poses, as plain data
    files: TrackFiles
    report: Report
    save_every: int  # frames between two writings
    known: Known
    up: Direction | None
    smooth: bool = False  # whether all frames count for each at the end
    seen: Callable[[LinearBlendSkin], OnFrame] | None = None  # draws what the cameras saw of a frame
    live: Callable[[LinearBlendSkin], OnFrame] | None = None  # shows a frame in the browser
    parts: list[TrackResult] = field(default_factory=list)  # results of the frames done
    state: TrackState = field(init=False)

    def __post_init__(self) -> None:
        self.state = self.tracker.state

    @property
    def result(self) -> TrackResult:
        """All frames done."""
        from torchreg.cli.track_checkpoint import join_frames

        self.parts[:] = [reduce(join_frames, self.parts)]
        return self.parts[0]

    @property
    def located(self) -> TrackResult:
        """All frames done, in the coordinates of the files."""
        origin = self.clouds.origin
        return self.result if origin is None else self.result.moved(origin)

    @cached_property
    def surface(self) -> LinearBlendSkin:
        """What pictures show, meshed once."""
        from torchreg.viz.posed_scenes import coarse_skin

        return coarse_skin(self.tracker.shape)

    def go_on(self, progress: TrackProgress) -> None:
        """Begin where an earlier run of the same command ended."""
        done = len(progress.result.statuses)
        frames = {"frames": self.job["frames"][:done]}
        before = {**progress.job, "frames": progress.job.get("frames", [])[:done]}
        changed = [name for name, value in {**self.job, **frames}.items() if before.get(name) != value]
        if changed:
            raise InputError(
                f"{self.files.progress} was written by another command: {', '.join(changed)} differ; repeat that one, "
                f"or pass --force without --resume to begin anew"
            )
        known = enumerate(progress.contents)
        other = [self.clouds.names[number] for number, content in known if content != self.clouds.content(number)]
        if other:
            names = ", ".join(other[:5]) + (f" and {len(other) - 5} more" if len(other) > 5 else "")
            raise InputError(
                f"{names} changed since {self.files.progress} was written; bring the frames back, or pass --force "
                f"without --resume to begin anew"
            )
        self.tracker.state = self.state = progress.state
        self.parts = [replace(progress.result, shape=self.tracker.shape)]
        self.report.usable = progress.result.statuses[-1].usable
        self.report.bar.update(done)

    def run(self, resumed: bool) -> bool:
        """Track all frames, write what belongs to a complete run, and return whether it is; what is done is on disk."""
        from torchreg.cli.track_checkpoint import TrackProgress, load_progress, save_progress

        if resumed:
            self.go_on(load_progress(self.files.progress))
        self.clouds.on_drop = self.report.dropped
        complete = True
        while complete and self.state.frame < len(self.clouds):
            end = min(self.state.frame + self.save_every, len(self.clouds))
            with self.report.warnings():
                self._part(range(self.state.frame, end))
            complete = self.state.frame == end
            contents = [self.clouds.content(number) for number in range(self.state.frame)]
            with OptionalOutput(self.files.progress):
                save_progress(self.files.progress, TrackProgress(self.result, self.state, self.job, contents))
        self.clouds.on_drop = None
        if complete and self.smooth:
            self._smooth()
        remembering(self.located, self.up).save(self.files.result)
        if complete:
            self.report.bar.reset(len(self.clouds))
            self.report.bar.set_description("drawing")
            self.write([self.files.gltf, self.files.movie])
        return complete

    def _smooth(self) -> None:
        """Replace the poses of all frames by those of a second pass."""
        from torchreg.tracking.smoother import smooth_track

        self.report.bar.set_description("smoothing")
        given = self.known.part(range(len(self.clouds)), self.clouds.origin)
        self.parts = [smooth_track(self.result, self.clouds.measured, config=self.tracker.config, **given)]

    def _part(self, numbers: range) -> None:
        """Track some frames; fewer are done if the keyboard interrupts."""
        from torchreg.cli.track_checkpoint import first_frames

        def note(points: Tensor, frame: FrameResult) -> None:
            for optional, overlay in self._overlays:
                if not optional.failed:
                    with optional:
                        overlay(points, frame)
            self.report.frame(frame)
            # A frame counts as done when all of it is.
            self.state = self.tracker.state

        times = [number / self.fps for number in numbers]
        try:
            frames = (self.clouds.frame(number) for number in numbers)
            result = self.tracker.run(frames, note, times=times, **self.known.part(numbers, self.clouds.origin))
        except KeyboardInterrupt:
            if not self.parts:
                raise
            return
        done = self.state.frame - numbers.start
        if not done and not self.parts:
            raise KeyboardInterrupt
        self.parts.append(first_frames(result, done))

    @cached_property
    def _overlays(self) -> list[tuple[OptionalOutput, OnFrame]]:
        """What draws each frame as soon as it is done; made after the first, when the fitted shape is known."""
        drawn = []
        pictures = None if self.files.pictures is None else self._drawn
        for name, begin in (("what was seen", self.seen), ("the page", self.live), ("--pictures", pictures)):
            optional = OptionalOutput(name)
            with optional:
                drawn += [(optional, begin(self.surface))] if begin is not None else []
        return drawn

    def _drawn(self, surface: LinearBlendSkin) -> OnFrame:
        from torchreg.viz.tracking import FrameOverlays

        overlays = FrameOverlays(self.tracker.shape, surface, up=self.up)
        return lambda points, frame: overlays.save(self.files.frame(frame.frame), points, frame)

    def write(self, paths: Iterable[Path | None]) -> None:
        """Write files of what is done, but no motion of a shape that was never found."""
        found = bool(self.result.poses.isfinite().all(-1).any())
        source = Source(
            [self.located], self.clouds, self.tracker.shape, up=self.up, fps=self.fps, local=self.result,
            coarse=lambda: self.surface, on_frame=lambda done, planned: self.report.bar.update(),
        )  # fmt: skip
        write_optional([path for path in paths if path and (found or path.suffix not in (".glb", ".bvh"))], source)


def summary(result: TrackResult) -> str:
    """Return what became of the frames, and the usual time for one, in one line."""
    usable = sum(status.usable for status in result.statuses)
    unusable = Counter(status.value for status in result.statuses if not status.usable)
    counts = [f"{usable} tracked", *(f"{count} {name}" for name, count in unusable.items())]
    # Searches dominate the mean.
    usual = 1e3 * float(result.seconds.median())
    number = f"{len(result.statuses)} frame{'s' * (len(result.statuses) > 1)}"
    return f"{number}: {', '.join(counts)}; {usual:.0f} ms per frame"
