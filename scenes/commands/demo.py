"""`sulcus demo`: play a scene on a page in the browser."""

from __future__ import annotations

import argparse
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sim.errors import InputError

from ..options.camera_options import add_camera_options, apply_camera_options
from ..options.patient_options import add_patient, build_requested_scene, choose_deformer, open_patient
from ..options.shared_options import add_address, add_style, list_addresses, print_addresses

if TYPE_CHECKING:
    from ..script.scene import Scene


VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm")
"""Endings of video file names."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "scene", nargs="?",
        help="a built-in scene or MY_SCENE.py (default: the first scene that a trained model supports, spatula on the "
        "template, or else press)",
    )  # fmt: skip
    add_patient(parser)
    add_camera_options(parser)
    add_style(parser)
    parser.add_argument(
        "--host", default="127.0.0.1", help="network address of the server; users of other machines need a token"
    )
    parser.add_argument("--port", type=int, default=8080, help="port, or the next free one")
    add_address(parser)
    parser.add_argument(
        "--seconds", type=float, default=float("inf"), help="exit after this many seconds (default: never)"
    )


def run(args: argparse.Namespace) -> int:
    """Serve the page until --seconds are over, Ctrl-C (exit code 0) or SIGTERM (exit code 143)."""
    from ar.overlay.composite import load_kernels
    from sim.accuracy import LIVE
    from sim.runtime.device import find_device

    asked = args.scene or ""
    if asked.isdecimal() or Path(asked).suffix.lower() in VIDEO_SUFFIXES or (asked and Path(asked).is_dir()):
        own = f"sulcus overlay {args.scene} --page --camera K.yaml --registration R.json --tool T.json"
        raise InputError(f"{args.scene} is not a scene. For your own video or camera: {own}")
    if not args.seconds > 0.0:
        raise InputError(f"--seconds {args.seconds:g}: must be > 0; or leave it out.")
    list_addresses(args)
    find_device(args.device, LIVE.precision)
    # One thread for all kernels of the first image: each compilation reads Warp's headers first, for two seconds.
    kernels = ThreadPoolExecutor(1, "kernels")
    kernels.submit(load_kernels)
    from ar.page.access_guard import check_address

    from .interrupt import run_until_signal

    try:
        check_address(args.host, args.port)
    except (OSError, ValueError) as error:
        raise InputError(f"no page on host {args.host}, port {args.port} ({error}): choose others.") from error
    return run_until_signal(partial(play_demo, args, kernels))


def play_demo(args: argparse.Namespace, kernel_loader: ThreadPoolExecutor, exit_stack: ExitStack) -> int:
    """Open the page, wait for `kernel_loader` to load kernels, and play; return 0. `exit_stack` closes the page."""
    from ar.page.access_guard import ViserError

    from ..page.demo import Demo

    patient = open_patient(args, *([] if args.scene is None else [args.scene]))

    def get_scene(name: str) -> Scene:
        return apply_camera_options(args, build_requested_scene(args, name, patient))

    scene = get_scene(args.scene or patient.select_default_scene())
    name = choose_deformer(args, patient, scene)
    anatomy = "the average of 152 healthy adults (ICBM 152)" if args.anatomy is None else args.anatomy.name
    try:
        demo = Demo(
            patient, scene, name, args.host, args.port,
            anatomy=anatomy, get_scene=get_scene, style=args.style, origins=list_addresses(args),
        )  # fmt: skip
    except ViserError as error:
        raise InputError(str(error)) from error
    exit_stack.callback(demo.close)
    print(f"sulcus: open {demo.browser.address} (Ctrl-C ends)", flush=True)
    print_addresses(demo.browser)
    print(f"{scene.name} by {patient.describe_deformer(name, scene)}")
    demo.busy.begin_work("compiling; the next start finds it done")
    if name != "fem":
        kernel_loader.submit(demo.cast.predict, name, (0, None))
    kernel_loader.shutdown()
    demo.run(args.seconds)
    return 0
