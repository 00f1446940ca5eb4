"""How far a load lies outside the training range, and the bound of its error, as wires."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..data.cortex_patch import Patch
from ..model.conformal import FARTHEST, GROWTH, LEVELS, Bound
from ..model.training_range import SLACK, Envelope
from .graph import Wire
from .regressors import squares_between

# Of force [N]: single precision squares nothing smaller.
FAINTEST = 1e-18


@dataclass(frozen=True, eq=False)
class Push:
    """A push: point (B, 3) [m], unit direction (B, 3), force (B, 1) [N], footprint (B, 1) radius [m]."""

    point: Wire
    direction: Wire
    magnitude: Wire
    footprint: Wire


def push_of(point: Wire, force: Wire, footprint: Wire) -> Push:
    """Of point (B, 3), force (B, 3) and footprint (B,)."""
    magnitude = (force * force).sum().through("Sqrt")
    return Push(point, force / magnitude.through("Max", FAINTEST), magnitude, footprint.shaped(-1, 1))


@dataclass(frozen=True, eq=False)
class Place:
    """Angle (B, 1) to the inward normal [rad] and footprint beyond the rim (B, 1) [m], as `training_range.Measured`."""

    angle: Wire
    overhang: Wire


def place_of(patch: Patch, push: Push) -> Place:
    """Where and how a push meets the patch."""
    nearest = squares_between(push.point, patch.points).argmin()
    normal = push.point.sheet.put("GatherND", patch.inward, nearest)
    # The arc over the chord: single precision has no arc cosine near one.
    against = (push.direction * normal).sum()
    turned = against.sheet.put("Where", against < 0.0, -1.0, 1.0)
    chord = push.direction - turned * normal
    arc = 2.0 * (0.5 * (chord * chord).sum().through("Sqrt")).clip(0.0, 1.0).through("Asin")
    angle = against.sheet.put("Where", against < 0.0, np.pi - arc, arc)
    return Place(angle, push.footprint - _rim_distance(patch.rim, push.point))


def _rim_distance(rim: np.ndarray, point: Wire) -> Wire:
    """Distances (B, 1) [m] of points (B, 3) from edges (E, 2, 3)."""
    start, along = rim[:, 0], rim[:, 1] - rim[:, 0]
    offset = point.shaped(0, 1, -1) - start
    share = (offset * (along / (along * along).sum(axis=1, keepdims=True))).sum().clip(0.0, 1.0)
    apart = offset - share * along
    return (apart * apart).sum().shaped(0, -1).least().through("Sqrt")


def excess_of(envelope: Envelope, push: Push, place: Place) -> Wire:
    """`Envelope.excess` (B, 1)."""
    force, radius = push.magnitude, push.footprint
    far = squares_between(push.point, envelope.points).least().through("Sqrt").of(np.float32)
    askew = place.angle - (envelope.angle + SLACK)
    return push.point.sheet.put(
        "Max",
        1e3 * (far - (envelope.reach + SLACK)),
        1e3 * (place.overhang - (envelope.overhang + SLACK)),
        push.point.sheet.put("Where", force > 0.0, askew, 0.0),
        force / envelope.force[1] - (1.0 + SLACK),
        force / (envelope.line_force * radius) - (1.0 + SLACK),
        envelope.footprint[0] * radius.through("Reciprocal") - (1.0 + SLACK),
        radius / envelope.footprint[1] - (1.0 + SLACK),
        0.0,
    )


def promised(bounds: Bound, push: Push, place: Place, excess: Wire, taught: tuple[float, float]) -> Wire:
    """Bounds (B, 2) [m] for `LEVELS`, as `Learned.deform` has them; `taught` the least and greatest force [N]."""
    sheet, force = push.point.sheet, push.magnitude
    told = [force.clip(*taught).through("Log"), push.footprint.through("Log"), place.angle, 1e3 * place.overhang]
    x = (sheet.joined(*told, 1e3 * push.point) - bounds.mean) / bounds.deviation
    x = x.clip(-FARTHEST, FARTHEST)
    first, second = np.triu_indices(len(bounds.mean))
    monomials = sheet.joined(x, x.columns(*first) * x.columns(*second))
    scale = (monomials @ bounds.weights[1:, None] + bounds.weights[0]).through("Exp")
    # With infinity at its end: no operator reads an empty array.
    member = (force > np.append(bounds.edges, np.inf)).of(np.int64).sum()
    bound = sheet.put("GatherND", bounds.quantile.T, member) * scale * (1.0 + GROWTH * excess)
    weaker = (force / taught[0]).through("Min", 1.0)
    return sheet.put("Where", weaker > 0.0, bound, 0.0) * weaker


def unpromised(push: Push) -> Wire:
    """NaN (B, 2)."""
    return push.magnitude * np.full((1, len(LEVELS)), np.nan)
