"""Register articulated, bending shapes to 3-D data with PyTorch.

``import torchreg`` is light: a public name is loaded, and torch with it, when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# Every public name stands here, beside the module that defines it, and nowhere else: `__init__.pyi`, which tells type
# checkers the same, is written from this table by tests/test_init.py.
_NAMES = {
    "alignment.align": "align",
    "alignment.calibrate": "CalibrateConfig calibrate",
    "alignment.calibrate_base": "calibrate_base",
    "alignment.config": "AlignConfig",
    "alignment.fit.em_loss": "EMLoss",
    "alignment.find_pose": "FindPoseConfig find_pose",
    "alignment.pose_initializer": "InitialPose PoseInitializer PoseInitializerConfig",
    "alignment.search.pose_proposer": "PoseProposer ProposerSize",
    "alignment.results": "AlignResult BaseCalibration Calibration PoseStarts",
    "alignment.fit.annealed_em": "SigmaSchedule",
    "alignment.skeleton_source": "SpineLimbs",
    "alignment.train_initializer": "TrainingRow TrainInitializerConfig train_initializer",
    "capture.depth": "depth_scan fuse_scans load_depth_scan",
    "capture.depth_frame": "DepthFrame",
    "capture.background": "Background",
    "capture.moved": "MovedMasks moved_masks",
    "capture.silhouette_frames": "SilhouetteFrames",
    "capture.silhouettes": "visual_hull",
    "capture.stereo": "StereoConfig stereo_points",
    "capture.stereo_frames": "StereoFrames",
    "geometry.camera": "Camera",
    "geometry.camera_rig": "CameraRig StereoPair",
    "geometry.mesh": "TriangleMesh",
    "geometry.range_scan": "RangeScan",
    "geometry.skeleton": "Skeleton",
    "geometry.support": "SupportSplit split_support",
    "io.calibration": "load_cameras",
    "io.frames": "load_frames",
    "io.points": "PointCloud load_mesh load_points",
    "io.scans": "load_scan",
    "registration.bones.grid_lbs": "GridLBS",
    "registration.bones.registration_energy": "RegistrationEnergy",
    "registration.dense.scan_matcher": "ScanMatcher ScanMatches",
    "registration.config": "RegisterConfig",
    "registration.register": "register",
    "registration.register_sequence": "register_sequence",
    "registration.results": "PoseSolution ScanRegistration SequenceRegistration",
    "registration.solve_pose": "SolvePoseConfig solve_pose",
    "result": "Status",
    "registration.rigging.config": "RigConfig",
    "registration.rigging.results": "SequenceRig",
    "registration.rigging.rig_sequence": "rig_sequence",
    "shapes.articulated": "ArticulatedShape",
    "shapes.hand": "Hand",
    "shapes.material_points": "ShapeOutput",
    "shapes.pose_head": "PoseHead",
    "shapes.pose_prior": "PosePrior",
    "shapes.skin": "BendingSkin LinearBlendSkin sample_skin",
    "spines.extract_spine": "SpineConfig extract_spine",
    "spines.measurements": "SpineMeasurements",
    "spines.results": "SpineSequence",
    "spines.skeletonize": "SkeletonizeConfig skeletonize",
    "spines.spine": "Spine",
    "storage": "load",
    "tracking.config": "TrackConfig",
    "tracking.results": "DemoResult FrameResult TrackResult TrackState",
    "tracking.smoother": "smooth_track",
    "tracking.tracker": "Tracker",
    "viz.conversions": "to_open3d to_pyvista to_trimesh",
    "viz.plots": "plot",
}
_MODULES = ("errors", "metrics")
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}
__all__ = sorted([*_HOMES, *_MODULES, "__version__"])


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"{__name__}.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(__all__)}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value  # the next use is a plain lookup
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
