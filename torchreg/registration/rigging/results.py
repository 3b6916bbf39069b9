"""The rig of a sequence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from torchreg._checks import check_positive
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.upright import Direction
from torchreg.io.bvh import save_bvh
from torchreg.io.gltf_write import save_animated_skin
from torchreg.result import Result, Status, stored_as
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.record import build_shape, record_shape


@dataclass(frozen=True)
class SequenceRig(Result):
    """One skinned shape with its poses in T frames, in the unit and frame of the meshes.

    Args:
        shape: the rig; at rest it is the template frame. It aligns to further data, and can be tracked.
        poses: (T, num_dofs) of the frames; NaN in those that were left out.
        weights: (V, B) of the template's vertices, rows sum to one, four at most are not zero.
        joints: (B, 3) of the bones at rest; that of the root is the middle of what it moves.
        errors: (T,) mean two-way distance of the posed surface from the frame's, share of the template's diagonal.
        confidence: (T,) from 0 to 1, falls with the error: one half where a frame is doubtful. It is not calibrated.
        status: DOUBTFUL if frames are not explained; WITH_WARNINGS if frames were left out, or nothing bends.
        template: number of the frame that is the rig's surface.
        warnings: one sentence for each frame that is left out or not explained, and one if nothing bends.
        up: what is upright, where that is known.
    """

    shapes: ClassVar[Mapping[str, str]] = {
        "poses": "T D", "weights": "V B", "joints": "B 3", "errors": "T", "confidence": "T",
    }  # fmt: skip

    shape: ArticulatedShape = field(metadata=stored_as(record_shape, build_shape))
    poses: Tensor
    weights: Tensor
    joints: Tensor
    errors: Tensor
    confidence: Tensor
    status: Status
    template: int
    warnings: tuple[str, ...] = ()
    up: tuple[float, float, float] | None = None

    @property
    def parents(self) -> tuple[int, ...]:
        """The parent of each bone, -1 for the root."""
        return tuple(self.shape.part_parents)

    @torch.no_grad()
    def vertices(self) -> Tensor:
        """Return the surface (T, V, 3) in all frames; NaN in those that were left out."""
        found = self.poses.isfinite().all(-1)
        moved = self.poses.new_full((len(self.poses), len(self.weights), 3), torch.nan)
        moved[found] = torch.stack([self.shape.vertices(pose) for pose in self.poses[found]])
        return moved

    @torch.no_grad()
    def to_gltf(self, path: str | Path, *, fps: float = 30.0, up: Direction | None = None) -> Path:
        """Write a .glb file with one mesh, one skin and one clip, and return the path.

        A vertex has four influences at most. Frames that were left out are so in the clip.

        Args:
            path: to write; the suffix must be .glb.
            fps: frames per second.
            up: the axis that is upright, turned to glTF's y; the result's own by default.

        Raises:
            InputError: if the suffix is not .glb, or ``fps`` is not positive.
            FileNotFoundError: if the folder does not exist.
        """
        check_positive(fps, "fps")
        skin = self.shape.file_skin()
        faces = skin.faces
        if faces is None:
            raise InputError("the rig has no triangles to write")
        found = self.poses.isfinite().all(-1)
        rest = self.shape.rest_pose()
        return save_animated_skin(
            path,
            vertices=skin.points,
            faces=faces,
            weights=skin.weights,
            joint_names=self.shape.part_names,
            parents=self.parents,
            rest_transforms=self.shape.part_transforms(rest).double(),
            joint_transforms=self.shape.part_transforms(self.poses[found]).double(),
            times=found.nonzero()[:, 0].double() / fps,
            normals=TriangleMesh(skin.points, faces).vertex_normals(),
            most_weights=4,
            up=self.up if up is None else up,
        )

    @torch.no_grad()
    def to_bvh(self, path: str | Path, *, fps: float = 30.0, up: Direction | None = None) -> Path:
        """Write a .bvh file in which the bones turn as found, and return the path.

        In frames that were left out the pose before is held, which the format cannot leave out.

        Args:
            path: to write; the suffix must be .bvh.
            fps: frames per second.
            up: the axis that is upright, turned to y; the result's own by default.

        Raises:
            InputError: if the suffix is not .bvh, or ``fps`` is not positive.
            FileNotFoundError: if the folder does not exist.
        """
        found = self.poses.isfinite().all(-1)
        last = torch.where(found, torch.arange(len(found)), -1).cummax(0).values.clamp(min=int(found.nonzero()[0]))
        rest = self.shape.part_transforms(self.shape.rest_pose()).double()
        # Bones end beyond the middles of what they move.
        middles = (self.weights.mT @ self.shape.file_skin().points) / self.weights.sum(0)[:, None].clamp_min(1e-9)
        return save_bvh(
            path, self.shape.part_names, self.parents, rest,
            self.shape.part_transforms(self.poses[last]).double(), fps,
            ends=2 * middles.double() - rest[:, :3, 3], up=self.up if up is None else up,
        )  # fmt: skip
