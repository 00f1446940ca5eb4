"""`sulcus link`: receive poses and send the tumour position by OpenIGTLink, live."""

from __future__ import annotations

import argparse
import asyncio
import re
import socket
import sys
import threading
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim.errors import InputError

from ..options.shared_options import add_device
from ..options.tissue_options import add_model_tissue, apply_tissue_options
from ..tracked.tracked_scene import build_requested_deformer, build_tracked_scene
from .interrupt import run_until_signal

if TYPE_CHECKING:
    from ..link.received_transforms import TransformNames
    from ..link.session import LinkSession
    from ..play.deformers import PatientSetup
    from ..tracked.tracked_tool import TrackedTool

# Options with the names of transforms and images.
NAME_OPTIONS = "--tool-name", "--reference-name", "--camera-name", "--registration-name"
PORT = 18944
"""Default port of OpenIGTLink."""
CLOSING_TIME = 0.25  # Time for notifying clients before the server stops [s].


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "anatomy", type=Path, metavar="PATIENT.vtu", help="anatomy from `sulcus patient` or `sulcus anatomy`"
    )
    parser.add_argument(
        "--model", type=Path, help="model of a pose-controlled tool (default: those next to the anatomy)"
    )
    parser.add_argument(
        "--deformer", metavar="NAME",
        help="deformation model under the tool: a model of tool poses, guarded, fem or rest. rest: as in the "
        "scan (default: the best model that knows the tool, else rest)",
    )  # fmt: skip
    parser.add_argument("--host", default="127.0.0.1", help="network address of the server")
    parser.add_argument("--port", type=int, default=PORT, help="TCP port; 0: any free port")
    parser.add_argument(
        "--client",
        metavar="HOST[:PORT]",
        help="another server to receive from, such as PLUS; nothing is sent to it. Its port must differ from --port; "
        "IPv6 addresses in brackets",
    )
    parser.add_argument("--clients", type=int, default=16, help="maximum number of clients")
    title = "received transforms [mm]; AToB maps coordinates in frame A to frame B; the scan's space is RAS"
    names = parser.add_argument_group(title)
    names.add_argument("--tool-name", default="StylusTipToReference", help="name of the incoming tool transform")
    names.add_argument(
        "--reference-name", default="ReferenceToTracker", help="name of the incoming reference transform, AToTracker"
    )
    names.add_argument("--camera-name", default="CameraToReference", help="name of the incoming camera transform")
    names.add_argument(
        "--registration-name", default="ReferenceToRas", help="name of the incoming scan registration, RAS"
    )
    parser.add_argument(
        "--registration",
        metavar="R.json",
        help="registration from `sulcus register --anatomy`; without it, a received transform is used, "
        "and results are marked unreliable",
    )
    parser.add_argument(
        "--tool", metavar="TOOL.json",
        help="tool geometry and its pose in the received transform (default: tool of the model, with its origin at "
        "the stylus tip of PLUS)",
    )  # fmt: skip
    parser.add_argument(
        "--tracking-noise", type=float, default=0.5, metavar="MM",
        help="standard deviation of the tip position per axis [mm], which no message contains",
    )  # fmt: skip
    parser.add_argument("--stale", type=float, default=0.3, metavar="SECONDS", help="maximum pose age [s]")
    parser.add_argument(
        "--camera",
        metavar="K.yaml",
        help="calibration from `sulcus calibrate`: the overlay is drawn into each received IMAGE and sent back",
    )
    parser.add_argument(
        "--seconds", type=float, default=float("inf"), help="exit after this many seconds (default: never)"
    )
    add_model_tissue(parser, skull=True)
    add_device(parser, "FEM and rendering")


