"""`sulcus film`: a scene as a real camera films it, with printed targets in view, and all that is true of it."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim.arguments import at_least
from sim.errors import InputError
from sim.runtime.atomic_files import REMEDY, why

from ..options.camera_options import add_camera, filmed_with_targets
from ..options.outputs import add_force, claimed, claimed_folder, claimed_frames
from ..options.shared_options import add_json, add_seed, json_line
from ..options.theatre_options import add_theatre, scene_asked, theatre_asked

if TYPE_CHECKING:
    from ..play.deformers import Theatre
    from ..play.player import Player
    from ..script.scene import Scene
    from ..tracked.filming import Shot, Trouble

# Named here too, so that a command's help waits for no picture to be drawn.
TROUBLES = ("reference", "tool", "bright", "smear", "gap")
# Files that are written beside the film.
FILES = ("camera.yaml", "camera.json", "registration.json", "tool.json", "truth.npz", "truth.csv")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", help="a built-in scene with a tool, see `sulcus scenes`, or MY_SCENE.py")
    parser.add_argument(
        "--out", required=True, type=Path, metavar="DIR",
        help="folder for film.mp4, camera.yaml and .json, registration.json, tool.json, truth.npz and truth.csv",
    )  # fmt: skip
    parser.add_argument("--every", type=int, default=1, help="film one frame in so many (default %(default)s)")
    parser.add_argument("--seconds", type=float, help="film only so much of the scene [s]")
    parser.add_argument("--png", action="store_true", help="write DIR/frames/*.png, without loss, in place of film.mp4")
    parser.add_argument("--blur", type=float, default=0.5, metavar="PX", help="of the lens (default %(default)s)")
    parser.add_argument("--noise", type=float, default=2.0, help="of each pixel, of 255 (default %(default)s)")
    parser.add_argument(
        "--readout", type=float, metavar="MS",
        help="a rolling shutter: how much later the last row is taken than the first [ms] (default: the camera's)",
    )  # fmt: skip
    add_seed(parser, "noise and of --registered")
    parser.add_argument(
        "--trouble", type=trouble, action="append", default=[], metavar="KIND:FROM-TO",
        help=f"what goes wrong between two times [s]: {', '.join(TROUBLES)}; may be given again",
    )  # fmt: skip
    parser.add_argument(
        "--registered", type=float, nargs=2, default=(0.0, 0.0), metavar=("MM", "DEGREES"),
        help="how far the registration is off at the opening: deviations along and about each axis (default 0 0)",
    )  # fmt: skip
    add_theatre(parser)
    add_camera(parser)
    add_force(parser)
    add_json(parser)


def trouble(text: str) -> tuple[str, float, float]:
    """KIND:FROM-TO as a name and two times [s], for argparse."""
    found = re.fullmatch(r"(\w+):([\d.]+)-([\d.]+)", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form KIND:FROM-TO, such as tool:1.0-1.5")
    try:
        return found[1], float(found[2]), float(found[3])
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} has times that are no numbers") from None


def run(args: argparse.Namespace) -> int:
    """Film and write. Returns 0.

    Raises
    ------
    InputError
        What cannot be read, written or filmed; numbers that are out of range.
    """
    from ..tracked.calibration_file import write_calibration, write_exactly_known
    from ..tracked.filming import Taking, Trouble, mounted, registered, shots_of
    from ..tracked.registration_file import write_registration
    from ..tracked.tracked_tool import write_tool
    from ..tracked.truth import Truth, write_table, write_truth

    at_least("--every", args.every, 1)
    for name, value in (
        ("--blur", args.blur),
        ("--noise", args.noise),
        *(("--registered", x) for x in args.registered),
    ):
        if not 0.0 <= value < np.inf:
            raise InputError(f"{name} {value:g}: give a number that is not below 0.")
    shift, turn = args.registered
    taking = Taking(args.blur, args.noise, tuple(Trouble(*each) for each in args.trouble), args.seed)
    theatre = theatre_asked(args, args.scene)
    scene = _scene(args, theatre)
    if all("gap" in taking.happening(time) for time in scene.times[:: args.every].tolist()):
        raise InputError("no picture would be taken: give --seconds and --trouble that leave some.")
    _demand_troubles(taking.troubles, scene.times[:: args.every])
    calibration = scene.viewpoint.calibration
    assert calibration is not None
    folder = claimed_folder(args.out, "film and its truth")
    paths = {name: claimed(folder / name, Path(name).suffix, args.force) for name in FILES}
    player = theatre.player(args.deformer or "fem", scene)
    mounts = mounted(player)
    shots: list[Shot] = []
    film = _write_film(args, shots_of(player, mounts, taking, args.every), shots, player)
    write_calibration(paths["camera.yaml"], replace(calibration, name=f"sulcus film: {scene.name}"))
    write_exactly_known(paths["camera.json"], calibration)
    write_registration(paths["registration.json"], registered(player.site, mounts, shift, turn, args.seed))
    write_tool(paths["tool.json"], mounts.tool)
    truth = Truth(
        player.site.anatomy.digest,
        np.array([shot.time for shot in shots]),
        np.stack([shot.T_camera_scan for shot in shots]),
        np.stack([shot.T_scan_tool for shot in shots]),
        np.stack([shot.displacement for shot in shots]),
    )
    write_truth(paths["truth.npz"], truth)
    write_table(paths["truth.csv"], truth, player.stage.tumour_at_rest.vertices)
    moved = 1e3 * float(np.linalg.norm(truth.displacement, axis=2).mean(axis=1).max())
    report = {"scene": scene.name, "frames": len(shots), "film": str(film), "tumour_moves_mm": moved}
    said = f"{len(shots)} pictures of {scene.name}, in which the tumour moves by up to {moved:.2f} mm: {film}"
    print(json_line(report) if args.json else said)
    return 0


def _demand_troubles(troubles: Sequence[Trouble], times: np.ndarray) -> None:
    """Refuse a trouble in which no picture is taken, of those at `times` (F,) [s]: it would change nothing."""
    for each in troubles:
        if not ((each.since <= times) & (times < each.until)).any():
            raise InputError(
                f"--trouble {each.kind}:{each.since:g}-{each.until:g} meets no picture of this film, which ends at "
                f"{times[-1]:.2f} s: give times within it, or a smaller --every."
            )


def _scene(args: argparse.Namespace, theatre: Theatre) -> Scene:
    """The scene as the camera sees it, and no longer than is asked for."""
    scene = filmed_with_targets(args, scene_asked(args, args.scene, theatre))
    if args.readout is not None:
        view = scene.viewpoint
        assert view.calibration is not None
        try:
            calibration = replace(view.calibration, readout=1e-3 * args.readout)
        except ValueError as error:
            raise InputError(f"--readout {args.readout:g}: {error}") from error
        scene = replace(scene, viewpoint=replace(view, calibration=calibration))
    return scene if args.seconds is None else replace(scene, duration=min(args.seconds, scene.duration))


def _write_film(args: argparse.Namespace, taken: Iterator[Shot], shots: list[Shot], player: Player) -> Path:
    """Write the pictures, and note what is true of each in `shots`; returns the film, or the folder of pictures."""
    from tqdm import tqdm

    from ar.screen import Film, write_film

    def noted() -> Iterator[np.ndarray]:
        total = len(range(0, len(player.scene.times), args.every))
        for shot in tqdm(taken, total=total, unit="picture", file=sys.stderr):
            shots.append(replace(shot, colour=shot.colour[:0]))
            yield shot.colour

    try:
        if not args.png:
            args.out.mkdir(parents=True, exist_ok=True)
            film = claimed(args.out / "film.mp4", ".mp4", args.force)
            write_film(film, noted(), player.scene.frames_per_second / args.every)
            return film
        frames = claimed_folder(args.out / "frames", "pictures")
        for path in claimed_frames(frames, args.force):
            path.unlink()
        screen = Film(frames)
        for number, colour in enumerate(noted()):
            screen.show(number, colour)
        return frames
    except OSError as error:
        raise InputError(f"{args.out}: the film cannot be written ({why(error)}). {REMEDY}") from error
    except ValueError as error:
        raise InputError(str(error)) from error
