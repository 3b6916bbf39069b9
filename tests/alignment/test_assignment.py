"""Which data are on the shape, on something that touches it, or elsewhere."""

import pytest
import torch

import torchreg as tr


@pytest.mark.parametrize("turned", [False, True])
def test_what_touches_the_shape_is_told_from_what_does_not(links, links_skin, links_pose, turned):
    with torch.no_grad():
        posed = links_skin(links_pose)
    generator = torch.Generator().manual_seed(0)
    top = posed[posed[:, 2].argmax()].tolist()
    reach = float((posed.amax(0) - posed.amin(0)).norm())
    # Squares parallel to the plane z = 0.
    flat = torch.nn.functional.pad(0.5 * reach * torch.rand(2, 400, 2, generator=generator), (0, 1)).to(posed)
    touching, elsewhere = flat + posed.new_tensor([[[*top[:2], top[2] + 0.04 * reach]], [[3 * reach, 0.0, 0.0]]])
    data = torch.cat([posed, touching, elsewhere])
    order = torch.randperm(len(data), generator=generator) if turned else torch.arange(len(data))
    found = tr.align(links, data[order], links_pose, model_points=links_skin, config=tr.AlignConfig(search="never"))
    told = torch.empty(len(data), dtype=torch.int64)
    told[order] = found.assignment(data[order])
    shape, box, far = told.split([len(posed), 400, 400])
    assert float((shape == 2).double().mean()) > 0.98
    assert float((box == 1).double().mean()) > 0.98
    assert bool((far == 0).all())
    with pytest.raises(tr.errors.InputError, match="the one cloud that was aligned to"):
        found.assignment(posed[:-1])
