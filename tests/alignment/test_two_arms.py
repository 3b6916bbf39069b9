"""A robot with two arms, with joints that slide and one that mimics another, is read and aligned."""

import torch

import torchreg as tr

SIDE = """
<link name="{0}upper"><visual><origin xyz="0 0 0.2"/><geometry><box size="0.08 0.06 0.4"/></geometry></visual></link>
<link name="{0}fore"><visual><origin xyz="0 0 0.15"/><geometry><box size="0.06 0.05 0.3"/></geometry></visual></link>
<link name="{0}slide"><visual><origin xyz="0 0 0.05"/><geometry><box size="0.12 0.04 0.04"/></geometry></visual></link>
<joint name="{0}shoulder" type="revolute"><parent link="base"/><child link="{0}upper"/><origin xyz="{1} 0 0.05"/>
  <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="{0}elbow" type="revolute"><parent link="{0}upper"/><child link="{0}fore"/><origin xyz="0 0 0.4"/>
  <axis xyz="1 0 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="{0}rail" type="prismatic"><parent link="{0}fore"/><child link="{0}slide"/><origin xyz="0 0 0.3"/>
  <axis xyz="0 0 1"/><limit lower="0" upper="0.15" effort="1" velocity="1"/>{2}</joint>
"""
MIMIC = '<mimic joint="l_rail" multiplier="0.5" offset="0.02"/>'
BASE = '<link name="base"><visual><geometry><box size="0.3 0.2 0.1"/></geometry></visual></link>'


def test_two_arms_with_slides_of_which_one_mimics_the_other_are_aligned(tmp_path):
    text = f'<robot name="two">{BASE}{SIDE.format("l_", 0.2, "")}{SIDE.format("r_", -0.2, MIMIC)}</robot>'
    (tmp_path / "two.urdf").write_text(text)
    shape = tr.ArticulatedShape.from_urdf(tmp_path / "two.urdf")
    assert set(shape.dof_names[6:]) == {"l_shoulder", "l_elbow", "l_rail", "r_shoulder", "r_elbow"}
    values = {"l_shoulder": 0.4, "l_elbow": -0.5, "l_rail": 0.08, "r_shoulder": -0.6, "r_elbow": 0.3}
    truth = torch.tensor([0.1, 0.0, 0.5, 0.2, 0.1, -0.1] + [values[name] for name in shape.dof_names[6:]])
    frames = dict(zip(shape.part_names, shape.part_transforms(truth), strict=True))
    slide = torch.linalg.inv(frames["r_fore"]) @ frames["r_slide"]
    torch.testing.assert_close(slide[2, 3], torch.tensor(0.3 + 0.02 + 0.5 * 0.08))
    generator = torch.Generator().manual_seed(0)
    data = tr.sample_skin(shape, 500)(truth).detach() + 0.002 * torch.randn(500, 3, generator=generator)
    start = truth + 0.1 * torch.randn(len(truth), generator=generator) * ~shape.is_sliding
    start[8] = 0.02
    found = tr.align(shape, data, start, config=tr.AlignConfig(search="never", num_model_points=300))
    assert found.status is tr.Status.CONVERGED
    assert float((found.pose - truth).abs().max()) < 0.01
