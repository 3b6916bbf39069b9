"""Files from strangers: crafted ones that ask for too much, and valid ones damaged at random.

Every reader may raise the errors of torchreg, or an OSError of the file system, and nothing else. Crafted files, all
below 10 MB, are read one by one, with the peak of the memory and the processor time taken. The fuzzer changes, cuts,
repeats and joins the bytes of small valid files of every format, and counts what leaks, warns or takes long.
"""

from __future__ import annotations

import argparse
import ctypes
import faulthandler
import gc
import random
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from crafted_files import Read, crafted

import torchreg as tr
from torchreg.errors import FileWarning, TorchregError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.calibration import load_depth_camera, save_cameras, save_depth_camera
from torchreg.io.cameras.colmap import save_colmap
from torchreg.io.cameras.opencv_yaml import save_opencv
from torchreg.io.frames import load_frames, save_frames
from torchreg.io.gltf import load_rig
from torchreg.io.images import load_depth, load_image, load_mask, save_depth, save_image
from torchreg.io.points import load_points, save_points
from torchreg.io.swc import load_swc, save_swc
from torchreg.io.urdf import load_urdf
from torchreg.storage import load_pose
from torchreg.viz.gltf import save_shape_animation

BAR_BYTES, BAR_SECONDS = 500e6, 3.0
SLOW_SECONDS = 2.0  # of a damaged file of some kB
SMOKE_SHARE = 0.2  # of crafted files that are read to the end, and of the memory that they may take
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def reset_peak() -> None:
    """Give freed memory back and forget the peak of this process; Linux alone."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    _RESET.write_text("5")


def memory(name: str) -> float:
    """Return an entry of the kernel's record of this process, bytes: VmHWM is the peak."""
    return 1024.0 * next(int(row.split()[1]) for row in _STATUS.read_text().splitlines() if row.startswith(name))


@dataclass
class Outcome:
    """How the reading of a crafted file ended."""

    name: str
    size: int
    peak: float
    seconds: float
    end: str
    leaked: bool
    bar: float

    def __str__(self) -> str:
        kept = self.peak <= self.bar and self.seconds <= BAR_SECONDS and not self.leaked
        return (
            f"{self.name:26s} {self.size / 1e3:9.1f} kB {self.peak / 1e6:6.0f} MB {self.seconds:5.2f} s  "
            f"{'ok ' if kept else 'BAD'}  {self.end}"
        )


def read_crafted(path: Path, read: Read, share: float) -> Outcome:
    """Return how a file was read, with memory and time taken; a share of a file may take that of the memory."""
    reset_peak()
    before, begin, leaked = memory("VmRSS"), time.process_time(), False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FileWarning)  # what is left out is told, as it should
            read(path)
        end = "read"
    except (TorchregError, OSError) as error:
        end = f"{type(error).__name__}: {str(error).replace(str(path.parent), '')[:70]}"
    except Exception as error:  # noqa: BLE001 what must not happen is what is counted
        end, leaked = f"LEAK {type(error).__name__}: {error!s:.60}", True
    peak, seconds = memory("VmHWM") - before, time.process_time() - begin
    return Outcome(path.name, path.stat().st_size, peak, seconds, end, leaked, share * BAR_BYTES)


