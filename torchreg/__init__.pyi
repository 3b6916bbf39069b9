# Written from the table in __init__.py by `python tests/test_init.py`.
from torchreg import errors as errors
from torchreg import metrics as metrics
from torchreg.alignment.align import align as align
from torchreg.alignment.calibrate import CalibrateConfig as CalibrateConfig
from torchreg.alignment.calibrate import calibrate as calibrate
from torchreg.alignment.calibrate_base import calibrate_base as calibrate_base
from torchreg.alignment.config import AlignConfig as AlignConfig
from torchreg.alignment.find_pose import FindPoseConfig as FindPoseConfig
from torchreg.alignment.find_pose import find_pose as find_pose
from torchreg.alignment.fit.annealed_em import SigmaSchedule as SigmaSchedule
from torchreg.alignment.fit.em_loss import EMLoss as EMLoss
from torchreg.alignment.pose_initializer import InitialPose as InitialPose
from torchreg.alignment.pose_initializer import PoseInitializer as PoseInitializer
from torchreg.alignment.pose_initializer import PoseInitializerConfig as PoseInitializerConfig
from torchreg.alignment.results import AlignResult as AlignResult
from torchreg.alignment.results import BaseCalibration as BaseCalibration
from torchreg.alignment.results import Calibration as Calibration
from torchreg.alignment.results import PoseStarts as PoseStarts
from torchreg.alignment.search.pose_proposer import PoseProposer as PoseProposer
from torchreg.alignment.search.pose_proposer import ProposerSize as ProposerSize
from torchreg.alignment.skeleton_source import SpineLimbs as SpineLimbs
from torchreg.alignment.train_initializer import TrainingRow as TrainingRow
from torchreg.alignment.train_initializer import TrainInitializerConfig as TrainInitializerConfig
from torchreg.alignment.train_initializer import train_initializer as train_initializer
from torchreg.capture.background import Background as Background
from torchreg.capture.depth import depth_scan as depth_scan
from torchreg.capture.depth import fuse_scans as fuse_scans
from torchreg.capture.depth import load_depth_scan as load_depth_scan
from torchreg.capture.depth_frame import DepthFrame as DepthFrame
from torchreg.capture.moved import MovedMasks as MovedMasks
from torchreg.capture.moved import moved_masks as moved_masks
from torchreg.capture.silhouette_frames import SilhouetteFrames as SilhouetteFrames
from torchreg.capture.silhouettes import visual_hull as visual_hull
from torchreg.capture.stereo import StereoConfig as StereoConfig
from torchreg.capture.stereo import stereo_points as stereo_points
from torchreg.capture.stereo_frames import StereoFrames as StereoFrames
from torchreg.geometry.camera import Camera as Camera
from torchreg.geometry.camera_rig import CameraRig as CameraRig
from torchreg.geometry.camera_rig import StereoPair as StereoPair
from torchreg.geometry.mesh import TriangleMesh as TriangleMesh
from torchreg.geometry.range_scan import RangeScan as RangeScan
from torchreg.geometry.skeleton import Skeleton as Skeleton
from torchreg.geometry.support import SupportSplit as SupportSplit
from torchreg.geometry.support import split_support as split_support
from torchreg.io.calibration import load_cameras as load_cameras
from torchreg.io.frames import load_frames as load_frames
from torchreg.io.points import PointCloud as PointCloud
from torchreg.io.points import load_mesh as load_mesh
from torchreg.io.points import load_points as load_points
from torchreg.io.scans import load_scan as load_scan
from torchreg.registration.bones.grid_lbs import GridLBS as GridLBS
from torchreg.registration.bones.registration_energy import RegistrationEnergy as RegistrationEnergy
from torchreg.registration.config import RegisterConfig as RegisterConfig
from torchreg.registration.dense.scan_matcher import ScanMatcher as ScanMatcher
from torchreg.registration.dense.scan_matcher import ScanMatches as ScanMatches
from torchreg.registration.register import register as register
from torchreg.registration.register_sequence import register_sequence as register_sequence
from torchreg.registration.results import PoseSolution as PoseSolution
from torchreg.registration.results import ScanRegistration as ScanRegistration
from torchreg.registration.results import SequenceRegistration as SequenceRegistration
from torchreg.registration.rigging.config import RigConfig as RigConfig
from torchreg.registration.rigging.results import SequenceRig as SequenceRig
from torchreg.registration.rigging.rig_sequence import rig_sequence as rig_sequence
from torchreg.registration.solve_pose import SolvePoseConfig as SolvePoseConfig
from torchreg.registration.solve_pose import solve_pose as solve_pose
from torchreg.result import Status as Status
from torchreg.shapes.articulated import ArticulatedShape as ArticulatedShape
from torchreg.shapes.hand import Hand as Hand
from torchreg.shapes.material_points import ShapeOutput as ShapeOutput
from torchreg.shapes.pose_head import PoseHead as PoseHead
from torchreg.shapes.pose_prior import PosePrior as PosePrior
from torchreg.shapes.skin import BendingSkin as BendingSkin
from torchreg.shapes.skin import LinearBlendSkin as LinearBlendSkin
from torchreg.shapes.skin import sample_skin as sample_skin
from torchreg.spines.extract_spine import SpineConfig as SpineConfig
from torchreg.spines.extract_spine import extract_spine as extract_spine
from torchreg.spines.measurements import SpineMeasurements as SpineMeasurements
from torchreg.spines.results import SpineSequence as SpineSequence
from torchreg.spines.skeletonize import SkeletonizeConfig as SkeletonizeConfig
from torchreg.spines.skeletonize import skeletonize as skeletonize
from torchreg.spines.spine import Spine as Spine
from torchreg.storage import load as load
from torchreg.tracking.config import TrackConfig as TrackConfig
from torchreg.tracking.results import DemoResult as DemoResult
from torchreg.tracking.results import FrameResult as FrameResult
from torchreg.tracking.results import TrackResult as TrackResult
from torchreg.tracking.results import TrackState as TrackState
from torchreg.tracking.smoother import smooth_track as smooth_track
from torchreg.tracking.tracker import Tracker as Tracker
from torchreg.viz.conversions import to_open3d as to_open3d
from torchreg.viz.conversions import to_pyvista as to_pyvista
from torchreg.viz.conversions import to_trimesh as to_trimesh
from torchreg.viz.plots import plot as plot

