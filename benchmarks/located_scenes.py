"""Errors of `locate` on motions by causes that its ensemble may lack: built-in scenes, solved by FEM.

    python benchmarks/located_scenes.py [--anatomy A.vtu] [--scenes retract resection ...] [--sights N]

A locator is next to the anatomy (`sulcus locator A.vtu --small`). Five frames of each scene are observed by 30, 100 and
300 points of the open cortex in turn, without the tool: nearly exact, and with the errors of the scene `sag`. A row
has the motion of the tumour's centroid, the error of the estimate and the mean p95 [mm], the share of estimates whose
95 % ellipsoid covers the truth, and the numbers of doubtful and of rejected estimates, as CSV.
"""

import argparse
import csv
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from scenes.play.deformers import PatientSetup, open_theatre
from scenes.play.observer import PointObserver, TumourEstimate
from scenes.script.observation_models import PointObservation
from scenes.script.scene import find_scene
from scenes.script.shipped_files import get_template_path

MOMENTS, COUNTS = 5, (30, 100, 300)
ERRORS = {"none": PointObservation(white=2e-5, smooth=2e-5, shift=0.0, turn=0.0), "of sag": PointObservation()}
"""Errors of points: 0.02 mm stands for no error, as an observation requires a positive error."""


def compute_estimates(patient: PatientSetup, name: str, observation_count: int) -> dict[str, list[TumourEstimate]]:
    """Compute the estimates of a scene, by the errors of its observations."""
    scene = find_scene(name)
    player, last, found = patient.build_player("fem", scene), None, {error: [] for error in ERRORS}
    for number in np.linspace(0, len(scene.times), MOMENTS + 1, dtype=int)[1:] - 1:
        last = player.compute_deformation(player.build_loads(number), last)
        positions = player.compute_positions(last)
        for seed in range(observation_count):
            for error, sight in ERRORS.items():
                seen = replace(sight, seed=seed, points=COUNTS[seed % len(COUNTS)])
                found[error].append(PointObserver(patient.site, patient.locator, seen).estimate(number, positions))
    return found


def summarise_estimates(estimates: list[TumourEstimate]) -> list[str]:
    """Summarise the estimates of one scene."""
    given = [answer for answer in estimates if answer.location is not None]
    moved = 1e3 * np.mean([answer.true_distance for answer in estimates])
    doubted = sum(answer.location.slipped for answer in given if answer.location)
    refused = len(estimates) - len(given)
    if not given:
        return [f"{moved:.2f}", "", "", "", "0", str(refused)]
    off = 1e3 * np.mean([answer.error for answer in given])
    p95 = 1e3 * np.mean([answer.location.p95 for answer in given if answer.location])
    held = 100.0 * np.mean([answer.is_covered for answer in given])
    return [f"{moved:.2f}", f"{off:.2f}", f"{p95:.2f}", f"{held:.0f}", str(doubted), str(refused)]


def main() -> None:
    """Print two rows for each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, default=get_template_path(), metavar="A.vtu")
    parser.add_argument("--scenes", nargs="+", default=["press", "draw", "retract", "brain_shift", "resection"])
    parser.add_argument("--sights", type=int, default=12, metavar="N")
    args = parser.parse_args()
    theatre = open_theatre(args.anatomy, device="cpu")
    table = csv.writer(sys.stdout)
    table.writerow(["scene", "errors", "moved_mm", "off_mm", "p95_mm", "held_percent", "in_doubt", "refused"])
    for name in args.scenes:
        for error, answers in compute_estimates(theatre, name, args.sights).items():
            table.writerow([name, error, *summarise_estimates(answers)])
            sys.stdout.flush()


if __name__ == "__main__":
    main()
