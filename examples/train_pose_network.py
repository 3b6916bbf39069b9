"""A network that takes clouds to hand poses: pseudo-labels without any truth, a head for poses, a loop of torch.

python examples/train_pose_network.py [STEPS]
"""

import sys

import torch
from torch import nn
from torch.utils.data import DataLoader, TensorDataset

import torchreg as tr
from torchreg.datasets.hand import hand_motion, make_hand_cloud

torch.manual_seed(0)
hand, steps = tr.Hand(), int(sys.argv[1]) if len(sys.argv) > 1 else 60


def clouds_of(poses):
    """Return clouds (B, 256, 3) as a camera measures them."""
    found = []
    for number, pose in enumerate(poses):
        seed = torch.Generator().manual_seed(number)
        found.append(make_hand_cloud(hand, pose, num_points=256, camera=torch.zeros(3), generator=seed).points[:256])
    return torch.stack(found)


class PointNet(nn.Module):
    """The maximum over points of features of each, then poses."""

    def __init__(self, head, prior):
        super().__init__()
        self.features = nn.Sequential(nn.Linear(3, 64), nn.ReLU(), nn.Linear(64, 128))
        self.last = prior.init_head_(nn.Linear(128, head.num_features), head)  # likely poses from the first step on
        self.head = head

    def forward(self, clouds):
        """Return poses (B, 27) of clouds (B, 256, 3)."""
        middle = clouds.mean(1, keepdim=True)
        return self.head(self.last(self.features(10 * (clouds - middle)).amax(1)))


truth = hand_motion(hand, "bend", 12)
clouds = clouds_of(truth)
with torch.no_grad():  # labels: what the initializer finds, and how far it can be trusted
    labels = tr.PoseInitializer(hand, tr.PoseInitializerConfig(search="never"))(clouds)
error = (labels.keypoints - hand.keypoints(truth)).norm(dim=-1).mean()
print(f"{len(clouds)} pseudo-labels, {1000 * error:.1f} mm off, least confidence {labels.confidence.min():.1f}")

network = PointNet(tr.PoseHead(hand), tr.PosePrior.fit(hand, labels.pose))
optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3)
loader = DataLoader(TensorDataset(clouds, labels.keypoints.detach()), batch_size=8, shuffle=True)


def keypoint_error(clouds, keypoints):
    """Return the mean distance of keypoints, metres."""
    return (hand.keypoints(network(clouds)) - keypoints).norm(dim=-1).mean()


with torch.no_grad():
    before = keypoint_error(clouds, hand.keypoints(truth))
done = 0
while done < steps:
    for batch, keypoints in loader:
        optimizer.zero_grad()
        keypoint_error(batch, keypoints).backward()
        optimizer.step()
        done += 1
with torch.no_grad():
    after = keypoint_error(clouds, hand.keypoints(truth))
print(f"keypoints of the network: {1000 * before:.0f} mm off before training, {1000 * after:.0f} mm after {done} steps")
