"""A learnt matcher of two partial scans of something that moves: which point is which, and which is hidden."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from torchreg._checks import check_same_kind
from torchreg.errors import InputTypeError
from torchreg.geometry.range_scan import RangeScan
from torchreg.io.tensors import load_tensors
from torchreg.registration.dense.scan_tokens import SIZES, ScanTokens

WEIGHTS = Path(__file__).with_name("scan_matcher.safetensors")
# Tokens, those chosen first and so farthest from each other, whose relations to a token are its context.
_NUM_ANCHORS = 48
# Distance at which relations of tokens change most, share of the scan's size.
_NEAR = 0.1
# Numbers that tell how two oriented points lie to each other, and with the ways between two tokens.
_PAIR_FEATURES, _TOKEN_FEATURES = 5, 8


@dataclass(frozen=True, eq=False)
class ScanMatches:
    """Soft matches of the tokens of two scans.

    Args:
        source_index: (S,) int64 points of the source that are tokens.
        target_index: (T,) int64 points of the target that are tokens.
        probability: (S, T) that two tokens are one place.
        hidden: (S,) probability that the target does not show a token of the source.
        target_hidden: (T,) probability that the source does not show a token of the target.
    """

    source_index: Tensor
    target_index: Tensor
    probability: Tensor
    hidden: Tensor
    target_hidden: Tensor


class ScanMatcher(nn.Module):
    """Tells which points of two partial scans of one moving thing are the same place on it.

    Each scan is cut into 256 tokens. What is around a token and how tokens lie to each other enters by distances and
    angles alone, so that turns and shifts of a scan change nothing; one of the angles has a sign, which tells right
    from left. Tokens attend to those of their own scan, by their relations, and to those of the other one, in turn; the
    similarity of two tokens is the logit of a match, and one more class means that a token is hidden in the other scan.

    Args:
        pretrained: whether to load the weights that come with torchreg.
        width: of a token's description; the weights that come with torchreg have the default, as of the others.
        heads: of attention.
        blocks: of attention, own and across.

    Shape of ``forward(source, target)``: logits (B, S + 1, T + 1) of `ScanTokens` of B scans each; the last row and
    column mean hidden, their corner nothing.

    Differentiable: in its parameters and the tokens' points and normals.

    References: Sun et al. 2021 (LoFTR), for attention within and across and the dual softmax; Drost et al. 2010, for
    point pair features; Sarlin et al. 2020 (SuperGlue), for the class of what has no match.
    """

    def __init__(self, *, pretrained: bool = True, width: int = 96, heads: int = 4, blocks: int = 4) -> None:
        super().__init__()
        hidden = 16
        self.surroundings = nn.ModuleList(
            nn.Sequential(nn.Linear(_PAIR_FEATURES + 1, 32), nn.ReLU(), nn.Linear(32, 64)) for _ in SIZES.radii
        )
        self.embed = nn.Sequential(nn.Linear(64 * len(SIZES.radii) + 1, width), nn.GELU(), nn.Linear(width, width))
        self.relation, self.bias = nn.Linear(_TOKEN_FEATURES, hidden), nn.Linear(hidden, blocks * heads)
        self.anchors, self.context = nn.Linear(_TOKEN_FEATURES, 2 * hidden), nn.Linear(2 * hidden, width)
        self.within = nn.ModuleList(_Attention(width, heads) for _ in range(blocks))
        self.across = nn.ModuleList(_Attention(width, heads) for _ in range(blocks))
        self.norm = nn.LayerNorm(width)
        self.project, self.hidden = nn.Linear(width, width), nn.Linear(width, 1)
        if pretrained:
            self.load_state_dict(_pretrained_state())
            self.eval()

    def forward(self, source: ScanTokens, target: ScanTokens) -> Tensor:
        """Return logits, see the class."""
        (first, first_hidden), (second, second_hidden) = self._described(source, target)
        similarity = first @ second.mT * first.shape[-1] ** -0.5
        corner = similarity.new_zeros(len(similarity), 1, 1)
        top = torch.cat((similarity, first_hidden), dim=2)
        return torch.cat((top, torch.cat((second_hidden.mT, corner), dim=2)), dim=1)

    @torch.no_grad()
    def match(self, source: RangeScan, target: RangeScan) -> ScanMatches:
        """Return the soft matches of two scans.

        Args:
            source: the scan whose points are looked for.
            target: the scan in which they are.

        Raises:
            InputTypeError: if a scan is none, or dtypes or devices differ.

        Cost: 0.15 CPU seconds.
        """
        for name, scan in (("source", source), ("target", target)):
            if not isinstance(scan, RangeScan):
                raise InputTypeError(f"{name} must be a RangeScan, got {type(scan).__name__}")
        check_same_kind(target.points, "target", source.points, "source")
        device = self.project.weight.device
        tokens = [ScanTokens.from_scan(scan).to(device) for scan in (source, target)]
        probability, hidden, target_hidden = match_probabilities(self(*tokens))
        like = source.points
        return ScanMatches(
            source_index=tokens[0].token_index[0].to(like.device),
            target_index=tokens[1].token_index[0].to(like.device),
            probability=probability[0].to(like),
            hidden=hidden[0].to(like),
            target_hidden=target_hidden[0].to(like),
        )

    def _described(self, source: ScanTokens, target: ScanTokens) -> list[tuple[Tensor, Tensor]]:
        """Return descriptions (B, T, C) of the tokens of both scans, and logits (B, T, 1) that they are hidden."""
        states = [self._embedded(scan) for scan in (source, target)]
        biases = [bias.chunk(len(self.within), dim=1) for _, bias in states]
        described = [state for state, _ in states]
        for number, (within, across) in enumerate(zip(self.within, self.across, strict=True)):
            described = [within(state, state, bias[number]) for state, bias in zip(described, biases, strict=True)]
            described = [across(described[0], described[1]), across(described[1], described[0])]
        described = [self.norm(state) for state in described]
        return [(self.project(state), self.hidden(state)) for state in described]

    def _embedded(self, scan: ScanTokens) -> tuple[Tensor, Tensor]:
        """Return first descriptions (B, T, C) of tokens, and what their relations add to attention (B, heads, T, T)."""
        points, normals = scan.at_tokens(scan.points), scan.at_tokens(scan.normals)
        around = _around(scan, points, normals)
        pooled = [
            layer(part * part.new_tensor([1 / radius, *[1.0] * _PAIR_FEATURES])).amax(2).relu()
            for layer, part, radius in zip(
                self.surroundings, around.chunk(len(SIZES.radii), 2), SIZES.radii, strict=True
            )
        ]
        edge = scan.at_tokens(scan.boundary).to(points).unsqueeze(-1)
        relation = _relations(points, normals, scan.geodesic.to(points))
        anchors = self.anchors(relation[:, :, :_NUM_ANCHORS]).relu().mean(2)
        state = self.embed(torch.cat((*pooled, edge), dim=-1)) + self.context(anchors)
        return state, self.bias(self.relation(relation).relu()).movedim(-1, 1)


class _Attention(nn.Module):
    """A block of attention of tokens to others, and a layer for each of them."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.first_norm, self.second_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.query, self.key_value, self.out = (
            nn.Linear(width, width),
            nn.Linear(width, 2 * width),
            nn.Linear(width, width),
        )
        self.layer = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))

    def forward(self, state: Tensor, others: Tensor, bias: Tensor | None = None) -> Tensor:
        parts = (self.query(self.first_norm(state)), *self.key_value(self.first_norm(others)).chunk(2, -1))
        query, key, value = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        mixed = nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=bias)
        state = state + self.out(mixed.transpose(1, 2).flatten(2))
        return state + self.layer(self.second_norm(state))


