"""Sequences of silhouettes as surfaces: the masks of all cameras read frame by frame, and the mesh of their hull."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from torchreg._checks import check_count
from torchreg.capture.silhouettes import chroma_key, visual_hull
from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.mesh import TriangleMesh
from torchreg.io.images import list_frames, load_image, load_mask
from torchreg.io.tensors import load_tensors, save_tensors


class SilhouetteFrames:
    """The masks of several cameras, frame after frame, and the surface of each frame's visual hull.

    Args:
        folders: one per camera, with its masks in the order of the numbers in their names. A folder belongs to the
            camera of its name; if no camera has the name of any, the folders are in the order of the cameras.
        cameras: calibrated; those without a folder are left out where names tell which.
        screen: pictures before a screen of one color instead of masks, see `chroma_key`.
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
        places = [Path(folder) for folder in folders]
        self.cameras, self.screen, self.resolution = _matched(places, cameras), screen, resolution
        self._files = list_frames(places)
        self.names = tuple(str(frame[0]) for frame in self._files)

    def __len__(self) -> int:
        return len(self._files)

    def masks(self, number: int) -> list[Tensor]:
        """Return the masks (H, W) of a frame, one per camera.

        Raises:
            FormatError: as `load_mask`, and if a picture has not the size that its camera's have; names the file.
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
            progress: a folder, made if need be, in which surfaces are kept; that of the same masks, cameras and
                resolution is not made again.

        Raises:
            FormatError: as `masks`, and as `visual_hull`; names the frame.
        """
        masks = self.masks(number)
        place = None if progress is None else Path(progress) / f"hull_{number:05d}.safetensors"
        made_of = self._fingerprint(masks)
        kept = None if place is None else _kept(place, made_of)
        if kept is not None:
            return kept
        try:
            mesh = visual_hull(masks, self.cameras, resolution=self.resolution).mesh()
        except InputError as error:
            raise FormatError(f"frame {number} ({self.names[number]}): {error}") from error
        if place is not None:
            place.parent.mkdir(parents=True, exist_ok=True)
            save_tensors(place, {"vertices": mesh.vertices, "faces": mesh.faces}, {"masks": made_of})
        return mesh

    def _fingerprint(self, masks: Sequence[Tensor]) -> str:
        digest = hashlib.sha256(str(self.resolution).encode())
        for mask, camera in zip(masks, self.cameras, strict=True):
            for part in (mask, camera.intrinsics, camera.world_to_camera, camera.distortion):
                digest.update(part.contiguous().numpy().tobytes())
        return digest.hexdigest()


def _matched(places: Sequence[Path], cameras: CameraRig) -> CameraRig:
    """Return the camera of each folder, by name if a folder has that of one, else in order."""
    names = [place.resolve().name for place in places]
    known = [name in cameras.names for name in names]
    if any(known):
        strange = [name for name, there in zip(names, known, strict=True) if not there]
        if strange:
            raise InputError(f"folders must have the names of cameras; there is none called {', '.join(strange)}")
        return CameraRig(tuple(cameras[name] for name in names))
    if len(names) != len(cameras):
        raise InputError(f"folders must be one per camera, got {len(names)} folders and {len(cameras)} cameras")
    return cameras


def _kept(place: Path, made_of: str) -> TriangleMesh | None:
    try:
        tensors, metadata = load_tensors(place)
        return TriangleMesh(tensors["vertices"], tensors["faces"]) if metadata.get("masks") == made_of else None
    except (FileNotFoundError, FormatError, KeyError, InputError):
        return None
