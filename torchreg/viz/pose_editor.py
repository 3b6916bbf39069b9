"""Posing step by step: handles that are dragged or pinned, undo and redo, key poses, files."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape
from torchreg.errors import InputError
from torchreg.geometry.upright import Direction, guess_up
from torchreg.io.gltf_file.morph import save_vertex_animation
from torchreg.io.points import save_points
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.results import PoseSolution, ScanRegistration, SequenceRegistration
from torchreg.registration.solve_pose import PoseSolver, SolvePoseConfig
from torchreg.viz.bone_colors import weight_colors
from torchreg.viz.key_poses import between_poses
from torchreg.viz.scan_gltf import save_grid_animation


@dataclass(frozen=True)
class _Playback:
    """Frames between two key poses."""

    played: int = 30
    stored: int = 10  # in files that hold every vertex of every frame


_PLAYBACK = _Playback()


@dataclass(frozen=True, eq=False)
class PoseState:
    """A state that undo restores.

    Args:
        transforms: (B, 4, 4) of the bones.
        vertices: numbers of the H handles' points in the scan.
        targets: (H, 3) of the handles; a handle that is neither dragged nor pinned follows the shape.
        pinned: per handle, whether it is fixed while others are dragged.
        solution: of the last drag, None before the first.
    """

    transforms: Tensor
    vertices: tuple[int, ...]
    targets: Tensor
    pinned: tuple[bool, ...]
    solution: PoseSolution | None = None


class PoseEditor:
    """A registered scan that is posed by dragging handles. All methods may be called from any thread.

    Args:
        registration: with the bones.
        frame: of a `SequenceRegistration`, whose pose is the first one.
        start: (B, 4, 4) the first pose instead, such as ``transforms`` of a `PoseSolution`.
        config: of the solver.
        up: the upright direction; by default that of the registration, or guessed from its points.

    Raises:
        InputError: if there is no such frame or ``start`` does not fit.
    """

    def __init__(
        self,
        registration: ScanRegistration | SequenceRegistration,
        *,
        frame: int = 0,
        start: Tensor | None = None,
        config: SolvePoseConfig | None = None,
        up: Direction | None = None,
    ) -> None:
        poses = registration.transforms.detach()
        if poses.ndim == 4 and not 0 <= frame < len(poses):
            raise InputError(f"frame must be from 0 to {len(poses) - 1}, got {frame}")
        transforms = poses[frame] if poses.ndim == 4 else poses
        if start is not None:
            transforms = as_float_tensor(start, "start", like=poses).detach()
            check_shape(transforms, "start", tuple(poses.shape[-3:]))
        # A copy in one pose, independent of later changes of the registration.
        self.model: GridLBS = GridLBS.from_record(replace(registration.model.record(), transforms=transforms.cpu()))
        self.points, self.faces = registration.points.detach().cpu(), registration.faces
        self.up = up or registration.up or guess_up([self.points])
        self._weights = self.model.weights_at(self.points).detach()
        self._solver = PoseSolver(self.model, config=config)
        self._lock = threading.RLock()
        self._state = PoseState(transforms.cpu().clone(), (), self.points.new_zeros(0, 3), ())
        self._history, self._step = [self._state], 0
        self._keys: list[Tensor] = []

    @property
    def state(self) -> PoseState:
        """The current state."""
        return self._state

    @property
    def colors(self) -> Tensor:
        """Colors (N, 3) of the points by their bones."""
        return weight_colors(self._weights).clamp(0, 1)

    @cached_property
    def diagonal(self) -> float:
        """Length of the diagonal of the scan."""
        return float((self.points.amax(0) - self.points.amin(0)).norm())

    @property
    def can_undo(self) -> bool:
        """Whether there is a step to undo."""
        return self._step > 0

    @property
    def can_redo(self) -> bool:
        """Whether there is a step to redo."""
        return self._step + 1 < len(self._history)

    @torch.no_grad()
    def moved(self, transforms: Tensor | None = None) -> Tensor:
        """Return the points (N, 3) in a pose (B, 4, 4), the current one by default."""
        pose = self._state.transforms if transforms is None else transforms
        return self.model.move(self.points, self._weights, pose)

    @torch.no_grad()
    def placed(self) -> Tensor:
        """Return the positions (H, 3) of the handles."""
        index = list(self._state.vertices)
        return self.model.move(self.points[index], self._weights[index], self._state.transforms)

    def add_handle(self, vertex: int) -> int:
        """Make a point of the scan a handle, unless it is one, and return its number."""
        if not 0 <= vertex < len(self.points):
            raise InputError(f"vertex must be from 0 to {len(self.points) - 1}, got {vertex}")
        with self._lock:
            state = self._state
            if vertex in state.vertices:
                return state.vertices.index(vertex)
            vertices = (*state.vertices, vertex)
            targets = torch.cat([state.targets, self.moved()[vertex].unsqueeze(0)])
            self._enter(replace(state, vertices=vertices, targets=targets, pinned=(*state.pinned, False)))
            return len(vertices) - 1

    def remove_handle(self, number: int) -> None:
        """Remove a handle; those after it get lower numbers."""
        with self._lock:
            self._check(number)
            state, keep = self._state, [k for k in range(len(self._state.vertices)) if k != number]
            vertices, pinned = tuple(state.vertices[k] for k in keep), tuple(state.pinned[k] for k in keep)
            self._enter(replace(state, vertices=vertices, targets=state.targets[keep], pinned=pinned))

    def pin(self, number: int, pinned: bool = True) -> None:
        """Fix a handle at its position while others are dragged, or release it."""
        with self._lock:
            self._check(number)
            state = self._state
            if state.pinned[number] == pinned:
                return
            flags = tuple(pinned if k == number else flag for k, flag in enumerate(state.pinned))
            targets = state.targets.clone()
            targets[number] = self.placed()[number]
            self._enter(replace(state, pinned=flags, targets=targets))

    def drag(self, targets: Mapping[int, Tensor]) -> PoseSolution:
        """Move handles to targets (3,) each, and the shape with them, and return the solution.

        The solver starts from the current pose. Pinned handles are dragged to their positions; others follow the shape.
        `commit` makes drags one step of undo.

        Raises:
            InputError: if there is no such handle, or a target is not finite.
        """
        with self._lock:
            state = self._state
            wanted = state.targets.clone()
            for number, target in targets.items():
                self._check(number)
                position = as_float_tensor(target, "targets", like=wanted)
                check_shape(position, "targets", (3,))
                check_finite(position, "targets")
                wanted[number] = position
            fixed = [k for k, pinned in enumerate(state.pinned) if pinned or k in targets]
            index = [state.vertices[k] for k in fixed]
            solution = self._solver.solve(self.points[index], wanted[fixed], start=state.transforms)
            self._state = replace(state, transforms=solution.transforms, targets=wanted, solution=solution)
            free = [k for k in range(len(state.vertices)) if k not in fixed]
            if free:
                wanted[free] = self.placed()[free]
            return solution

    def commit(self) -> None:
        """Make the drags since the last step one step of undo."""
        with self._lock:
            if self._state is not self._history[self._step]:
                self._enter(self._state)

    def undo(self) -> bool:
        """Go back one step; False if there is none. Drags that were not committed count as a step."""
        with self._lock:
            self.commit()
            if not self.can_undo:
                return False
            self._step -= 1
            self._state = self._history[self._step]
            return True

    def redo(self) -> bool:
        """Go forward one step that was undone; False if there is none."""
        with self._lock:
            if not self.can_redo or self._state is not self._history[self._step]:
                return False
            self._step += 1
            self._state = self._history[self._step]
            return True

    def reset(self) -> None:
        """Restore the first pose and drop all handles, as a step of undo."""
        with self._lock:
            self._enter(self._history[0])

    def add_key(self) -> int:
        """Add the current pose to the key poses and return their number."""
        self._keys.append(self._state.transforms.clone())
        return len(self._keys)

    def remove_key(self) -> int:
        """Remove the last key pose, if any, and return their number."""
        if self._keys:
            self._keys.pop()
        return len(self._keys)

    def animation(self, frames_per_key: int = _PLAYBACK.played) -> Tensor:
        """Return poses (T, B, 4, 4) through at least two key poses, as a glTF viewer plays the file of `save_gltf`."""
        if len(self._keys) < 2:
            raise InputError(f"an animation needs two key poses at least, got {len(self._keys)}")
        steps = frames_per_key * (len(self._keys) - 1)
        times = torch.linspace(0, len(self._keys) - 1, steps + 1)
        return between_poses(self.model, torch.stack(self._keys), times)

    def save_pose(self, path: str | Path) -> Path:
        """Return the path of the current `PoseSolution` (.safetensors and .json); InputError before the first drag."""
        solution = self._state.solution
        if solution is None:
            raise InputError("nothing was posed yet; drag a handle first")
        solution.save(path)
        return Path(path)

    def save_ply(self, path: str | Path) -> Path:
        """Return the path of the scan in the current pose, colored by bones (.ply)."""
        save_points(path, self.moved(), colors=self.colors, faces=self.faces)
        return Path(path)

    def save_gltf(self, path: str | Path, *, seconds_per_key: float = 1.0) -> Path:
        """Return the path of the skinned scan (.glb): its key poses as an animation, or from rest to the current pose.

        A blend of dual quaternions, which glTF does not know, is written vertex by vertex.

        Raises:
            InputError: if the scan has no triangles, or the ending is another.
        """
        if self.faces is None or not len(self.faces):
            raise InputError("a scan without triangles cannot be written as glTF; export PLY instead")
        rest = torch.eye(4).to(self._state.transforms).expand_as(self._state.transforms)
        poses = torch.stack(self._keys if self._keys else [rest, self._state.transforms])
        times = torch.arange(len(poses), dtype=torch.float64) * seconds_per_key
        if self.model.blend != "linear" and len(poses) > 1:
            keys = torch.linspace(0, len(poses) - 1, _PLAYBACK.stored * (len(poses) - 1) + 1)
            frames = self.moved(between_poses(self.model, poses, keys))
            return save_vertex_animation(path, frames, self.faces, keys * seconds_per_key, self.colors, up=self.up)
        return save_grid_animation(path, self.model, self.points, self.faces, poses, times, up=self.up).path

    def _check(self, number: int) -> None:
        if not 0 <= number < len(self._state.vertices):
            raise InputError(f"number must be that of one of {len(self._state.vertices)} handles, got {number}")

    def _enter(self, state: PoseState) -> None:
        """Make a state a step; steps that were undone are dropped."""
        self._state = state
        self._history = [*self._history[: self._step + 1], state]
        self._step += 1