def match_probabilities(logits: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return probabilities (B, S, T) of matches, and that tokens are hidden, (B, S) and (B, T), of logits.

    A match is as likely as both tokens choose each other.
    """
    by_source, by_target = logits[:, :-1].softmax(2), logits[:, :, :-1].softmax(1)
    return by_source[..., :-1] * by_target[:, :-1], by_source[..., -1], by_target[:, -1]


def _around(scan: ScanTokens, points: Tensor, normals: Tensor) -> Tensor:
    """Return how the neighbors of tokens lie to them and whether they are on the boundary, (B, T, 2 K, 6)."""
    row = torch.arange(len(scan), device=points.device)[:, None, None]
    to, facing = scan.points[row, scan.neighbors], scan.normals[row, scan.neighbors]
    offset = to - points.unsqueeze(2)
    distance = offset.norm(dim=-1, keepdim=True)
    along, own = offset / distance.clamp_min(1e-6), normals.unsqueeze(2)
    angles = [
        (first * second).sum(-1, keepdim=True) for first, second in ((own, along), (facing, along), (own, facing))
    ]
    side = (torch.linalg.cross(own.expand_as(along), along) * facing).sum(-1, keepdim=True)
    return torch.cat((distance, *angles, side, scan.boundary[row, scan.neighbors].to(points).unsqueeze(-1)), dim=-1)


def _relations(points: Tensor, normals: Tensor, geodesic: Tensor) -> Tensor:
    """Return how all pairs of tokens (B, T, 3) lie to each other, (B, T, T, 8)."""
    distance = torch.cdist(points, points)
    inverse = distance.clamp_min(1e-6).reciprocal()
    height = points @ normals.mT
    own = (points * normals).sum(-1)
    turned = torch.linalg.cross(points, normals)
    features = (
        2 * distance,
        geodesic,
        (-distance / _NEAR).exp(),
        (-geodesic / _NEAR).exp(),
        (height.mT - own.unsqueeze(2)) * inverse,  # of the way from one to the next over the first's normal
        (own.unsqueeze(1) - height) * inverse,  # and over the second's
        normals @ normals.mT,
        (normals @ turned.mT + turned @ normals.mT)
        * inverse,  # their triple product: right and left differ in its sign
    )
    return torch.stack(features, dim=-1)


def _pretrained_state() -> dict[str, Tensor]:
    return {name: value.float() for name, value in load_tensors(WEIGHTS)[0].items()}


@cache
def shared_matcher() -> ScanMatcher:
    """Return the same matcher with the weights that come with torchreg, read once."""
    # Layers draw weights before those of the file replace them: the caller's random state stays.
    with torch.random.fork_rng(devices=[]):
        return ScanMatcher().requires_grad_(False)
