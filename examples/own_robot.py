"""A robot in a cloud: its file, encoders as a prior, which joints the data determine.

python examples/own_robot.py [ROBOT.urdf CLOUD.ply]     # without arguments on a made-up arm
"""

import sys
from pathlib import Path

import torch

import torchreg as tr

ARM = """<robot name="arm">
  <link name="base"><visual><geometry><box size="0.2 0.2 0.1"/></geometry></visual></link>
  <link name="upper"><visual><origin xyz="0 0 0.2"/><geometry><box size="0.06 0.1 0.4"/></geometry></visual></link>
  <link name="fore"><visual><origin xyz="0 0 0.15"/><geometry><box size="0.04 0.08 0.3"/></geometry></visual></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.05"/>
    <axis xyz="0 1 0"/><limit lower="-1.5" upper="1.5" effort="1" velocity="1"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/>
    <axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="1" velocity="1"/></joint>
</robot>"""


def made_up_cloud(robot):
    """Return points on the robot in a pose, 2 mm of noise."""
    points = robot(robot.pose_from_dict({"shoulder": 0.4, "elbow": -1.1})).points
    return points + 0.002 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))


if len(sys.argv) < 3:
    Path("arm.urdf").write_text(ARM)
robot = tr.ArticulatedShape.from_urdf(sys.argv[1] if len(sys.argv) > 2 else "arm.urdf", free_base=False)
print(robot)
cloud = tr.load_points(sys.argv[2]).points if len(sys.argv) > 2 else made_up_cloud(robot)

free = tr.align(robot, cloud)  # searched for
print("searched:", free.status, {name: round(free.named_pose[name], 2) for name in robot.dof_names[6:]})

if len(sys.argv) < 3:  # encoders that are 3 degrees off, known to 5 degrees; the base is bolted down
    read = {"shoulder": 0.45, "elbow": -1.05}
    known = tr.align(robot, cloud, read, locked="base", prior=(read, 0.09))
    std = known.covariance.diagonal().sqrt()[6:].tolist()
    for name, deviation in zip(robot.dof_names[6:], std, strict=True):
        print(f"with encoders: {name} {known.named_pose[name]:.3f} rad, +- {deviation:.3f}")

free.plot(cloud, up=(0.0, 0.0, 1.0)).figure.savefig("own_robot.png")
