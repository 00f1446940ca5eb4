"""Every way to answer on every set of frames, and how errors fall with the number of training episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from errors import Errors, distances, errors_of
from frames import Frames
from inputs import INPUTS, PICTURE_AND_POSE, POSE_ALONE, Inputs
from neighbours import in_scan, neighbours
from networks import Training, fitted

from sim.errors import InputError

ASIDE = 0.15
"""Share of the training episodes that says when to stop, and how many neighbours answer."""
NETWORK, NEIGHBOURS, TRAINING = "network", "nearest frames", "training"
FEWEST = 4
Answers = Callable[[Frames], np.ndarray]


@dataclass(frozen=True)
class Row:
    """Errors of one way to answer on one set, by its number of training episodes."""

    test: str
    way: str
    given: str
    episodes: int
    errors: Errors


@dataclass(frozen=True, eq=False)
class Sets:
    """Frames to train on, and those to test on by name: no episode is in two of them."""

    training: Frames
    tests: Mapping[str, Frames]


def sets_of(pool: Frames, count: int, others: Mapping[str, Frames]) -> Sets:
    """The first `count` episodes of a pool to train on; its others, on the same bodies, and further sets to test on.

    A set with families that training has not is tested in two parts.

    Raises
    ------
    InputError
        Too few episodes, or a set in which no frame can be tested.
    """
    episodes = pool.episodes
    if not FEWEST <= count < len(episodes):
        raise InputError(
            f"--training {count}: give {FEWEST} to {len(episodes) - 1}, as {len(episodes)} episodes are there."
        )
    training = pool.of(episodes[:count])
    known = np.unique(training.family)
    tests = {"same bodies": _tested(pool.of(episodes[count:]))}
    for name, frames in ((name, _tested(frames)) for name, frames in others.items()):
        same = np.isin(frames.family, known)
        parts = {f"{name}, same motions": same, f"{name}, other motions": ~same} if (~same).any() else {name: same}
        tests |= {part: frames.at(which) for part, which in parts.items() if which.any() or len(parts) == 1}
    empty = [name for name, frames in tests.items() if not len(frames)]
    if empty:
        raise InputError(f"{empty[0]}: no frame of it was solved by finite elements. Add episodes.")
    return Sets(training.at(training.usable), tests)


def _tested(frames: Frames) -> Frames:
    return frames.at(frames.tested)


def split(training: Frames, count: int, seed: int) -> tuple[Frames, Frames]:
    """Frames of `count` training episodes drawn by a seed: to train on, and to set aside."""
    drawn = np.random.default_rng(seed).permutation(training.episodes)[:count]
    aside = max(1, round(ASIDE * count))
    return training.of(drawn[aside:]), training.of(drawn[:aside])


def network_answers(
    inputs: Inputs, training: Frames, aside: Frames, seed: int, device: torch.device, how: Training
) -> Answers:
    """Those of a network."""
    return fitted(inputs, training, aside, seed, device, how).answers


def neighbour_answers(
    inputs: Inputs, training: Frames, aside: Frames, seed: int, device: torch.device, how: Training
) -> Answers:
    """Those of the nearest frames; nothing is drawn."""
    return neighbours(inputs, training, aside, device).answers


WAYS = {NEIGHBOURS: neighbour_answers, NETWORK: network_answers}
LEARNING = ((NEIGHBOURS, POSE_ALONE), (NEIGHBOURS, PICTURE_AND_POSE), (NETWORK, PICTURE_AND_POSE))
"""Of these errors are found with fewer episodes, too; without pictures frames that are near are more alike."""


def rows(
    sets: Sets,
    sizes: Sequence[int],
    seeds: Sequence[int],
    device: torch.device,
    how: Training,
    said: Callable[[str], object],
) -> Iterator[Row]:
    """All rows: what learns nothing, each way with all training episodes, and some with fewer.

    `said` hears what is trained next.
    """
    whole = len(sets.training.episodes)
    middle = in_scan(sets.training, sets.training.label).mean(axis=0)
    for test, frames in sets.tests.items():
        for way, answers in (
            ("no displacement", np.zeros_like(frames.truth)),
            ("mean of training", frames.turn @ middle),
            ("labels", frames.label),
        ):
            yield _row(test, way, "", whole, frames, distances(answers, frames.truth)[None])
    jobs = [(way, inputs, whole) for inputs in INPUTS for way in WAYS]
    jobs += [(*one, size) for size in sorted(sizes) if FEWEST <= size < whole for one in LEARNING]
    for way, inputs, size in jobs:
        off: dict[str, list[np.ndarray]] = {test: [] for test in sets.tests}
        for seed in seeds:
            said(f"{way}: {inputs.name}; {size} episodes, seed {seed}")
            answers = WAYS[way](inputs, *split(sets.training, size, seed), seed, device, how)
            for test, frames in sets.tests.items():
                off[test].append(distances(answers(frames), frames.truth))
        for test, frames in sets.tests.items():
            yield _row(test, way, inputs.name, size, frames, np.stack(off[test]))


def _row(test: str, way: str, given: str, size: int, frames: Frames, off: np.ndarray) -> Row:
    return Row(test, way, given, size, errors_of(off, frames.episode, frames.body))
