"""A network that proposes poses: from clouds of one shape to several poses each, with their probabilities."""

from __future__ import annotations

import math
import os
from collections import OrderedDict
from collections.abc import Hashable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from torchreg._checks import check_count
from torchreg.alignment.fit.landmarks import keypoint_extent
from torchreg.alignment.fit.problem import masked_mean, model_size
from torchreg.errors import FormatError, InputError, InputTypeError
from torchreg.geometry.rotation_representations import rotation_from_6d, rotation_vector_from_rotation
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.io.tensors import load_tensors, save_tensors
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.hand import Hand
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.skin import LinearBlendSkin, sample_skin

_KIND = "PoseProposer"
# Of the built-in hand.
HAND_WEIGHTS = Path(__file__).with_name("hand_poses.safetensors")
# Keypoints of a shape for which a network was trained are so near to those of the trained one, in their extent, on
# average: between hands of other proportions, and a hand and its mirror image.
_SAME_SHAPE = 0.15
_GOLDEN = (math.sqrt(5) - 1) / 2
# Joints that turn by more have no limits to speak of; a network's output moves them about the rest pose.
_OPEN = math.pi


@dataclass(frozen=True)
class ProposerSize:
    """Sizes of the network; a million parameters, two megabytes in half precision.

    Args:
        points: of a cloud, at most; of more so many are drawn, as surroundings are known at one density.
        tokens: points whose surroundings are described.
        neighbors: points that describe them.
        width: of descriptions.
        heads: of attention.
        encoder: blocks of attention among tokens.
        decoder: blocks of attention of hypotheses to tokens, zero for tokens alone.
        hypotheses: poses that are proposed.
        waves: frequencies in which a place enters.
    """

    points: int = 512
    tokens: int = 160
    neighbors: int = 16
    width: int = 128
    heads: int = 4
    encoder: int = 5
    decoder: int = 2
    hypotheses: int = 8
    waves: int = 4

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_count(value, name, int(name != "decoder"))
        if self.width % (2 * self.heads):
            raise InputError(f"width must be a multiple of twice the heads, got {self.width} and {self.heads}")


class RawPoses(NamedTuple):
    """Poses as a network gives them: rotations (B, K, 3, 3), positions (B, K, 3), joints (B, K, J), and logits (B, K).

    `surface` (B, T, 4) is where tokens lie on the shape at rest, as a share of its size, and the logit of an outlier.
    """

    rotation: Tensor
    position: Tensor
    joints: Tensor
    logits: Tensor
    surface: Tensor
    token_index: Tensor


class Attended(NamedTuple):
    """States (B, Q, C) of queries and tokens (B, T, C), the tokens' points (B, T), and the clouds' means (B, 3)."""

    state: Tensor
    tokens: Tensor
    token_index: Tensor
    center: Tensor


@dataclass(frozen=True, eq=False)
class Proposals:
    """Poses (B, K, num_dofs) of a network, most probable first, with weights (B, K).

    Of the data (B, T, 3), metres, `surface` are the places on the shape at rest and `inlier` the probabilities.
    """

    poses: Tensor
    weights: Tensor
    points: Tensor
    surface: Tensor
    inlier: Tensor


