"""Articulated shapes as users make them: from parts, robot descriptions, rigs, and skinned meshes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.rigs import spec_from_arrays, spec_from_gltf
from torchreg.shapes.robots import spec_from_chain, spec_from_urdf
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.spec import ShapeSpec

if TYPE_CHECKING:
    from torchreg.shapes.kinematics import Chain


class ArticulatedShape(Articulation):
    """A kinematic tree with one solid per part, a fused surface, and 6 degrees of freedom for its base.

    A pose is a vector: base translation (metres), base rotation vector (radians), then the joints. Parts are the frames
    that carry a solid; the neighbors of a part are the next part above it in the tree and the next parts below. Only
    neighbors fuse, so two fingers may touch.

    The base moves the root of the tree: ``T_world_frame = T(translation) R(rotation vector) T_root_frame``, so it turns
    about the origin of the tree's coordinates (the file's origin), not about the root's frame.

    ``shape(pose)`` is a `ShapeOutput`: points of the surface, keypoints and part transforms. Parameters, which the
    state holds, are frozen until ``requires_grad_(True)``: `log_length_scales` and `log_radius_scales` (P,), zero for
    the shape as it came, `log_nu` and `log_sharpness` (). A state is loaded into a shape that is made alike.

    Args:
        tree: the kinematic tree.
        part_frames: names of the frames that carry a solid, one per part.
        primitives: one `Primitive` per part.
        nu: fusion length of the field in metres; about a quarter of a part's thickness fuses smoothly.
        sharpness: of the bending skin, a in eq. 3: 2 lets the skin slide and stretch, 10 is near rigid.
        part_names: names of the parts; the frame names by default.
        free_base: False pins the base at the origin (its six limits are zero).
        surface: mesh and skin weights of the file the shape came from, if any.
        dtype: of all parameters and buffers; the default dtype if None.

    Raises:
        ModelError: if parts and primitives do not match the tree.

    References: Dewaele et al. 2006, section 2.
    """

    @classmethod
    def from_spec(cls, spec: ShapeSpec, **options: Any) -> ArticulatedShape:
        """Return the shape of a `ShapeSpec` (tree, parts, solids, and the file's surface)."""
        given = {key: value for key, value in options.items() if value is not None}
        options = {"nu": spec.nu, "sharpness": spec.sharpness, **given}
        return cls(
            spec.tree, spec.part_frames, spec.primitives, part_names=spec.part_names, surface=spec.surface, **options
        )

    @classmethod
    def from_urdf(
        cls,
        path: str | Path,
        *,
        package_dirs: Sequence[str | Path] = (),
        primitive: str = "auto",
        meshes: str = "warn",
        free_base: bool = True,
        nu: float | None = None,
        dtype: torch.dtype | None = None,
    ) -> ArticulatedShape:
        """Return the shape of a robot: its URDF tree, with solids taken from primitives or fitted to link meshes.

        Args:
            path: the URDF file.
            package_dirs: folders in which meshes are looked up, beside the file's folder and those above.
            primitive: "auto" (the file's own solids, and for meshes the kind nearest to them) or the kind fitted to
                every link.
            meshes: what becomes of mesh files that are missing or need a reader that is not installed: "warn" leaves
                them out with a warning each, "skip" without, "require" raises.
            free_base: False if the robot's base is bolted to the origin.
            nu: fusion length, metres; from the parts' thickness by default.
            dtype: of the module; the default dtype if None.

        Returns:
            The shape. Degrees of freedom are called like the joints, parts like the links; links without geometry are
            frames but not parts, and the further solids of a link with several are parts LINK_1, LINK_2, ...

        Raises:
            FormatError: if a file is damaged or oversized, or a required mesh is missing.
            ModelError: if the tree is cyclic or non-finite, or no link has geometry.

        Warns:
            FileWarning: if something is left out or held fixed, see `load_urdf`.
        """
        spec = spec_from_urdf(path, package_dirs=package_dirs, primitive=primitive, meshes=meshes)
        return cls.from_spec(spec, free_base=free_base, nu=nu, dtype=dtype)

    @classmethod
    def from_chain(
        cls,
        chain: Chain,
        *,
        free_base: bool = True,
        nu: float | None = None,
        dtype: torch.dtype | None = None,
    ) -> ArticulatedShape:
        """Return the shape of a `pytorch_kinematics.Chain`: its tree, with the solids of its links or thin bones.

        Boxes, cylinders and spheres that links carry (chains from URDF and SDF files do) are taken as they are. Where
        a chain only names the geometry, as a mesh, and for every link of a chain without any, thin capsules run from
        the frame to those attached to it, a tenth of a median bone wide; a last frame gets a ball. Where the file is at
        hand, `from_urdf` keeps its meshes.

        Args:
            chain: of fixed, revolute and prismatic joints, such as ``pytorch_kinematics.build_chain_from_urdf`` gives.
            free_base: False if the base is bolted to the origin.
            nu: fusion length, metres; from the parts' thickness by default.
            dtype: of the module; the default dtype if None.

        Returns:
            The shape. Degrees of freedom have the names, order and limits of the chain's joints; parts are called like
            its frames, those of a frame's further solids FRAME_1, FRAME_2, ...

        Raises:
            InputTypeError: if something else is given.
            ModelError: if a joint is of another type, frames or joints share names, a number is not finite, or there is
                neither a solid nor two frames apart.
        """
        return cls.from_spec(spec_from_chain(chain), free_base=free_base, nu=nu, dtype=dtype)

    @classmethod
    def from_gltf(
        cls,
        path: str | Path,
        *,
        parents: Mapping[str, str | None] | None = None,
        axes: Mapping[str, Sequence[str | Sequence[float]]] | None = None,
        limits: Mapping[str, Sequence[tuple[float, float]]] | None = None,
        primitive: str = "ellipsoid",
        nu: float | None = None,
        dtype: torch.dtype | None = None,
        skin: str | int | None = None,
    ) -> ArticulatedShape:
        """Return the shape of a rigged glTF: its skeleton as tree, with solids fitted to the vertices of each joint.

        The rest pose (zeros) is the file's bind pose.

        Args:
            path: a .glb or .gltf file.
            parents: parent name of each joint (None: root), for files whose node hierarchy is flat.
            axes: rotation axes of each joint as "x", "y", "z" or unit vectors in joint coordinates; an empty list
                makes the joint rigid. Joints not named are balls: x, y, z in this order.
            limits: (lower, upper) in radians for each axis of a joint; unlimited by default.
            primitive: kind of the fitted solids.
            nu: fusion length, metres; from the parts' thickness by default.
            dtype: of the module; the default dtype if None.
            skin: name or number of the skin, where the file has several.

        Returns:
            The shape; `file_skin` gives the file's own skin.

        Raises:
            FormatError: if the file is damaged, oversized, or has no skin.
            ModelError: if the hierarchy is cyclic or flat, or a name is unknown.

        Warns:
            FileWarning: if part of the file was left out or put right; several roots hang on one.
        """
        spec = spec_from_gltf(path, parents=parents, axes=axes, limits=limits, primitive=primitive, skin=skin)
        return cls.from_spec(spec, nu=nu, dtype=dtype)

    @classmethod
    def from_skinned_mesh(
        cls,
        vertices: Tensor,
        faces: Tensor,
        weights: Tensor,
        joints: Tensor,
        parents: Sequence[int],
        *,
        joint_names: Sequence[str] | None = None,
        axes: Mapping[str, Sequence[str | Sequence[float]]] | None = None,
        limits: Mapping[str, Sequence[tuple[float, float]]] | None = None,
        primitive: str = "ellipsoid",
        nu: float | None = None,
        dtype: torch.dtype | None = None,
    ) -> ArticulatedShape:
        """Return the shape of a skinned mesh given as arrays, such as those of SMPL or MANO files.

        Args:
            vertices: (V, 3) in the bind pose, metres.
            faces: (F, 3) integer.
            weights: (V, J) skin weights, rows sum to one.
            joints: (J, 3) joint positions or (J, 4, 4) joint frames ``T_world_joint`` in the bind pose.
            parents: parent index of each joint, -1 (or, as in SMPL, 4294967295) for the root.
            joint_names: J names; "joint_0", ... by default.
            axes: see `from_gltf`.
            limits: see `from_gltf`.
            primitive: kind of the fitted solids.
            nu: fusion length, metres; from the parts' thickness by default.
            dtype: of the module; the default dtype if None.

        Returns:
            The shape; `file_skin` gives the linear blend skin of the given weights.

        Raises:
            InputError: if the arrays do not fit together.
            ModelError: if the hierarchy is cyclic or disconnected.
        """
        spec = spec_from_arrays(
            vertices, faces, weights, joints, parents,
            joint_names=joint_names, axes=axes, limits=limits, primitive=primitive,
        )  # fmt: skip
        return cls.from_spec(spec, nu=nu, dtype=dtype)

    def file_skin(self) -> LinearBlendSkin:
        """Return the skin of the file this shape was read from: its vertices under its weights.

        Its reference pose is all zeros, the pose of the file, whether or not the joint limits allow it.

        Raises:
            InputError: if the shape was not read from a file with a mesh.
        """
        if self.surface is None:
            raise InputError("this shape has no file skin: it was not read from a file with a mesh")
        vertices = self.surface.vertices.to(self.rest)
        faces = self.surface.faces.to(self.rest.device)
        return LinearBlendSkin(self, vertices, self.surface.weights, torch.zeros_like(self.rest), faces=faces)
