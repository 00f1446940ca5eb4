"""Applicability check: a trained model supports only scenes with the effects, tissue and element of its training."""

import ast
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import astuple, replace
from typing import Any, cast

import numpy as np

from sim.effects import (
    SKULLS,
    Effect,
    Elasticity,
    Gravity,
    Held,
    NodalForce,
    Retraction,
    Slide,
    ToolContact,
    ToolDisplacement,
    ToolForce,
)
from sim.material import Pairs
from sim.tools import BuiltIn, Tool, name_tool

from ..data.load_histories import get_relaxation_series
from ..data.solution_rows import read_tissue_text
from .learned import Learned

# Effects that do nothing without a load of their kind: training may include them although a scene does not.
LOAD_EFFECTS = {kind.__name__ for kind in (ToolForce, ToolDisplacement, NodalForce, Gravity)}
SIZE_TOLERANCE = 1e-9  # Relative tolerance for equal tool sizes, as 26 mm may be written as 0.026 m or 1e-3 * 26.
# Training effects of models whose file does not give them.
DEFAULT_EFFECTS = frozenset(kind.__name__ for kind in (Elasticity, Held, Slide, ToolForce))


def read_trained_effects(provenance: Mapping[str, str]) -> frozenset[str]:
    """Return the effect names of the training, from the provenance of a model or data set; empty if it is invalid."""
    if "effects" not in provenance:
        return DEFAULT_EFFECTS
    with suppress(SyntaxError):
        match ast.parse(provenance["effects"], mode="eval").body:  # `repr` of a tuple of effects
            case ast.Tuple(elts):
                return frozenset(ast.unparse(one.func) for one in elts if isinstance(one, ast.Call))
    return frozenset()


def read_trained_skull(provenance: Mapping[str, str]) -> str:
    """Return a data set's skull model, a key of `sim.effects.SKULLS`; "bonded" if its provenance gives none."""
    names = read_trained_effects(provenance)
    return next((name for name, effect in SKULLS.items() if type(effect).__name__ in names), "bonded")


def find_rejection(model: Learned, effects: Iterable[Effect], element: str | None = None) -> str | None:
    """Return the reason why a model does not support these effects or this element; None if it supports both.

    A model of poses needs contact with its tool; a model of pushes needs `ToolForce`. If the anatomy has no skull,
    `Bonded` and `Slide` are equivalent. Tissue and element must equal those of the training. An `element` of None is
    not compared, nor is a property that the model's file lacks.
    """
    effects = tuple(effects)
    trained, asked = read_trained_effects(model.training), frozenset(type(effect).__name__ for effect in effects)
    if model.tool is not None:
        here = tuple(tool for effect in effects for tool in _get_moved_tools(effect))
        if len(here) != 1 or not _is_same_tool(here[0], model.tool):
            tools = " and ".join(map(name_tool, here)) or "none that is moved"
            return f"it was trained on the poses of {name_tool(model.tool)}, and here is {tools}"
        asked = asked - {Retraction.__name__} | {ToolContact.__name__}
    elif ToolForce.__name__ not in asked:
        others = ", ".join(sorted(asked - trained))
        return f"it was trained on what a tool's force does, and here is none{f', but {others}' if others else ''}"
    idle = set() if model.anatomy.slide_normal.any() else {"Bonded", "Slide"}
    strange, missing = asked - trained - idle, trained - asked - LOAD_EFFECTS - idle
    if not strange and not missing:
        return _describe_body_change(model, effects, element)
    differences = [f"not under {', '.join(sorted(strange))}"] * bool(strange)
    differences += [f"never without {', '.join(sorted(missing))}"] * bool(missing)
    return f"it was trained under {', '.join(sorted(trained))}, {' and '.join(differences)}"


def _is_same_tool(tool: Tool, reference: BuiltIn) -> bool:
    """Return True if two built-in tools have the same class and equal sizes, within round-off."""
    if not isinstance(tool, BuiltIn) or type(tool) is not type(reference):
        return False
    return bool(np.allclose(astuple(tool), astuple(reference), rtol=SIZE_TOLERANCE, atol=0.0))


def _get_moved_tools(effect: Effect) -> tuple[Tool, ...]:
    """Return the tools that an effect moves by pose; () for other effects."""
    if isinstance(effect, Retraction):
        return (effect.blade,)
    return effect.tools if isinstance(effect, ToolContact) else ()


def _describe_series_change(old: Elasticity, new: Elasticity) -> str | None:
    """Describe the difference in relaxation of two tissues that are otherwise equal; None if there is none."""
    learned, asked = get_relaxation_series([old]), get_relaxation_series([new])
    if learned == asked or new.default is None or replace(cast(Any, new.default), prony=learned) != old.default:
        return None
    return f"it learned from tissue that {_format_series(learned)}, and here it {_format_series(asked)}"


def _format_series(series: Pairs) -> str:
    """Describe a Prony series as text that follows "it", such as "relaxes by 50 % in 2 s"."""
    each = " and ".join(f"{100.0 * g:g} % in {tau:g} s" for g, tau in series)
    return f"relaxes by {each}" if each else "does not relax"


def _describe_body_change(model: Learned, effects: tuple[Effect, ...], element: str | None) -> str | None:
    """Describe the difference in tissue or element between a model's training and a scene; None if there is none."""
    stated, here = model.training, next((effect for effect in effects if isinstance(effect, Elasticity)), None)
    if "tissue" in stated and here is not None:
        trained = read_tissue_text(stated)
        if (series := _describe_series_change(trained, here)) is not None:
            return series
        if trained != here:
            return f"it learned from the tissue {trained}, and here it is {here}"
        if get_relaxation_series([here]) and not model.series:
            return "it learned from loads without time, and here the tissue relaxes with it"
    if element is not None and stated.get("element", element) != element:
        return f"it learned from {stated['element']} elements, and here they are {element}"
    return None
