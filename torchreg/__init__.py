"""Register articulated, bending shapes to 3-D data with PyTorch.

``import torchreg`` is light: a public name is loaded, and torch with it, when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchreg import errors, metrics
    from torchreg.capture.depth import depth_scan, fuse_scans, load_depth_scan
    from torchreg.capture.silhouette_frames import SilhouetteFrames
    from torchreg.capture.silhouettes import visual_hull
    from torchreg.capture.stereo import StereoConfig, stereo_points
    from torchreg.capture.stereo_frames import StereoFrames
    from torchreg.correspondence.sigma import SigmaSchedule
    from torchreg.geometry.camera import Camera
    from torchreg.geometry.camera_rig import CameraRig, StereoPair
    from torchreg.geometry.mesh import TriangleMesh
    from torchreg.geometry.range_scan import RangeScan
    from torchreg.geometry.skeleton import Skeleton
    from torchreg.io.calibration import load_cameras
    from torchreg.io.points import load_mesh, load_points
    from torchreg.losses.em import EMLoss
    from torchreg.models.grid_lbs import GridLBS
    from torchreg.models.spine import Spine
    from torchreg.pipelines.align import AlignConfig, align
    from torchreg.pipelines.calibrate import calibrate
    from torchreg.pipelines.extract_spine import SpineConfig, extract_spine
    from torchreg.pipelines.find_pose import FindPoseConfig, find_pose
    from torchreg.pipelines.pose_initializer import InitialPose, PoseInitializer, PoseInitializerConfig
    from torchreg.pipelines.register import register
    from torchreg.pipelines.register_config import RegisterConfig
    from torchreg.pipelines.register_sequence import register_sequence
    from torchreg.pipelines.skeletonize import SkeletonizeConfig, skeletonize
    from torchreg.pipelines.solve_pose import solve_pose
    from torchreg.pipelines.storage import load
    from torchreg.pipelines.track import Tracker
    from torchreg.pipelines.track_config import TrackConfig
    from torchreg.results.alignment import AlignResult, Calibration, PoseStarts
    from torchreg.results.base import Status
    from torchreg.results.scans import PoseSolution, ScanRegistration, SequenceRegistration
    from torchreg.results.spines import SpineSequence
    from torchreg.results.tracking import FrameResult, TrackResult, TrackState
    from torchreg.shapes.articulated import ArticulatedShape
    from torchreg.shapes.hand import Hand
    from torchreg.shapes.pose_head import PoseHead
    from torchreg.shapes.pose_prior import PosePrior
    from torchreg.shapes.skin import BendingSkin, LinearBlendSkin, sample_skin
    from torchreg.viz.conversions import to_open3d, to_pyvista, to_trimesh

__version__ = "0.1.0"

__all__ = [
    "AlignConfig",
    "AlignResult",
    "ArticulatedShape",
    "BendingSkin",
    "Calibration",
    "Camera",
    "CameraRig",
    "EMLoss",
    "FindPoseConfig",
    "FrameResult",
    "GridLBS",
    "Hand",
    "InitialPose",
    "LinearBlendSkin",
    "PoseHead",
    "PoseInitializer",
    "PoseInitializerConfig",
    "PosePrior",
    "PoseSolution",
    "PoseStarts",
    "RangeScan",
    "RegisterConfig",
    "ScanRegistration",
    "SequenceRegistration",
    "SigmaSchedule",
    "SilhouetteFrames",
    "Skeleton",
    "SkeletonizeConfig",
    "Spine",
    "SpineConfig",
    "SpineSequence",
    "Status",
    "StereoConfig",
    "StereoFrames",
    "StereoPair",
    "TrackConfig",
    "TrackResult",
    "TrackState",
    "Tracker",
    "TriangleMesh",
    "__version__",
    "align",
    "calibrate",
    "depth_scan",
    "errors",
    "extract_spine",
    "find_pose",
    "fuse_scans",
    "load",
    "load_cameras",
    "load_depth_scan",
    "load_mesh",
    "load_points",
    "metrics",
    "register",
    "register_sequence",
    "sample_skin",
    "skeletonize",
    "solve_pose",
    "stereo_points",
    "to_open3d",
    "to_pyvista",
    "to_trimesh",
    "visual_hull",
]

_MODULES = frozenset({"errors", "metrics"})

_OWNERS = {
    "AlignConfig": "pipelines.align",
    "AlignResult": "results.alignment",
    "ArticulatedShape": "shapes.articulated",
    "BendingSkin": "shapes.skin",
    "Calibration": "results.alignment",
    "Camera": "geometry.camera",
    "CameraRig": "geometry.camera_rig",
    "EMLoss": "losses.em",
    "FindPoseConfig": "pipelines.find_pose",
    "FrameResult": "results.tracking",
    "GridLBS": "models.grid_lbs",
    "Hand": "shapes.hand",
    "InitialPose": "pipelines.pose_initializer",
    "LinearBlendSkin": "shapes.skin",
    "PoseHead": "shapes.pose_head",
    "PoseInitializer": "pipelines.pose_initializer",
    "PoseInitializerConfig": "pipelines.pose_initializer",
    "PosePrior": "shapes.pose_prior",
    "PoseSolution": "results.scans",
    "PoseStarts": "results.alignment",
    "RangeScan": "geometry.range_scan",
    "RegisterConfig": "pipelines.register_config",
    "ScanRegistration": "results.scans",
    "SequenceRegistration": "results.scans",
    "SigmaSchedule": "correspondence.sigma",
    "SilhouetteFrames": "capture.silhouette_frames",
    "Skeleton": "geometry.skeleton",
    "SkeletonizeConfig": "pipelines.skeletonize",
    "Spine": "models.spine",
    "SpineConfig": "pipelines.extract_spine",
    "SpineSequence": "results.spines",
    "Status": "results.base",
    "StereoConfig": "capture.stereo",
    "StereoFrames": "capture.stereo_frames",
    "StereoPair": "geometry.camera_rig",
    "TrackConfig": "pipelines.track_config",
    "TrackResult": "results.tracking",
    "TrackState": "results.tracking",
    "Tracker": "pipelines.track",
    "TriangleMesh": "geometry.mesh",
    "align": "pipelines.align",
    "calibrate": "pipelines.calibrate",
    "depth_scan": "capture.depth",
    "extract_spine": "pipelines.extract_spine",
    "find_pose": "pipelines.find_pose",
    "fuse_scans": "capture.depth",
    "load": "pipelines.storage",
    "load_cameras": "io.calibration",
    "load_depth_scan": "capture.depth",
    "load_mesh": "io.points",
    "load_points": "io.points",
    "register": "pipelines.register",
    "register_sequence": "pipelines.register_sequence",
    "sample_skin": "shapes.skin",
    "skeletonize": "pipelines.skeletonize",
    "solve_pose": "pipelines.solve_pose",
    "stereo_points": "capture.stereo",
    "to_open3d": "viz.conversions",
    "to_pyvista": "viz.conversions",
    "to_trimesh": "viz.conversions",
    "visual_hull": "capture.silhouettes",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"{__name__}.{name}")
    if name not in _OWNERS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(__all__)}")
    value = getattr(import_module(f"{__name__}.{_OWNERS[name]}"), name)
    globals()[name] = value  # the next use is a plain lookup
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
