"""Whom nobody beats in both of two things, such as time and error."""

from __future__ import annotations

from collections.abc import Mapping


def unbeaten(places: Mapping[str, tuple[float, float]]) -> frozenset[str]:
    """Names whose two numbers no other equals or undercuts in both: the Pareto front, equals included."""
    return frozenset(
        name
        for name, (time, error) in places.items()
        if not any(t <= time and e <= error and (t, e) != (time, error) for t, e in places.values())
    )
