"""Sizes of files of moving robots for viewers: python benchmarks/gltf_sizes.py [URDF ...].

Without files, the robots of example-robot-data are written, where they are installed (extra benchmark).
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from pathlib import Path

import torch
from public_shapes import robots_folder

import torchreg as tr
from torchreg.viz.gltf import save_shape_animation

ROBOTS = ("panda_description/urdf/panda.urdf", "ur_description/urdf/ur5_robot.urdf")
NUM_FRAMES = 20


def size(urdf: Path, folders: list[Path]) -> str:
    """Return the line on a robot: its name, the triangles and the file's megabytes."""
    shape = tr.ArticulatedShape.from_urdf(urdf, package_dirs=folders)
    if shape.surface is None:
        return f"{urdf.stem:20}  no meshes"
    generator = torch.Generator().manual_seed(0)
    poses = shape.rest_pose() + 0.05 * torch.randn(NUM_FRAMES, shape.num_dofs, generator=generator)
    with tempfile.TemporaryDirectory() as folder:
        path = save_shape_animation(Path(folder) / "a.glb", shape, poses, up=(0.0, 0.0, 1.0))
        return f"{urdf.stem:20}  {len(shape.surface.faces):8,} triangles  {path.stat().st_size / 1e6:5.2f} MB"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("urdf", nargs="*", type=Path)
    files, folders = parser.parse_args().urdf, []
    folder = robots_folder()
    if not files and folder is not None:
        files, folders = [folder / name for name in ROBOTS], [folder, folder.parent.parent]
    for file in files:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", tr.errors.FileWarning)
            print(size(file, folders))
    if not files:
        print("no robots: name URDF files, or install the extra benchmark")


if __name__ == "__main__":
    main()
