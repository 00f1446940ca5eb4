"""Error of a tumour position estimated from stereo images, frame by frame, and time of an update."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scenes.play.deformers import PatientSetup
from scenes.play.observer import TumourEstimate
from scenes.script.observation_models import StereoObservation
from scenes.script.scene import Scene
from sim.errors import InputError


@dataclass(frozen=True)
class StereoRow:
    """Results of the frames of a scene by one seed, or by several.

    Parameters
    ----------
    seed
        Seed of vessels, noise and rigid errors; -1: all seeds.
    frames, refused
        Numbers of frames, and of rejected image pairs.
    points
        Median number of points of accepted pairs.
    moved_mm, off_mm, p95_mm, most_mm
        Motion of the tumour's centroid: its maximum; error of the estimate: median, 95th percentile and
        maximum. A rejected pair counts as an estimate of no motion.
    removed, covered
        Share of the motion over all frames that the estimate removes; empirical coverage of the ellipsoids of pairs
        that were accepted.
    radius_mm
        Median of the reported radius of 95 % probability [mm].
    milliseconds, slowest_ms
        Time of an update, from two images to the estimate [ms]: median, and 95th percentile over frames.
    """

    seed: int
    frames: int
    refused: int
    points: float
    moved_mm: float
    off_mm: float
    p95_mm: float
    most_mm: float
    removed: float
    covered: float
    radius_mm: float
    milliseconds: float
    slowest_ms: float


def measure_scene(
    patient: PatientSetup, scene: Scene, seeds: Sequence[int], frame_step: int,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> Iterator[StereoRow]:  # fmt: skip
    """Measure a row for each seed, and one for all; FEM is solved once for all seeds.

    Raises
    ------
    InputError
        A scene without a stereo camera; an anatomy without a locator.
    """
    if not isinstance(scene.observation_model, StereoObservation):
        raise InputError(f"no pair of eyes sees the scene {scene.name}: choose one with a StereoSight, as microscope.")
    player, numbers = patient.build_player("fem", scene), range(0, len(scene.times), frame_step)
    seen, last, total, done = [], None, len(numbers) * (1 + len(seeds)), 0
    for number in numbers:
        touch = player.get_touch(number)
        last = player.compute_deformation(player.build_loads(number), last)
        positions = player.compute_positions(last)
        held = None if scene.tool is None else player.place_tool(scene.tool, touch, positions)
        seen.append((number, positions, player.stage.compute_tool_corners(None if held is None else held.pose)))
        done += 1
        progress(done, total)
    found: list[TumourEstimate] = []
    for seed in seeds:
        observer = patient.build_stage(
            replace(scene, observation_model=replace(scene.observation_model, seed=seed))
        ).observer
        assert observer is not None
        own = []
        for number, positions, tool in seen:
            own.append(observer.estimate(number, positions, tool))
            done += 1
            progress(done, total)
        found += own
        yield summarise_seed(seed, own)
    yield summarise_seed(-1, found)


def summarise_seed(seed: int, estimates: Sequence[TumourEstimate]) -> StereoRow:
    """Summarise estimates."""
    off = 1e3 * np.array([each.error for each in estimates])
    true = 1e3 * np.array([np.linalg.norm(each.true_motion) for each in estimates])
    seen = [each for each in estimates if each.location is not None]
    radius = [1e3 * each.location.p95 for each in seen if each.location is not None]
    spent = 1e3 * np.array([each.seconds for each in estimates])
    points = [len(each.observation.now) for each in seen]
    return StereoRow(
        seed=seed, frames=len(estimates), refused=len(estimates) - len(seen),
        points=float(np.median(points)) if seen else 0.0,
        moved_mm=float(true.max()), off_mm=float(np.median(off)), p95_mm=float(np.quantile(off, 0.95)),
        most_mm=float(off.max()),
        removed=float(1.0 - off.sum() / true.sum()) if true.any() else np.nan,
        covered=float(np.mean([each.is_covered for each in seen])) if seen else np.nan,
        radius_mm=float(np.median(radius)) if seen else np.nan,
        milliseconds=float(np.median(spent)), slowest_ms=float(np.quantile(spent, 0.95)),
    )  # fmt: skip