__version__: str
__all__ = [
    "AlignConfig",
    "AlignResult",
    "ArticulatedShape",
    "Background",
    "BaseCalibration",
    "BendingSkin",
    "CalibrateConfig",
    "Calibration",
    "Camera",
    "CameraRig",
    "DemoResult",
    "DepthFrame",
    "EMLoss",
    "FindPoseConfig",
    "FrameResult",
    "GridLBS",
    "Hand",
    "InitialPose",
    "LinearBlendSkin",
    "MovedMasks",
    "PointCloud",
    "PoseHead",
    "PoseInitializer",
    "PoseInitializerConfig",
    "PosePrior",
    "PoseProposer",
    "PoseSolution",
    "PoseStarts",
    "ProposerSize",
    "RangeScan",
    "RegisterConfig",
    "RegistrationEnergy",
    "RigConfig",
    "ScanMatcher",
    "ScanMatches",
    "ScanRegistration",
    "SequenceRegistration",
    "SequenceRig",
    "ShapeOutput",
    "SigmaSchedule",
    "SilhouetteFrames",
    "Skeleton",
    "SkeletonizeConfig",
    "SolvePoseConfig",
    "Spine",
    "SpineConfig",
    "SpineLimbs",
    "SpineMeasurements",
    "SpineSequence",
    "Status",
    "StereoConfig",
    "StereoFrames",
    "StereoPair",
    "SupportSplit",
    "TrackConfig",
    "TrackResult",
    "TrackState",
    "Tracker",
    "TrainInitializerConfig",
    "TrainingRow",
    "TriangleMesh",
    "__version__",
    "align",
    "calibrate",
    "calibrate_base",
    "depth_scan",
    "errors",
    "extract_spine",
    "find_pose",
    "fuse_scans",
    "load",
    "load_cameras",
    "load_depth_scan",
    "load_frames",
    "load_mesh",
    "load_points",
    "load_scan",
    "metrics",
    "moved_masks",
    "plot",
    "register",
    "register_sequence",
    "rig_sequence",
    "sample_skin",
    "skeletonize",
    "smooth_track",
    "solve_pose",
    "split_support",
    "stereo_points",
    "to_open3d",
    "to_pyvista",
    "to_trimesh",
    "train_initializer",
    "visual_hull",
]