class CloudNet(nn.Module):
    """A network of hypotheses that attend to a cloud: the part that `PoseProposer` and `PersonProposer` share.

    Args:
        size: see `ProposerSize`.
        shape_size: size of what is sought, metres, by which coordinates are divided.
    """

    frequencies: Tensor

    def __init__(self, size: ProposerSize, shape_size: float) -> None:
        super().__init__()
        self.size, self.shape_size, width = size, shape_size, size.width
        self.register_buffer("frequencies", math.pi * 2.0 ** torch.arange(size.waves), persistent=False)
        self.around = nn.Sequential(nn.Linear(4, 48), nn.GELU(), nn.Linear(48, width // 2), nn.GELU())
        self.embed = nn.Sequential(
            nn.Linear(width // 2 + 3 + 6 * size.waves, width), nn.GELU(), nn.Linear(width, width)
        )
        self.encoder = nn.ModuleList(_Block(width, size.heads) for _ in range(size.encoder))
        self.queries = nn.Parameter(torch.randn(size.hypotheses, width))
        self.cross = nn.ModuleList(_Block(width, size.heads) for _ in range(size.decoder))
        self.among = nn.ModuleList(_Block(width, size.heads) for _ in range(size.decoder))
        self.norm, self.token_norm = nn.LayerNorm(width), nn.LayerNorm(width)

    def attended(self, points: Tensor, mask: Tensor, queries: Tensor) -> Attended:
        """Return the states of queries (Q, C) and of tokens for clouds (B, M, 3) with a mask (B, M)."""
        center = masked_mean(points, mask)
        places = torch.where(mask.unsqueeze(-1), points - center.unsqueeze(1), 0.0) / self.shape_size
        tokens, known, index = self._tokens(places, mask)
        for block in self.encoder:
            tokens = block(tokens, tokens, known)
        tokens = self.token_norm(tokens)
        state = queries.expand(points.shape[0], -1, -1)
        for cross, among in zip(self.cross, self.among, strict=True):
            state = among(cross(state, tokens, known), None, None)
        return Attended(self.norm(state), tokens, index, center)

    def fitting(self, points: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return as many points (B, M, 3) with a mask (B, M) as the network takes, of many or few."""
        short = self.size.neighbors - points.shape[1]
        if points.shape[1] > self.size.points:
            index = _drawn(points, mask, self.size.points)
            return _rows(points, index), mask.gather(1, index)
        if short > 0:
            return nn.functional.pad(points, (0, 0, 0, short)), nn.functional.pad(mask, (0, short))
        return points, mask

    def _tokens(self, places: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return descriptions (B, T, C) of drawn points, which of them are points (B, T), and their numbers (B, T)."""
        index = _drawn(places, mask, self.size.tokens)
        known = mask.gather(1, index)
        centers = _rows(places, index)
        distance = torch.cdist(centers, places).masked_fill(~mask.unsqueeze(1), torch.inf)
        near, neighbor = distance.topk(self.size.neighbors, dim=2, largest=False)
        there = _rows(places, neighbor.flatten(1)).unflatten(1, neighbor.shape[1:]) - centers.unsqueeze(2)
        there = torch.where(near.isfinite().unsqueeze(-1), there, 0.0)
        # Surroundings of a tenth of the shape fill the range of a network's inputs.
        around = self.around(10 * torch.cat([there, there.norm(dim=-1, keepdim=True)], dim=-1)).amax(2)
        waves = (centers.unsqueeze(-1) * self.frequencies).flatten(2)
        state = self.embed(torch.cat([around, centers, waves.sin(), waves.cos()], dim=-1))
        return state, known, index


class PoseProposer(CloudNet):
    """Proposes poses of a shape for a batch of clouds: one pass of a network, no search.

    Tokens are points with what lies around them; hypotheses attend to them. The poses are as good as a coarse fit
    needs them, to a few per cent of the size; `PoseInitializer` fits and chooses among them.

    Args:
        shape: whose poses are proposed; its limits bound the joints.
        size: see `ProposerSize`.
        shape_size: diagonal of its bounding box at rest, metres; measured on its surface by default.

    Shape of ``forward(points, mask)``: points (B, M, 3) in metres, at least as many as are neighbors, and their mask
    (B, M); see `RawPoses`.

    Differentiable: in its parameters and the points.

    References: Qi et al. 2017 (PointNet++), for surroundings; Carion et al. 2020, for hypotheses that attend;
    Zhou et al. 2019, for rotations of six numbers.
    """

    lower: Tensor
    upper: Tensor
    rest: Tensor

    def __init__(
        self, shape: Articulation, size: ProposerSize | None = None, *, shape_size: float | None = None
    ) -> None:
        size = size or ProposerSize()
        super().__init__(size, model_size(sample_skin(shape)) if shape_size is None else shape_size)
        self.dof_names = tuple(shape.dof_names)
        self.keypoints = shape.keypoints(shape.rest_pose()).detach().double().cpu()
        self.mirrored = False
        width, joints = size.width, shape.num_dofs - BASE_DOFS
        rest = shape.rest[BASE_DOFS:].detach().float()
        lower, upper = shape.lower[BASE_DOFS:].detach().float(), shape.upper[BASE_DOFS:].detach().float()
        wide = (upper - lower).isinf() | (upper - lower > 2 * _OPEN)
        for name, value in (
            ("lower", torch.where(wide, rest - _OPEN, lower)),
            ("upper", torch.where(wide, rest + _OPEN, upper)),
            ("rest", rest),
        ):
            self.register_buffer(name, value.clone(), persistent=False)
        last = nn.Linear(width, 6 + 3 + joints + 1)
        self.head = nn.Sequential(nn.Linear(width, width), nn.GELU(), last)
        self.surface = nn.Linear(width, 4)
        # All hypotheses begin near the rest pose at the middle of the cloud, unturned.
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.zero_()
            last.bias[[0, 4]] = 1.0

    def forward(self, points: Tensor, mask: Tensor) -> RawPoses:
        """Return poses, see the class."""
        state, tokens, index, center = self.attended(points, mask, self.queries)
        out = self.head(state).float()
        turn, position, joints, logits = out.split((6, 3, len(self.rest), 1), dim=-1)
        share = (joints + self._rest_logit()).sigmoid()
        return RawPoses(
            rotation=rotation_from_6d(turn),
            position=self.shape_size * position + center.unsqueeze(1),
            joints=self.lower + share * (self.upper - self.lower),
            logits=logits.squeeze(-1),
            surface=self.surface(tokens).float(),
            token_index=index,
        )

    @torch.no_grad()
    def propose(self, points: Tensor, mask: Tensor) -> Proposals:
        """Return poses, most probable first, and where some of the points lie on the shape.

        Args:
            points: (B, M, 3), metres; of any floating dtype.
            mask: (B, M), False where points are padding.
        """
        points, mask = self.fitting(points, mask)
        # A mirror across x; turns are axial.
        flip = points.new_tensor([-1.0 if self.mirrored else 1.0, 1.0, 1.0])
        raw = self((points * flip).to(self.queries), mask)
        base = rotation_vector_from_rotation(raw.rotation).to(points) * flip * flip[0]
        poses = torch.cat([raw.position.to(points) * flip, base, raw.joints.to(points)], dim=-1)
        weights, order = raw.logits.softmax(-1).to(points).sort(dim=-1, descending=True)
        known = mask.gather(1, raw.token_index)
        return Proposals(
            poses=poses.gather(1, order.unsqueeze(-1).expand_as(poses)),
            weights=weights,
            points=_rows(points, raw.token_index),
            surface=self.shape_size * raw.surface[..., :3].to(points) * flip,
            inlier=(known * (-raw.surface[..., 3]).sigmoid()).to(points),
        )

    def save(self, path: str | os.PathLike[str], training: Mapping[str, Any] | None = None) -> None:
        """Write the weights in half precision as safetensors, and beside them JSON that tells for which shape.

        Args:
            path: to be written, ``.safetensors``.
            training: what to remember of the training.
        """
        state = {name: value.half() for name, value in self.state_dict().items()}
        record = {
            "kind": _KIND,
            "dof_names": list(self.dof_names),
            "shape_size": self.shape_size,
            "keypoints": self.keypoints.tolist(),
            "sizes": asdict(self.size),
            "training": dict(training or {}),
        }
        save_tensors(path, state, record)

    @staticmethod
    def load(path: str | os.PathLike[str], shape: Articulation, *, limits: FileLimits = DEFAULT_LIMITS) -> PoseProposer:
        """Return the network of a file for the shape that it was trained for, which may be larger or smaller.

        Raises:
            FileNotFoundError: if there is no such file.
            FormatError: if the file is damaged, holds no network, or one for another shape.
        """
        tensors, record = load_tensors(path, limits=limits)
        if record.get("kind") != _KIND:
            raise FormatError(f"{path}: holds no {_KIND}, got {record.get('kind')!r}")
        try:
            # Layers draw weights before those of the file replace them: the caller's random state stays.
            with torch.random.fork_rng(devices=[]):
                found = _restored(tensors, record, shape)
        except (KeyError, TypeError, ValueError, RuntimeError, InputError) as error:
            raise FormatError(f"{path}: holds no {_KIND} of this version ({error})") from error
        if found is None:
            raise FormatError(
                f"{path}: was trained for another shape, of other degrees of freedom or keypoints; train one for this "
                "shape with torchreg train-initializer"
            )
        return found.to(shape.rest.device).requires_grad_(False).eval()

    def _rest_logit(self) -> Tensor:
        """Return what the sigmoid takes to the rest pose, or near it where that is at a limit."""
        share = (self.rest - self.lower) / (self.upper - self.lower).clamp_min(1e-6)
        return share.clamp(0.1, 0.9).logit()


class _Block(nn.Module):
    """A block of attention to others, or to one's own kind, and a layer for each."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.first_norm, self.second_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.query, self.key_value = nn.Linear(width, width), nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)
        self.layer = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))

    def forward(self, state: Tensor, others: Tensor | None, known: Tensor | None) -> Tensor:
        """Return states (B, S, C) after attending to others (B, T, C), of which some are known (B, T)."""
        normed = self.first_norm(state)
        parts = (self.query(normed), *self.key_value(normed if others is None else others).chunk(2, -1))
        query, key, value = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        shown = None if known is None else known[:, None, None]
        mixed = nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=shown)
        state = state + self.out(mixed.transpose(1, 2).flatten(2))
        return state + self.layer(self.second_norm(state))


def _rows(values: Tensor, index: Tensor) -> Tensor:
    """Return rows (B, T, C) of values (B, M, C) by their numbers (B, T)."""
    return values.gather(1, index.unsqueeze(-1).expand(-1, -1, values.shape[-1]))


def _drawn(values: Tensor, mask: Tensor, count: int) -> Tensor:
    """Return the numbers (B, T) of at most ``count`` rows of values (B, M, C), those that the mask shows first."""
    # A sequence that fills the unit interval evenly, so that neighbors in the file are drawn as random numbers would.
    rank = (_GOLDEN * torch.arange(values.shape[1], device=values.device, dtype=torch.float64)).frac().to(values)
    return torch.where(mask, rank, -1.0).topk(min(count, values.shape[1]), dim=1).indices


def posed_points(raw: RawPoses, skin: LinearBlendSkin) -> Tensor:
    """Return the points (B, K, N, 3) of a skin in proposed poses, whose rotations stay matrices."""
    still = nn.functional.pad(raw.joints, (BASE_DOFS, 0))
    return skin(still) @ raw.rotation.mT + raw.position.unsqueeze(-2)


def _restored(tensors: Mapping[str, Tensor], record: Mapping[str, Any], shape: Articulation) -> PoseProposer | None:
    """Return the network of a file, None if it was trained for another shape."""
    if record["dof_names"] != list(shape.dof_names):
        return None
    size = ProposerSize(**record["sizes"])
    if tensors["queries"].shape != (size.hypotheses, size.width) or size.encoder + size.decoder > len(tensors):
        raise InputError("its sizes are not those of its tensors")
    trained = torch.tensor(record["keypoints"], dtype=torch.float64)
    extent = (trained.amax(0) - trained.amin(0)).norm().clamp_min(1e-9)
    scale = keypoint_extent(shape) / float(extent) if len(trained) > 1 else 1.0
    found = PoseProposer(shape, size, shape_size=scale * record["shape_size"])
    # As seen from the base, whose place and turn a pose tells.
    if float((found.keypoints / scale - trained).norm(dim=-1).mean()) > _SAME_SHAPE * extent:
        return None
    found.load_state_dict({name: value.float() for name, value in tensors.items()})
    return found


class HoldsProposer(Protocol):
    """Something with a network that proposes poses, as a `PoseInitializer`."""

    proposer: PoseProposer | None


def check_proposer(shape: Articulation, initializer: PoseProposer | HoldsProposer) -> PoseProposer:
    """Return a network that was given for a shape, checked."""
    proposer = initializer if isinstance(initializer, PoseProposer) else getattr(initializer, "proposer", initializer)
    if not isinstance(proposer, PoseProposer):
        raise InputTypeError(
            f"initializer must be a PoseProposer, or a PoseInitializer that has one, got {type(proposer).__name__}"
        )
    if proposer.dof_names != tuple(shape.dof_names):
        raise InputError(
            f"initializer must be a network for this shape's {shape.num_dofs} degrees of freedom, got one for "
            f"{len(proposer.dof_names)} that has other names; train one with tr.train_initializer"
        )
    return proposer


def shipped_proposer(shape: Articulation) -> PoseProposer | None:
    """Return the network that comes with torchreg for a shape: of the built-in hand; None for others."""
    if not isinstance(shape, Hand):
        return None
    if shape.side == "right":
        return PoseProposer.load(HAND_WEIGHTS, shape)
    # A left hand's joints are a right one's in a mirror.
    right = PoseProposer.load(HAND_WEIGHTS, Hand(scale=shape.scale).to(shape.rest.device))
    right.mirrored = True
    return right


# The networks of the last shapes that were searched, by what they depend on: most calls are for one shape.
_SHARED: OrderedDict[Hashable, PoseProposer] = OrderedDict()
_MOST_SHARED = 4


def shared_proposer(shape: Articulation) -> PoseProposer | None:
    """Return the same network, read once: all who ask for it share it, so it must not be changed."""
    if not isinstance(shape, Hand):
        return None
    key = (HAND_WEIGHTS, HAND_WEIGHTS.stat().st_mtime_ns, shape.side, shape.scale, shape.rest.device, *_values(shape))
    if key not in _SHARED:
        # What is made in inference mode could not be used outside of it.
        with torch.inference_mode(False):
            found = shipped_proposer(shape)
        if found is None:
            return None
        _SHARED[key] = found
    _SHARED.move_to_end(key)
    while len(_SHARED) > _MOST_SHARED:
        _SHARED.popitem(last=False)
    return _SHARED[key]


@torch.no_grad()
def _values(shape: Articulation) -> tuple[tuple[float, ...], ...]:
    """Return the numbers of a shape that its network depends on: limits, rest pose and proportions."""
    tensors = shape.lower, shape.upper, shape.rest, shape.keypoints(shape.rest_pose())
    return tuple(tuple(tensor.flatten().tolist()) for tensor in tensors)