def valid_files(folder: Path) -> list[tuple[Path, Read]]:
    """Write a small valid file of every format and return each with its reader."""
    ball = unit_sphere(1)
    points, hand = ball.vertices, tr.Hand()
    cameras = [Camera(6, 5, (4.0, 4.0, 3.0, 2.5), name=name) for name in ("left", "right")]
    found: list[tuple[Path, Read]] = []

    def add(name: str, write: Callable[[Path], object], read: Read) -> None:
        path = folder / name
        write(path)
        found.append((path, read))

    def export(path: Path) -> None:
        tr.to_trimesh(ball).export(path)

    for ending in ("ply", "pcd", "xyz", "obj", "stl", "glb", "npz"):
        write = export if ending in ("obj", "stl", "glb") else lambda path: save_points(path, points)
        add(f"cloud.{ending}", write, load_points)
    scan = "2\n3\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n5 6 7 1\n" + "0.1 0.2 0.3 0.5 9 8 7\n" * 5
    add("cloud.ptx", lambda path: path.write_text(2 * (scan + "0 0 0 0.5 0 0 0\n")), load_points)
    add("frames.npz", lambda path: save_frames(path, [points, points[:9]]), lambda path: list(load_frames(path)))
    add("cameras.json", lambda path: save_cameras(path, CameraRig(tuple(cameras))), tr.load_cameras)
    add("depth.json", lambda path: save_depth_camera(path, cameras[0]), load_depth_camera)
    add("lens.yml", lambda path: save_opencv(path, CameraRig((cameras[0],))), tr.load_cameras)
    picture = torch.rand(5, 6, 3, generator=torch.Generator().manual_seed(0))
    add("picture.png", lambda path: save_image(path, picture), load_image)
    add("mask.png", lambda path: save_image(path, picture[..., 0] > 0.5), load_mask)
    add("depth.png", lambda path: save_depth(path, 1 + picture[..., 0]), load_depth)
    add("depth.npy", lambda path: path.write_bytes(_npy_bytes(picture[..., 0])), load_depth)
    add("mask.npy", lambda path: path.write_bytes(_npy_bytes(picture[..., 0])), load_mask)
    add("tree.swc", lambda path: save_swc(path, tr.skeletonize(ball)), load_swc)
    add("robot.urdf", lambda path: path.write_text(_ROBOT), lambda path: load_urdf(path))
    add(
        "part.stl",
        export,
        lambda path: load_urdf(path.with_name("stl.urdf")),
    )
    add(
        "part.ply",
        export,
        lambda path: load_urdf(path.with_name("ply.urdf")),
    )
    add(
        "part.obj",
        export,
        lambda path: load_urdf(path.with_name("obj.urdf")),
    )
    add(
        "part.glb",
        export,
        lambda path: load_urdf(path.with_name("glb.urdf")),
    )
    for ending in ("stl", "ply", "obj", "glb"):
        (folder / f"{ending}.urdf").write_text(_MESH_ROBOT.format(ending=ending))
    add("rig.glb", lambda path: save_shape_animation(path, hand, hand.rest_pose().repeat(2, 1)), load_rig)
    starts = tr.PoseStarts(hand.rest_pose()[None], torch.zeros(1), torch.ones(()))
    add("result.json", lambda path: starts.save(path.with_suffix(".safetensors")), lambda path: tr.load(
        path.with_suffix(".safetensors")
    ))  # fmt: skip
    found.append((folder / "result.safetensors", tr.load))
    add("pose.json", lambda path: path.write_text(str(hand.rest_pose().tolist())), lambda path: load_pose(path, hand))
    (folder / "model").mkdir()
    save_colmap(folder / "model", CameraRig(tuple(cameras)))
    found += [(folder / "model" / name, lambda path: tr.load_cameras(path.parent)) for name in _COLMAP]
    return found


def _npy_bytes(values: torch.Tensor) -> bytes:
    import io

    import numpy as np

    stream = io.BytesIO()
    np.save(stream, values.numpy())
    return stream.getvalue()


_COLMAP = ("cameras.txt", "images.txt")
_ROBOT = """<robot name="r"><link name="a"><visual><origin xyz="0 0 1" rpy="0 1 0"/><geometry><box size="1 2 3"/>
</geometry></visual></link><link name="b"/><link name="c"/><joint name="j" type="revolute"><parent link="a"/>
<child link="b"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint><joint name="k" type="prismatic">
<parent link="b"/><child link="c"/><mimic joint="j" multiplier="2" offset="0.1"/></joint></robot>"""
_MESH_ROBOT = (
    '<robot name="r"><link name="a"><visual><geometry><mesh filename="part.{ending}"/></geometry></visual></link>'
    "</robot>"
)
_WORDS = (
    b"nan", b"inf", b"-1", b"0", b"1e308", b"1e400", b"9" * 30, b"9" * 4500, b"\xff", b"\0\0\0\0", b"\xff\xff\xff\xff",
    b"[]", b"{}", b"null", b"true", b'"', b"\\ud800", b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f", b"()", b",", b"\n",
)  # fmt: skip