def run(args: argparse.Namespace) -> int:
    """Serve until --seconds are over, Ctrl-C (exit code 0) or SIGTERM (exit code 143).

    Raises
    ------
    InputError
        Files cannot be read or do not belong together, an option is invalid, or an address cannot be used.
    """
    for name, value in {"--seconds": args.seconds, "--stale": args.stale, "--clients": args.clients}.items():
        if not value > 0:
            raise InputError(f"{name} {value:g}: give a positive number, or leave it out.")
    if not 0.0 <= args.tracking_noise < 100.0:
        raise InputError(f"--tracking-noise {args.tracking_noise:g}: give millimetres, 0 to 100.")
    if not 0 <= args.port < 1 << 16:
        raise InputError(f"--port {args.port}: give a port from 0 to 65535.")
    names = parse_names(args)
    for option, name in zip(NAME_OPTIONS, (names.tool, names.reference, names.camera, names.registration), strict=True):
        if not (name.strip() and name.isascii() and name.isprintable()):
            raise InputError(f"{option} {name!r}: must be of printable ASCII characters.")
    if len(names.by_wire) < len(NAME_OPTIONS):
        raise InputError(f"{', '.join(NAME_OPTIONS)}: must differ in their first 20 characters, which messages carry.")
    if args.host not in ("127.0.0.1", "localhost", "::1"):
        warning = "OpenIGTLink has no password: every program that can reach this address can move the displayed tumour"
        print(f"sulcus link: {warning}", file=sys.stderr)
    source = None if args.client is None else parse_address(args.client)
    if source is not None and source[1] == args.port and is_local_host(source[0], args.host):
        raise InputError(
            f"--client {args.client}: port {args.port} of this machine is the one that is served here. Give --port "
            f"another one, as --port {args.port % 65535 + 1}, or give --client the port of the other server."
        )
    return run_until_signal(partial(_run_link, args, source))


def parse_names(args: argparse.Namespace) -> TransformNames:
    """Return the names of the received transforms from the options."""
    from ..link.received_transforms import TransformNames

    return TransformNames(args.tool_name, args.reference_name, args.camera_name, args.registration_name)


def parse_address(text: str) -> tuple[str, int]:
    """Parse host and port of `HOST[:PORT]`, `[IPv6]:PORT` or an IPv6 address alone.

    Raises
    ------
    InputError
        The text is not an address.
    """
    whole = f"[{text}]" if is_ipv6(text) else text
    found = re.fullmatch(r"(\[[^\[\]]+\]|[^:\[\]]+)(?::([0-9]*))?", whole)
    host, port = (found[1].strip("[]"), int(found[2] or PORT)) if found else ("", PORT)
    if not host or port >= 1 << 16 or (whole.startswith("[") and not is_ipv6(host)):
        raise InputError(
            f"--client {text}: give a host, and a port from 0 to 65535 after a colon; an IPv6 address in brackets, as "
            f"[::1]:{PORT}."
        )
    return host, port


def is_ipv6(text: str) -> bool:
    """Return True if a text is an IPv6 address, with or without a zone (%zone)."""
    try:
        socket.inet_pton(socket.AF_INET6, text.partition("%")[0])
    except OSError:
        return False
    return True


def is_local_host(host: str, server_address: str) -> bool:
    """Return True if a host name is an address of this machine, or equals the server's address."""
    if host == server_address:
        return True
    try:
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM)
    except OSError:
        return False
    return any(_is_own_address(family, address) for family, *_, address in found)


def _is_own_address(family: int, address: tuple) -> bool:
    """Return True if a socket on this machine can be bound to an address."""
    with socket.socket(family, socket.SOCK_DGRAM) as tried:
        try:
            tried.bind(address)
        except OSError:
            return False
        return True


def _run_link(args: argparse.Namespace, source: tuple[str, int] | None, exit_stack: ExitStack) -> int:
    from ..link.console import format_address

    over = threading.Event()

    async def work() -> None:
        session = open_link(args)
        exit_stack.callback(over.wait, CLOSING_TIME)
        exit_stack.callback(session.end)
        ready = asyncio.get_running_loop().create_future()
        ready.add_done_callback(
            lambda port: print(f"sulcus: serves {format_address(args.host, port.result())} (Ctrl-C ends)", flush=True)
        )
        await session.serve(args.host, args.port, args.seconds, ready, source)

    try:
        asyncio.run(work())
    except OSError as error:
        raise InputError(f"no server on {args.host}, port {args.port} ({error}): choose others.") from error
    finally:
        over.set()
    return 0


