"""The network that proposes people: places of marks to states, files, frames, and the search where it fails."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.people import body_like_anny
from torchreg.alignment import train_initializer as train_module
from torchreg.alignment.shape import person_proposer, person_rows
from torchreg.alignment.shape.person_proposer import BODY_WEIGHTS, PersonProposer, RawPeople, shipped_people
from torchreg.alignment.shape.shape_fit import shape_problem
from torchreg.datasets import people_batches
from torchreg.datasets.people_poses import people_states
from torchreg.geometry.mesh import sample_surface
from torchreg.geometry.rotation import compose_rotation_vectors

TINY = tr.ProposerSize(tokens=16, neighbors=4, width=16, heads=2, encoder=1, decoder=1, hypotheses=4, waves=2)
QUICK = tr.AlignConfig(num_model_points=150, search="never")


@pytest.fixture(scope="module")
def body():
    return body_like_anny()


@pytest.fixture(scope="module")
def sitter(body):
    """A person in a random pose, a state and a whole cloud with 2 mm noise."""
    generator = torch.Generator().manual_seed(11)
    state = people_states(body, 3, generator)[2]
    mesh = tr.TriangleMesh(body.vertices(*state.tensor_split([body.num_dofs])), body.file_surface().faces)
    points = sample_surface(mesh, 900, generator=generator)[0]
    return state, points + 0.002 * torch.randn(points.shape, generator=generator)


def problem_of(body, points):
    rest, valid = body.rest_pose()[None], torch.ones(1, len(points), dtype=torch.bool)
    problem, _ = shape_problem(
        body, points[None], valid, rest, None, config=QUICK, generator=torch.Generator().manual_seed(0)
    )
    return problem.rows(torch.zeros(1, dtype=torch.int64))


def told(body, state, points, *, right=True):
    """A network that sees where the marks of a cloud (M, 3) are, if it is as it stands along z; else it is far off."""

    class Seer(PersonProposer):
        def forward(self, clouds, mask):
            marks = body.vertices(*state.tensor_split([body.num_dofs]))[self.marks] - points.mean(0)
            places = []
            for cloud, known in zip(clouds, mask, strict=True):
                own = marks + cloud[known].mean(0)
                stands = float(torch.cdist(own, cloud[known]).amin(-1).mean()) < 0.06
                places.append(own if right and stands else own + 5.0)
            found = torch.stack(places).unsqueeze(1).expand(-1, 4, -1, -1)
            return RawPeople(found, torch.zeros(len(clouds), 4), torch.zeros(len(clouds), 1, 4), mask[:, :1].long())

    empty = PersonProposer.of(body, TINY)
    return Seer(empty.size, empty.shape_size, empty.marks, empty.at_rest, empty.up, empty.num_vertices)


def test_marks_lie_on_all_parts_and_their_places_give_the_state(body, sitter):
    state, points = sitter
    net, problem = PersonProposer.of(body, TINY), problem_of(body, points)
    parts = body.file_surface().weights[net.marks].argmax(-1)
    assert len(net.marks.unique()) == len(net.marks) == 128
    assert len(parts.unique()) >= body.num_parts - 6
    vertices = body.vertices(*state.tensor_split([body.num_dofs])) - problem.origin[0]
    with torch.inference_mode():
        found = net._states(problem, body.file_surface(), vertices[net.marks][None])[0]
    off = (body.vertices(*found.tensor_split([body.num_dofs])) - vertices).norm(dim=-1)
    assert float(off.mean()) < 0.03


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_people_are_proposed_in_the_frame_in_which_they_stand(body, sitter, axis):
    """The network knows people along z only; those along another axis are turned before it sees them."""
    state, points = sitter
    up = torch.eye(3)[axis]
    turn = person_proposer._turns((0.0, 0.0, 1.0), tuple(up.tolist()))[0].float().mT
    torch.testing.assert_close(turn @ torch.tensor([0.0, 0.0, 1.0]), up, atol=1e-6, rtol=0)
    moved = points @ turn.mT
    problem, seer = problem_of(body, moved), told(body, state, points)
    with torch.inference_mode():
        for told_up in (None, tuple(up.tolist())):
            best = seer.propose(problem, body.file_surface(), 2, torch.Generator().manual_seed(1), told_up)[0]
            vertices = body.vertices(*best.tensor_split([body.num_dofs])) + problem.origin[0]
            true = body.vertices(*state.tensor_split([body.num_dofs])) @ turn.mT
            assert float((vertices - true).norm(dim=-1).mean()) < 0.06


def test_a_good_proposal_needs_no_search_and_a_bad_one_is_searched_for(body, sitter, monkeypatch):
    state, points = sitter
    searched, search = [], person_rows.PersonRows.searched_in_doubt

    def watched(rows, proposed):
        found = search(rows, proposed)
        searched.append(found is not proposed)
        return found

    monkeypatch.setattr(person_rows.PersonRows, "searched_in_doubt", watched)
    vertices = body.vertices(*state.tensor_split([body.num_dofs]))
    found = tr.align(body, points, fit_shape=True, clothed=False, initializer=told(body, state, points), config=QUICK)
    assert searched == [False]
    assert float((body.vertices(found.pose, found.coefficients) - vertices).norm(dim=-1).mean()) < 0.03
    assert found.evidence is not None
    wrong = told(body, state, points, right=False)
    tr.align(body, points, fit_shape=True, clothed=False, initializer=wrong, config=QUICK)
    assert searched == [False, True]
    with pytest.raises(tr.errors.InputError, match="a PersonProposer with fit_shape"):
        tr.align(body, points, initializer=wrong)


def test_beside_a_start_a_network_proposes_people_on_the_same_data(body, sitter):
    state, points = sitter
    pose, coefficients = state.tensor_split([body.num_dofs])
    flipped, middle = pose.clone(), body.keypoints(pose).mean(0)
    flipped[3:6] = compose_rotation_vectors(torch.tensor([torch.pi, 0.0, 0.0]), flipped[3:6])
    flipped[:3] += middle - body.keypoints(flipped).mean(0)

    def off(start, *, right, search="auto"):
        network = told(body, state, points, right=right)
        config = replace(QUICK, search=search)
        found = tr.align(body, points, start, fit_shape=True, clothed=False, initializer=network, config=config)
        vertices = body.vertices(found.pose, found.coefficients) - body.vertices(pose, coefficients)
        return float(vertices.norm(dim=-1).mean())

    assert off(flipped, right=True) < 0.03 < 0.1 < off(flipped, right=False)
    assert off(flipped, right=True, search="never") > 0.1
    assert off(pose, right=False) < 0.03


def test_training_by_the_one_command_and_files(body, tmp_path, monkeypatch):
    monkeypatch.setattr(train_module, "_TRAINING", replace(train_module._TRAINING, validation=4))
    monkeypatch.setattr(people_batches, "_VARIETY", replace(people_batches._VARIETY, samples=300))
    path, rows = tmp_path / "people.safetensors", []
    for steps in (2, 3):
        config = tr.TrainInitializerConfig(steps=steps, batch=4, every=2)
        trained = tr.train_initializer(body, path, config, size=TINY, progress=rows.append)
    assert [row.step for row in rows] == [2, 3]
    assert isinstance(trained, PersonProposer)
    points, mask = torch.randn(2, 60, 3), torch.ones(2, 60, dtype=torch.bool)
    again = PersonProposer.load(path)
    torch.testing.assert_close(again(points, mask).marks, trained(points, mask).marks)
    moved = again(points + torch.tensor([1.0, -2.0, 0.5]), mask).marks
    torch.testing.assert_close(moved, again(points, mask).marks + torch.tensor([1.0, -2.0, 0.5]), atol=1e-3, rtol=0)
    with pytest.raises(tr.errors.FormatError, match="holds no PoseProposer"):
        tr.PoseProposer.load(path, body)
    tr.PoseProposer(tr.Hand(), TINY).save(tmp_path / "hand.safetensors")
    with pytest.raises(tr.errors.FormatError, match="holds no PersonProposer"):
        PersonProposer.load(tmp_path / "hand.safetensors")


def test_the_network_of_anny_s_body_is_small_and_for_that_body_alone(body):
    net = PersonProposer.load(BODY_WEIGHTS)
    assert BODY_WEIGHTS.stat().st_size < 3e6
    assert not any(parameter.requires_grad for parameter in net.parameters())
    assert int(net.marks.max()) < net.num_vertices == 13718
    assert shipped_people(body) is None, "other vertices"
    assert shipped_people(tr.Hand()) is None