def damaged(content: bytes, other: bytes, draw: random.Random) -> bytes:
    """Return content with one to four defects: bytes and words changed, cut off, repeated, or taken from elsewhere."""
    data = bytearray(content)
    for _ in range(draw.randint(1, 4)):
        where = draw.randrange(len(data) + 1)
        end = min(len(data), where + draw.choice((1, 1, 2, 4, 16, 64)))
        kind = draw.randrange(7)
        if kind == 0 and where < len(data):
            data[where] ^= 1 << draw.randrange(8)
        elif kind == 1:
            data[where:end] = draw.randbytes(end - where)
        elif kind == 2:
            data[where:end] = draw.choice(_WORDS)
        elif kind == 3:
            data[where:where] = draw.choice(_WORDS)
        elif kind == 4:
            del data[where : draw.choice((end, len(data)))]
        elif kind == 5:
            data[where:where] = data[where:end] * draw.choice((1, 2, 50))
        else:
            start = draw.randrange(len(other) + 1)
            data[where:end] = other[start : start + end - where]
    return bytes(data)


@dataclass
class Count:
    """What became of the damaged files of one format."""

    read: int = 0
    refused: int = 0
    slow: int = 0
    leaks: Counter[str] = field(default_factory=Counter)


def fuzz(path: Path, read: Read, other: bytes, count: int, seconds: float, draw: random.Random) -> Count:
    """Return what became of damaged versions of a valid file, at most so many, and for so long."""
    content, found, begin = path.read_bytes(), Count(), time.perf_counter()
    try:
        for _ in range(count):
            if time.perf_counter() - begin > seconds:
                break
            path.write_bytes(damaged(content, other, draw))
            started = time.perf_counter()
            faulthandler.dump_traceback_later(
                60, exit=True, file=sys.__stderr__
            )  # what hangs ends the run, and tells where
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    warnings.simplefilter("ignore", FileWarning)  # what is left out is told, as it should
                    read(path)
                found.read += 1
            except (TorchregError, OSError):
                found.refused += 1
            except Exception as error:  # noqa: BLE001 what must not happen is what is counted
                place = traceback.extract_tb(error.__traceback__)
                own = [row for row in place if "/torchreg/" in row.filename][-1]
                found.leaks[f"{type(error).__name__} at {Path(own.filename).name}:{own.lineno} ({error!s:.60})"] += 1
            finally:
                faulthandler.cancel_dump_traceback_later()
            found.slow += time.perf_counter() - started > SLOW_SECONDS
    finally:
        path.write_bytes(content)
    return found


def main(arguments: Sequence[str] | None = None) -> list[Outcome]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=5000, help="damaged files per format")
    parser.add_argument("--seconds", type=float, default=20.0, help="at most, per format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="a version of seconds")
    options = parser.parse_args(arguments)
    count, seconds, share = (4, 0.4, SMOKE_SHARE) if options.smoke else (options.count, options.seconds, 1.0)
    outcomes = []
    with tempfile.TemporaryDirectory() as name:
        if _RESET.exists():
            (Path(name) / "crafted").mkdir()
            gc.freeze()  # what is there already, and need not be looked at before every file
            print(f"crafted files: at most {BAR_BYTES / 1e6:.0f} MB and {BAR_SECONDS:g} s each")
            for path, read, size in crafted(Path(name) / "crafted", share):
                outcomes.append(read_crafted(path, read, size))
                print(outcomes[-1])
                path.unlink()
            gc.unfreeze()
        else:
            print("crafted files: skipped, their memory is measured on Linux alone")
        draw, files = random.Random(options.seed), valid_files(Path(name))
        others = [path.read_bytes() for path, _ in files]
        print(f"\n{'damaged':20s} {'inputs':>7s} {'read':>7s} {'refused':>7s} {'> 2 s':>6s} {'leaks':>6s}")
        total = Count()
        for number, (path, read) in enumerate(files):
            found = fuzz(path, read, others[number - 1], count, seconds, draw)
            leaks = sum(found.leaks.values())
            inputs = found.read + found.refused + leaks
            print(f"{path.name:20s} {inputs:7d} {found.read:7d} {found.refused:7d} {found.slow:6d} {leaks:6d}")
            total.read, total.refused, total.slow = (
                total.read + found.read, total.refused + found.refused, total.slow + found.slow,
            )  # fmt: skip
            total.leaks += found.leaks
        leaks = sum(total.leaks.values())
        print(f"all: {total.read + total.refused + leaks} inputs, leaks {leaks}, hangs 0, {total.slow} above 2 s")
        for what, times in total.leaks.most_common():
            print(f"  {times} x {what}")
    return outcomes


if __name__ == "__main__":
    main()