def open_link(args: argparse.Namespace) -> LinkSession:
    """Build the requested link session; must be called in an event loop.

    Raises
    ------
    InputError
        See `run`.
    """
    from ar.overlay.composite import load_kernels
    from sim.accuracy import LIVE
    from sim.runtime.device import find_device

    from ..link.console import limit_rate, print_safely
    from ..link.outgoing import ResultEncoder
    from ..link.pose_responder import PoseResponder
    from ..link.received_transforms import ReceivedTransforms
    from ..link.session import LinkSession, OverlayCamera
    from ..play.deformers import open_theatre
    from ..tracked.calibration_file import read_calibration
    from ..tracked.overlay_painter import Painter
    from ..tracked.registration_file import describe_other_mesh, read_registration
    from ..tracked.tool_motion import ToolMotion
    from ..tracked.tracked_tool import read_tool

    calibration = None if args.camera is None else read_calibration(args.camera)
    registration = None if args.registration is None else read_registration(args.registration)
    tool = None if args.tool is None else read_tool(args.tool)
    patient = open_theatre(args.anatomy, args.model, args.device)
    warning = (
        f"a {args.registration_name} that is sent does not say whose registration it is"
        if registration is None
        else describe_other_mesh(registration, patient.anatomy, str(args.registration))
    )
    if registration is None or registration.scan is None:
        warning += ". All results are unreliable: give --registration with a file of `sulcus register --anatomy`"
    if warning:
        print(f"sulcus link: {warning}", file=sys.stderr)
    tool = tool or _choose_tool(patient, args.anatomy)
    scene = apply_tissue_options(args, build_tracked_scene(args, tool.shape), patient)
    deformer, who = build_requested_deformer(args, patient, scene, True)
    stage, tracking = patient.build_stage(scene), 1e-3 * args.tracking_noise
    eye = None
    if calibration is not None:
        device = find_device(args.device, LIVE.precision).name
        load_kernels(device)
        eye = OverlayCamera(calibration, Painter(stage, tool, device=device), tracking)
    print(f"{args.anatomy.name}; {tool.shape}; motion by {who}", flush=True)
    answering = PoseResponder(ToolMotion(stage, deformer), tool, tracking, registration)
    seconds = 0.0 if deformer is None else answering.measure_solve_time()
    if deformer is not None:
        print(f"one solution takes {seconds:.2g} s on this machine", flush=True)
    if 2.0 * seconds > args.stale:
        print(
            f"sulcus link: --stale {args.stale:g} is too short for solutions that take {seconds:.2g} s: give --stale "
            f"{np.ceil(3.0 * seconds):.0f}, or a model of the tool's poses",
            file=sys.stderr,
        )
    heard = ReceivedTransforms(parse_names(args), args.stale)
    return LinkSession(
        answering, ResultEncoder(stage, registration is not None), heard, eye, args.clients, limit_rate(print_safely)
    )


def _choose_tool(patient: PatientSetup, path: Path) -> TrackedTool:
    """Return the tool of the best model for poses; its origin is the tip, z points away from the shaft as in PLUS."""
    from ..tracked.tracked_tool import TrackedTool

    posed = [(model.bound, model.tool) for model in patient.models.values() if model.tool is not None]
    if not posed:
        raise InputError(
            f"no model next to {path} supports tool poses. Give --tool TOOL.json with --deformer fem, or train one: "
            "`sulcus simulate --pose-control`, `sulcus train`."
        )
    return TrackedTool(min(posed, key=lambda each: each[0])[1], np.diag([1.0, -1.0, -1.0, 1.0]))
