"""Labels of clouds: to disk and back, chosen by confidence, batched with padding."""

import pytest
import torch
from torch.utils.data import DataLoader

import torchreg as tr
from torchreg.datasets import pose_labels


def some_label(count, confidence):
    generator = torch.Generator().manual_seed(count)
    return pose_labels.PoseLabel(
        torch.randn(count, 3, generator=generator), torch.randn(27, generator=generator),
        torch.randn(21, 3, generator=generator), torch.randint(-1, 16, (count,), generator=generator),
        torch.tensor(confidence),
    )  # fmt: skip


@pytest.fixture
def labels(tmp_path):
    labels = [some_label(5, 0.9), some_label(8, 0.2), some_label(3, 0.7)]
    for number, label in enumerate(labels):
        assert label.save(tmp_path, number) == pose_labels.label_path(tmp_path, number)
    return labels


def test_labels_come_back_as_they_were(tmp_path, labels):
    dataset = pose_labels.PoseLabels(tmp_path)
    assert len(dataset) == 3
    for label, read in zip(labels, dataset, strict=False):
        assert all(torch.equal(read[name], getattr(label, name)) for name in read)
    assert torch.equal(pose_labels.PoseLabels(tmp_path, min_confidence=0.5)[1]["pose"], labels[2].pose)


def test_batches_are_padded(tmp_path, labels):
    (batch,) = DataLoader(pose_labels.PoseLabels(tmp_path), batch_size=3, collate_fn=pose_labels.collate_labels)
    assert batch["points"].shape == (3, 8, 3)
    assert batch["mask"].sum(-1).tolist() == [5, 8, 3]
    assert torch.equal(batch["points"][2][batch["mask"][2]], labels[2].points)
    assert not batch["points"][~batch["mask"]].any()
    assert (batch["parts"][~batch["mask"]] == -1).all()
    assert batch["keypoints"].shape == (3, 21, 3)


def test_what_is_no_label_is_refused(tmp_path, labels, plain_hand):
    with pytest.raises(tr.errors.InputError, match=r"holds no label of confidence 0\.95"):
        pose_labels.PoseLabels(tmp_path, min_confidence=0.95)
    prior = tr.PosePrior.fit(plain_hand, torch.stack([label.pose for label in labels]))
    prior.save(pose_labels.label_path(tmp_path, 9))
    with pytest.raises(tr.errors.FormatError, match="holds no PoseLabel"):
        pose_labels.PoseLabels(tmp_path)[3]
