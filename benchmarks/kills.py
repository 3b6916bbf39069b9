"""Work that is killed: sweeps on every engine, and a tracker, go on without losing or repeating anything.

- local, slurm, ray: 24 trials; the driver, and now and then a worker, is ended by SIGKILL at random times, and the same
  command given again, until all is done. Lost: trials without a record. Repeated: trials that began again after
  they had one. Starts beyond 24 are trials that were interrupted. Slurm is its local stand-in.
- track: `torchreg track` is killed, and goes on with --resume; the result is compared bit by bit.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NUM_TRIALS = 24
ENGINES = {
    "local": ("--engine", "local"),
    "slurm": ("--engine", "slurm", "--slurm", "cluster=local"),
    "ray": ("--engine", "ray"),
}
_CONFIG = """name: kills
task: probe
question: does a sweep that is killed lose anything
trial: {{seconds: {seconds}, log: {log}}}
seeds: {count}
"""


@dataclass
class Campaign:
    """What became of a sweep under fire."""

    engine: str
    drivers: int = 0
    workers: int = 0
    lost: int = 0
    repeated: int = 0
    starts: int = 0
    seconds: float = 0.0
    note: str = ""

    def __str__(self) -> str:
        return (
            f"{self.engine:6s} {self.drivers:3d} drivers and {self.workers} workers killed; {self.starts} starts; "
            f"lost {self.lost}, repeated {self.repeated}; {self.seconds:.0f} s{self.note}"
        )


def descendants(process: int) -> list[int]:
    """Return the numbers of the processes that a process began, and those that they began; Linux alone."""
    found: list[int] = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = path.read_text().rpartition(")")[2].split()
            if int(fields[1]) == process:
                child = int(path.parent.name)
                found += [child, *descendants(child)]
    return found


def command(engine: str, config: Path, results: Path) -> list[str]:
    """Return the command of a sweep."""
    return [
        sys.executable, "-m", "experiments", "sweep", str(config), *ENGINES[engine], "--jobs", "2", "--results",
        str(results),
    ]  # fmt: skip


def begin(arguments: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start a process that prints nothing, in a session of its own."""
    env = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        arguments, cwd=ROOT, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )


def num_records(results: Path) -> int:
    return len(list((results / "kills" / "trials").glob("*.json")))


def run_campaign(engine: str, folder: Path, kills: int, count: int, limit: float, draw: random.Random) -> Campaign:
    """Return the counts of a sweep that is killed some times and then goes on to its end."""
    from experiments.store import Store

    log, config, results = folder / "log", folder / "kills.yaml", folder / "results"
    config.write_text(_CONFIG.format(seconds=0.4, log=log, count=count))
    found, began = Campaign(engine), time.perf_counter()
    while time.perf_counter() - began < limit:
        driver, before = begin(command(engine, config, results)), num_records(results)
        wanted = min(count, before + draw.randint(2, 4)) if found.drivers < kills else count + 1
        killed_worker = found.workers > found.drivers
        while driver.poll() is None and num_records(results) < wanted and time.perf_counter() - began < limit:
            time.sleep(0.05)
            if not killed_worker and num_records(results) > before and engine == "local":
                children = [child for child in descendants(driver.pid) if "spawn_main" in _words(child)]
                if children:
                    os.kill(draw.choice(children), signal.SIGKILL)
                    found.workers, killed_worker = found.workers + 1, True
        if driver.poll() is not None:
            break
        time.sleep(draw.random() * 0.4)
        driver.kill()
        driver.wait()
        found.drivers += 1
    else:
        found.note = f"; stopped after {limit:.0f} s"
    found.seconds = time.perf_counter() - began
    store = Store(results / "kills")
    records, _ = store.records()
    done = {record.seed: store.record_path(record.id).stat().st_mtime for record in records if record.status == "done"}
    starts = [line.split() for line in log.read_text().splitlines()] if log.exists() else []
    found.lost, found.starts = count - len(done), len(starts)
    found.repeated = sum(float(moment) > done.get(int(seed), float("inf")) for seed, moment in starts)
    return found


def _words(process: int) -> str:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def run_track(folder: Path, kills: int, num_frames: int, draw: random.Random) -> str:
    """Return what became of a tracker that was killed some times."""
    import torch

    import torchreg as tr
    from torchreg.datasets.hand import hand_motion, make_hand_cloud
    from torchreg.io.frames import save_frames

    hand = tr.Hand()
    poses = hand_motion(hand, "bend", num_frames)
    clouds = [make_hand_cloud(hand, pose, num_points=300, camera=torch.zeros(3)).points for pose in poses]
    save_frames(folder / "frames.npz", clouds)
    (folder / "start.json").write_text(str(poses[0].tolist()))

    def track(name: str, *options: str) -> list[str]:
        return [
            sys.executable, "-m", "torchreg", "track", "hand", str(folder / "frames.npz"), "-o", str(folder / name),
            "--start", str(folder / "start.json"), "--movie", "none", "--no-gltf", "--save-every", "1", *options,
        ]  # fmt: skip

    begin(track("whole")).wait()
    progress, done = folder / "killed.progress", 0
    while done < kills:
        process, before = begin(track("killed", "--resume")), progress.stat().st_mtime if progress.exists() else 0.0
        while process.poll() is None and (not progress.exists() or progress.stat().st_mtime <= before):
            time.sleep(0.01)
        time.sleep(draw.random() * 0.2)
        if process.poll() is not None:
            break
        process.kill()
        process.wait()
        done += 1
    begin(track("killed", "--resume")).wait()
    whole, found = (tr.load(folder / f"{name}.safetensors") for name in ("whole", "killed"))
    equal = torch.equal(whole.poses, found.poses) and whole.statuses == found.statuses
    left = [path.name for path in folder.iterdir() if path.name.endswith((".part", ".lock"))]
    lost = len(whole.statuses) - len(found.statuses)
    bits = "equal" if equal else "DIFFER"
    return f"track  {done:3d} kills; frames lost {lost}; bits {bits}; files left over: {left or 0}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", action="append", choices=list(ENGINES), help="of the sweeps; by default all")
    parser.add_argument("--kills", type=int, default=4, help="of drivers, per engine")
    parser.add_argument("--track-kills", type=int, default=8)
    parser.add_argument("--limit", type=float, default=300.0, help="seconds per engine, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="a version of seconds: one engine, one kill, six trials")
    options = parser.parse_args(arguments)
    engines, kills, count, track_kills = options.engine or list(ENGINES), options.kills, NUM_TRIALS, options.track_kills
    if options.smoke:
        engines, kills, count, track_kills = ["local"], 1, 6, 0
    sys.path.insert(0, str(ROOT))
    draw = random.Random(options.seed)
    print(f"{count} trials per engine")
    for engine in engines:
        with tempfile.TemporaryDirectory() as name:
            print(run_campaign(engine, Path(name), kills, count, options.limit, draw), flush=True)
    if track_kills:
        with tempfile.TemporaryDirectory() as name:
            print(run_track(Path(name), track_kills, 16, draw))


if __name__ == "__main__":
    main()
