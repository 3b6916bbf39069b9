"""Sequences of silhouettes as surfaces: the masks of all cameras, frame by frame, and the mesh of their hull."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from torchreg._checks import check_count
from torchreg.capture.color import chroma_key
from torchreg.capture.silhouettes import visual_hull
from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.mesh import TriangleMesh
from torchreg.io.images import list_frames, load_image, load_mask
from torchreg.io.tensors import load_tensors, save_tensors


class SilhouetteFrames:
    """The masks of several cameras, frame by frame, and the surface of each frame's visual hull.

    Args:
        folders: one per camera, with its masks in the order of the numbers in their names. A folder belongs to the
            camera of its name; if no camera has the name of any, the folders are in the order of the cameras.
        cameras: calibrated; those without a folder are omitted if folders have the names of cameras.
        screen: whether the files are pictures before a screen of one color instead of masks, see `chroma_key`.
        resolution: see `visual_hull`.

    Raises:
        FormatError: if a folder holds no pictures, or they do not go together, see `list_frames`.
        FileNotFoundError: if a folder does not exist.
        InputError: if folders and cameras do not go together.
    """

    def __init__(
        self,
        folders: Sequence[str | os.PathLike[str]],
        cameras: CameraRig,
        *,
        screen: bool = False,
        resolution: int = 128,
    ) -> None:
        check_count(resolution, "resolution", 8)
        paths = [Path(folder) for folder in folders]
        self.cameras, self.screen, self.resolution = _cameras_of(paths, cameras), screen, resolution
        self._files = list_frames(paths)
        self.names = tuple(str(frame[0]) for frame in self._files)

    def __len__(self) -> int:
        return len(self._files)

    def masks(self, number: int) -> list[Tensor]:
        """Return the masks (H, W) of a frame, one per camera.

        Raises:
            FormatError: as `load_mask`, and if a picture does not have the size of its camera's; names the file.
        """
        masks = []
        for file, camera in zip(self._files[number], self.cameras, strict=True):
            if self.screen:
                image = load_image(file)
                if image.ndim != 3:
                    raise FormatError(f"{file}: pictures before a screen must be in color, got a gray one")
                mask = chroma_key(image)
            else:
                mask = load_mask(file)
            if mask.shape != (camera.height, camera.width):
                raise FormatError(
                    f"{file}: is {mask.shape[1]} x {mask.shape[0]} pixels, the pictures of {camera.name} are "
                    f"{camera.width} x {camera.height}"
                )
            masks.append(mask)
        return masks

    def mesh(self, number: int, progress: str | os.PathLike[str] | None = None) -> TriangleMesh:
        """Return the surface of a frame's visual hull, closed, oriented outwards.

        Args:
            number: of the frame.
            progress: a folder, made if need be, in which surfaces are kept; the surface of the same masks, cameras and
                resolution is read from it.

        Raises:
            FormatError: as `masks`, and as `visual_hull`; names the frame.
        """
        masks = self.masks(number)
        path = None if progress is None else Path(progress) / f"hull_{number:05d}.safetensors"
        fingerprint = self._fingerprint(masks)
        stored = None if path is None else _stored_mesh(path, fingerprint)
        if stored is not None:
            return stored
        try:
            mesh = visual_hull(masks, self.cameras, resolution=self.resolution).mesh()
        except InputError as error:
            raise FormatError(f"frame {number} ({self.names[number]}): {error}") from error
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            save_tensors(path, {"vertices": mesh.vertices, "faces": mesh.faces}, {"masks": fingerprint})
        return mesh

    def _fingerprint(self, masks: Sequence[Tensor]) -> str:
        digest = hashlib.sha256(str(self.resolution).encode())
        for mask, camera in zip(masks, self.cameras, strict=True):
            for part in (mask, camera.intrinsics, camera.world_to_camera, camera.distortion):
                digest.update(part.contiguous().numpy().tobytes())
        return digest.hexdigest()


def _cameras_of(folders: Sequence[Path], cameras: CameraRig) -> CameraRig:
    """Return the camera of each folder, by name if any folder has the name of a camera, else in order."""
    names = [folder.resolve().name for folder in folders]
    unknown = [name for name in names if name not in cameras.names]
    if len(unknown) < len(names):
        if unknown:
            raise InputError(f"folders must have the names of cameras; there is none called {', '.join(unknown)}")
        return CameraRig(tuple(cameras[name] for name in names))
    if len(names) != len(cameras):
        raise InputError(f"folders must be one per camera, got {len(names)} folders and {len(cameras)} cameras")
    return cameras


def _stored_mesh(path: Path, fingerprint: str) -> TriangleMesh | None:
    """Return the mesh of a file, None if there is none or its fingerprint differs."""
    try:
        tensors, metadata = load_tensors(path)
        return TriangleMesh(tensors["vertices"], tensors["faces"]) if metadata.get("masks") == fingerprint else None
    except (FileNotFoundError, FormatError, KeyError, InputError):
        return None
