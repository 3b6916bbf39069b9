"""Articulated shapes as users make them: from parts, robot descriptions, rigs, and skinned meshes."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_direction, check_finite, check_shape
from torchreg._threads import one_thread
from torchreg.errors import InputError
from torchreg.geometry.upright import Y_UP
from torchreg.io.clouds.npz import load_arrays
from torchreg.io.file_format import naming
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.bone_space import bone_space
from torchreg.shapes.rigs import spec_from_arrays, spec_from_gltf
from torchreg.shapes.robots import spec_from_chain, spec_from_urdf
from torchreg.shapes.shape_space import ShapeSpace
from torchreg.shapes.shaped import ShapedTree, blended
from torchreg.shapes.shaped_rig import Coefficients, ShapeDirs, person_spec, save_rig
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.spec import RigSurface, ShapeSpec

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
        space: rest states of the rig by shape coefficients, if it has any.
        up: what is upright in the coordinates of the tree, see `UprightRotations`.
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
            spec.tree, spec.part_frames, spec.primitives, part_names=spec.part_names, surface=spec.surface,
            up=spec.up, **options,
        )  # fmt: skip

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
            package_dirs: folders in which meshes are looked up, besides the file's folder and those above.
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
        cls, chain: Chain, *, free_base: bool = True, nu: float | None = None, dtype: torch.dtype | None = None
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

        All skins of the file are one shape. The rest pose (zeros) is the file's bind pose, standing in its scene as a
        viewer shows it, y up. Meshes that hang on joints without a skin are rigid parts; in a file without any skin,
        the nodes that a clip turns or slides, or all nodes with a mesh where one hangs on another, are the joints.

        Args:
            path: a .glb or .gltf file.
            parents: parent name of each joint (None: root), for files whose node hierarchy is flat.
            axes: rotation axes of each joint as "x", "y", "z" or unit vectors in joint coordinates; an empty list
                makes the joint rigid. Joints not named are balls: x, y, z in this order.
            limits: (lower, upper) in radians for each axis of a joint; unlimited by default.
            primitive: kind of the fitted solids.
            nu: fusion length, metres; from the parts' thickness by default.
            dtype: of the module; the default dtype if None.
            skin: name or number of the one skin to read, where the file has several; all by default.

        Returns:
            The shape; `file_skin` gives the file's own skin. Its solids are refined when they are first asked for.

        Raises:
            FormatError: if the file is damaged, oversized, or compressed by what is not read or not installed.
            ModelError: if nothing in it moves, the hierarchy is cyclic or flat, or a name is unknown.

        Warns:
            FileWarning: if part of the file was left out or put right; several roots hang on one; joints have one name,
                or scale their part of the skin unlike others, which is baked into the rest pose unless it is little.
        """
        with one_thread():
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
        shape_dirs: ShapeDirs | None = None,
        joint_dirs: Tensor | None = None,
        joint_regressor: Tensor | None = None,
        coefficient_names: Sequence[str] | None = None,
        coefficient_std: Tensor | float = 1.0,
        primitive: str = "ellipsoid",
        up: Sequence[float] = Y_UP,
        nu: float | None = None,
        dtype: torch.dtype | None = None,
    ) -> ArticulatedShape:
        """Return the shape of a skinned mesh given as arrays, such as those of SMPL or MANO files.

        With ``shape_dirs`` the rest state depends on K coefficients c: vertices ``vertices + shape_dirs @ c`` and
        joints ``joints + joint_dirs @ c``, or ``joint_regressor @ vertices``. Offsets that depend on the pose, as SMPL
        has, are left out.

        Args:
            vertices: (V, 3) in the bind pose, metres.
            faces: (F, 3) integer.
            weights: (V, J) skin weights, rows sum to one.
            joints: (J, 3) joint positions or (J, 4, 4) joint frames ``T_world_joint`` in the bind pose.
            parents: parent index of each joint, -1 (or, as in SMPL, 4294967295) for the root.
            joint_names: J names; "joint_0", ... by default.
            axes: see `from_gltf`.
            limits: see `from_gltf`.
            shape_dirs: (V, 3, K) metres per unit of each coefficient; or a function of coefficients (..., K), named by
                ``coefficient_names``, that returns vertices (..., V, 3) and joints (..., J, 3), whose mean is at zero.
            joint_dirs: (J, 3, K), with ``shape_dirs``.
            joint_regressor: (J, V), in place of ``joint_dirs``.
            coefficient_names: K names; "shape_0", ... by default.
            coefficient_std: standard deviation of the coefficients' prior about zero, one number or (K,); a fit keeps
                them within five of it.
            primitive: kind of the fitted solids.
            up: (3,) what is upright in the coordinates of the arrays, y as in SMPL and glTF by default.
            nu: fusion length, metres; from the parts' thickness by default.
            dtype: of the module; the default dtype if None.

        Returns:
            The shape; `file_skin` gives the linear blend skin of the given weights.

        Raises:
            InputError: if the arrays do not fit together.
            ModelError: if the hierarchy is cyclic or disconnected.

        References: Loper et al. 2015, SMPL, eqs. 2 to 10, for coefficients.
        """
        spec = spec_from_arrays(
            vertices, faces, weights, joints, parents,
            joint_names=joint_names, axes=axes, limits=limits, primitive=primitive, up=check_direction(up, "up"),
        )  # fmt: skip
        coefficients = Coefficients(
            shape_dirs=shape_dirs, joint_dirs=joint_dirs, joint_regressor=joint_regressor, names=coefficient_names,
            std=coefficient_std,
        )  # fmt: skip
        positions = as_float_tensor(joints, "joints").double()
        positions = positions if positions.ndim == 2 else positions[:, :3, 3]
        names = [f"joint_{index}" for index in range(len(positions))] if joint_names is None else list(joint_names)
        space = coefficients.space(spec.tree, as_float_tensor(vertices, "vertices").double(), positions, names)
        return cls.from_spec(spec, nu=nu, dtype=dtype, space=space)

    @classmethod
    def from_npz(
        cls,
        path: str | Path,
        *,
        num_coefficients: int = 10,
        joint_names: Sequence[str] | None = None,
        nu: float | None = None,
        dtype: torch.dtype | None = None,
    ) -> ArticulatedShape:
        """Return the shape of a body or hand model in an .npz file with the arrays of SMPL, SMPL-X, MANO or MHR.

        Read are ``v_template`` (V, 3), ``f`` (F, 3), ``weights`` (V, J), ``kintree_table`` (2, J) and ``J_regressor``
        (J, V), and of ``shapedirs`` (V, 3, K) the first coefficients. No pickled object is ever loaded: a .pkl file, or
        an array of objects in the .npz file, has to be converted by its own library first.

        Args:
            path: the file.
            num_coefficients: of shape, at most.
            joint_names: J names; "joint_0", ... by default.
            nu: fusion length, metres; from the parts' thickness by default.
            dtype: of the module; the default dtype if None.

        Raises:
            FormatError: if the file is damaged, lacks an array, or holds one of objects.
            InputError: if the arrays do not fit together.
        """
        check_count(num_coefficients, "num_coefficients", 1)
        arrays = load_arrays(path, ("v_template", "f", "weights", "kintree_table", "J_regressor", "shapedirs"))
        with naming(path):
            vertices, regressor = (as_float_tensor(arrays[name], name) for name in ("v_template", "J_regressor"))
            check_shape(vertices, "v_template", ("V", 3))
            check_shape(regressor, "J_regressor", ("J", len(vertices)))
            check_shape(arrays["kintree_table"], "kintree_table", (2, len(regressor)))
            dirs = as_float_tensor(arrays["shapedirs"], "shapedirs")[..., :num_coefficients]
            return cls.from_skinned_mesh(
                vertices, arrays["f"].long(), arrays["weights"], regressor @ vertices,
                [int(parent) for parent in arrays["kintree_table"][0]], joint_names=joint_names, shape_dirs=dirs,
                joint_regressor=regressor, nu=nu, dtype=dtype,
            )  # fmt: skip

    @classmethod
    def from_anny(cls, kind: str = "body", *, dtype: torch.dtype | None = None) -> ArticulatedShape:
        """Return the body or a hand of anny, a free parametric model of people, with its phenotypes as coefficients.

        The coefficients are gender, age, muscle, weight, height and proportions, from 0 to 1; at rest the vertices are
        anny's ``rest_vertices``, in its order and coordinates (z is up). The model is read once and then kept in anny's
        cache folder.

        Args:
            kind: "body" (`anny.Anny()`, 13,718 vertices, 103 parts), "hand.R" or "hand.L" (1,609 vertices).
            dtype: of the module; the default dtype if None.

        Raises:
            InputError: if the kind is another.
            MissingExtraError: if anny is not installed.

        Cost: two seconds; the first time those that anny takes to build its model, minutes for a hand.

        References: Bregier et al. 2025, Human mesh modeling for Anny body.
        """
        from torchreg.shapes.anny_body import load_anny

        spec, space = load_anny(kind)
        return cls.from_spec(spec, dtype=dtype, space=space)

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Names of the shape coefficients; none where the shape has no coefficients."""
        return () if self.space is None else self.space.names

    def vertices(self, pose: Tensor, coefficients: Tensor | None = None) -> Tensor:
        """Return the vertices of the mesh in a pose, of a person with some coefficients.

        Args:
            pose: (..., num_dofs).
            coefficients: (..., K), with batch dimensions that broadcast; the shape as it is if None.

        Returns:
            (..., V, 3), metres, in the file's order.

        Raises:
            InputError: if the shape has no mesh or no coefficients, or a size is wrong.

        Differentiable: in both, in reverse and forward mode.
        """
        surface = self.file_surface()
        if coefficients is None:
            return self(pose).points
        space = self.coefficient_space()
        check_shape(pose, "pose", (self.num_dofs,), batch=True)
        check_shape(coefficients, "coefficients", (len(space),), batch=True)
        batch = torch.broadcast_shapes(pose.shape[:-1], coefficients.shape[:-1])
        state = torch.cat([pose.expand(*batch, -1), coefficients.expand(*batch, -1)], dim=-1)
        posed = ShapedTree(self, space).posed(state, space)
        return blended(posed, surface.weights.to(self.rest), posed.vertices)[0]

    def with_coefficients(self, coefficients: Tensor) -> ArticulatedShape:
        """Return the shape of one person: a rig like this, with other vertices and bones, without coefficients.

        Args:
            coefficients: (K,).

        Raises:
            InputError: if the shape has no coefficients, or their number or values are wrong.

        Differentiable: no; see `vertices`.
        """
        surface, space = self.file_surface(), self.coefficient_space()
        coefficients = as_float_tensor(coefficients, "coefficients", like=self.rest).detach()
        check_shape(coefficients, "coefficients", (len(space),))
        check_finite(coefficients, "coefficients")
        with torch.no_grad():
            spec = person_spec(self, surface, *space.rest(coefficients))
        free_base = bool(self.upper[0] > 0)
        return ArticulatedShape.from_spec(spec, free_base=free_base, dtype=self.rest.dtype).to(self.rest.device)

    def with_bone_coefficients(self) -> ArticulatedShape:
        """Return the rig with its own proportions as coefficients: size, girth, lengths and radii of its parts.

        Each is a relative change, 0 for the rig as it is. A fit of them gives another rig the size of a person.

        Raises:
            InputError: if the shape has no mesh.
        """
        other = copy.deepcopy(self)
        other.space = bone_space(self, self.file_surface()).to(self.rest)
        return other

    def to_gltf(self, path: str | Path, source: str | Path, *, skin: str | int | None = None) -> Path:
        """Write a rigged glTF file with this shape's vertices and bones, and return its path.

        The bind pose is that of the shape; skin weights, materials and pictures stay. Its clips play on: joints turn as
        before, and translations grow as the bones they move do, those of the root as the whole skeleton, so that feet
        stay on the ground.

        Args:
            path: of the .glb file to write.
            source: the rigged .glb or .gltf file that `from_gltf` read; the shape itself, or that of a fit of its bones
                (``align(..., fit_shape="bones").shape``, `with_coefficients`).
            skin: as given to `from_gltf`.

        Raises:
            InputError: if the shape has no mesh or is not one of that file, or ``path`` does not end in .glb.
            FormatError: if the file cannot be read.

        Differentiable: no.
        """
        return save_rig(path, source, self, self.file_surface(), skin)

    def coefficient_space(self) -> ShapeSpace:
        """Return the space of rest states; InputError where the shape has no coefficients."""
        if self.space is None:
            raise InputError(
                "this shape has no coefficients; make it by from_anny, from_npz, or from_skinned_mesh(shape_dirs=...)"
            )
        return self.space

    def file_surface(self) -> RigSurface:
        """Return mesh and weights of the file; InputError where the shape has none."""
        if self.surface is None:
            raise InputError("this shape has no mesh: it was not read from a file with one")
        return self.surface

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
