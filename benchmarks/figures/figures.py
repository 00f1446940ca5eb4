"""Figures of the performance pages: the measurement, the device and the numbers of each."""

import shlex
from dataclasses import dataclass
from typing import Literal

from .figure_readings import (
    LIMIT,
    LIVE,
    PICTURE,
    STAGES,
    TOGETHER,
    Reading,
    list_element_motions,
    list_growth,
    list_peer_ratios,
    list_rates,
    list_robustness,
    list_shortcut_medians,
    list_skull_motions,
    list_steps,
)

Kind = Literal["cpu", "cuda"]
PROGRAM = ("python", "-m", "benchmarks")


@dataclass(frozen=True)
class Figure:
    """Measurement and the numbers that the pages quote from it.

    Parameters
    ----------
    command
        Arguments after `python -m benchmarks`, without the device.
    device
        Required device.
    readings
        Numbers of the figure.
    quick_options
        Further arguments for a smoke test with small counts; a repeated option overrides the earlier one.
    anatomy_option
        Option for an anatomy; empty: the anatomy is a positional argument; None: not supported.
    modules
        Further required Python modules.
    """

    name: str
    command: str
    device: Kind
    readings: tuple[Reading, ...]
    quick_options: str = ""
    anatomy_option: str | None = "--anatomy"
    modules: tuple[str, ...] = ()


TOOLS = ("bipolar", "dissector", "palpation", "spatula")
PEERS = ("tled", "modified-newton", "scikit-fem", "felupe")
SHORTCUTS = (
    ("nonlinear elimination near the opening", "32 palpation loads together, smoothed"),
    ("nonlinear elimination near the opening", "32 palpation loads together, p1"),
    ("nonlinear elimination, clamped", "a palpation load from rest, quadratic"),
    ("L-BFGS before Newton", "a palpation load from rest"),
    ("contact solved apart", "16 poses of a ball together"),
    ("contact solved apart", "frames of `palpate`, smoothed"),
    ("curvature of the last frame", "frames of `press`, smoothed"),
)
DEFAULT, LINEAR = "--laws neo-hookean --poisson 0.49", "--element p1 --material stable-neo-hookean"
STABLE = "--laws stable-neo-hookean --poisson 0.45"


def _throughput(name: str, device: Kind, words: str, *presets: str, more: tuple[Reading, ...] = ()) -> Figure:
    command = f"throughput {words} --presets {' '.join(presets)}"
    return Figure(name, command, device, (*list_rates(*presets), *more), "--count 4 --repeats 1")


def _live(name: str, device: Kind, words: str) -> Figure:
    return Figure(name, f"live {words}", device, LIVE, "--frames 3 --checked 2")


def _picture(device: Kind, size: str) -> Figure:
    command = f"frame press --size {size} --frames 100"
    return Figure(f"picture-{size}-{device}", command, device, PICTURE, "--frames 3 --batch 1")


def _growth(device: Kind, size: int, *batches: str) -> Figure:
    command = f"growth --element p1 --sizes {size} --batch {' '.join(batches)}"
    return Figure(f"growth-{size}-{device}", command, device, list_growth(*batches), "--sizes 2000", None)


def _poses(element: str, count: int) -> Figure:
    words = f"--poses --element {element} --laws neo-hookean --poisson 0.45 --count {count} --repeats 2"
    return _throughput(f"poses-{element}-{count}-cuda", "cuda", words, "palpation", "bipolar")


def _solver(name: str, device: Kind, words: str, tolerances: str, *peers: str, modules=()) -> Figure:
    command = f"solver --peers {' '.join(peers)} --starts 1 --tolerance {tolerances} {words}"
    return Figure(name, command, device, list_peer_ratios(tolerances.split(), peers), "--loads 2", "--mesh", modules)


def _skull(name: str, nodes: int, *skull: str) -> Figure:
    command = f"skull --nodes {nodes} --poisson 0.49 --skulls {' '.join(skull)}"
    return Figure(f"skull-{name}-cpu", command, "cpu", list_skull_motions(*skull), "--loads 1", "")


_STEPS = list_steps("palpation", "spatula")
_ALL = (*TOOLS, "mixed")
_PACKAGES = ("pypardiso", "felupe", "skfem")

FIGURES = (
    _throughput("throughput-cpu", "cpu", f"{DEFAULT} --count 32", *_ALL, more=(*_STEPS, *TOGETHER)),
    _throughput("throughput-cuda", "cuda", f"{DEFAULT} --count 4096", *_ALL, more=(*_STEPS, *TOGETHER)),
    _live("live-cpu", "cpu", "--frames 60"),
    _live("live-cuda", "cuda", "--frames 1000"),
    Figure("stages-cpu", "stages press", "cpu", STAGES, "--solves 4 --batch 4"),
    Figure("shortcuts-cpu", "shortcuts --runs 8", "cpu", list_shortcut_medians(*SHORTCUTS), "--runs 1"),
    Figure(
        "shortcuts-cuda",
        "shortcuts --runs 40",
        "cuda",
        list_shortcut_medians(("frame as one captured graph", "frames of `press`, smoothed")),
        "--runs 1",
    ),
    *(_picture(device, size) for device in Kind.__args__ for size in ("640x480", "800x600", "960x540")),
    _live("live-linear-cpu", "cpu", f"{LINEAR} --frames 200"),
    _live("live-linear-cuda", "cuda", f"{LINEAR} --frames 1000"),
    _throughput("throughput-linear-cpu", "cpu", f"--element p1 {STABLE} --count 64", *TOOLS, more=TOGETHER),
    *(
        _throughput(
            f"throughput-linear-{law}-{nu}-cuda",
            "cuda",
            f"--element p1 --laws {law} --poisson {nu} --count 16384",
            *_ALL,
            more=(*_STEPS, *TOGETHER),
        )
        for law in ("stable-neo-hookean", "neo-hookean")
        for nu in (0.45, 0.49)
    ),
    _throughput(
        "throughput-beyond-surgery-cuda",
        "cuda",
        f"--element p1 {STABLE} --count 6600",
        "seed",
        "brutal",
        more=list_steps("seed", "brutal"),
    ),
    _throughput(
        "throughput-quadratic-cuda",
        "cuda",
        f"--element p2 {STABLE} --count 2048",
        *TOOLS,
        more=(*list_steps(*TOOLS), *TOGETHER),
    ),
    *(_poses(element, count) for element in ("p1", "smoothed") for count in (64, 1024)),
    *(_growth("cpu", size, "1", "8") for size in (2000, 5300, 17_000, 50_000, 100_000, 200_000)),
    *(_growth("cuda", size, "1", "64") for size in (2000, 5300, 17_000, 50_000, 100_000, 200_000)),
    *(
        _solver(
            f"solver-{threads}-cpu",
            "cpu",
            f"--loads 6 --threads {threads}",
            "1e-4 1e-6 1e-10",
            *PEERS,
            modules=_PACKAGES,
        )
        for threads in (1, 2)
    ),
    _solver("solver-cuda", "cuda", "--loads 4", "1e-4", "tled"),
    Figure(
        "robust-cuda", f"robust --batch 1024 {LINEAR}", "cuda", list_robustness(*TOOLS, "seed", "brutal"), "--count 12"
    ),
    _skull("5300", 5300, "bonded", "slide"),
    _skull("17000", 17_000, "bonded", "slide"),
    _skull("40000", 40_000, "bonded"),
    _skull("tearing", 5300, "bonded", "tearing", "pressing"),
    Figure(
        "elements-cpu",
        "elements --coarse",
        "cpu",
        list_element_motions(("p1", "smoothed", "p2"), (0.30, 0.45, 0.49, 0.495)),
        anatomy_option="",
    ),
    Figure("elements-limit-cpu", "elements --poisson 0.495", "cpu", LIMIT, anatomy_option=""),
)
"""Figures of docs/notes/figures.md and docs/notes/solver_speed.md, by measurement."""
NAMED = {figure.name: figure for figure in FIGURES}


def build_arguments(figure: Figure, is_quick: bool = False, anatomy: str | None = None) -> tuple[str, ...]:
    """Return the arguments after `PROGRAM`; the anatomy follows the first, where no list option can absorb it."""
    first, *rest = figure.command.split()
    body = () if anatomy is None or figure.anatomy_option is None else (*filter(None, [figure.anatomy_option]), anatomy)
    return (first, *body, *rest, *(figure.quick_options.split() if is_quick else ()), "--device", figure.device)


def format_command(figure: Figure, is_quick: bool = False) -> str:
    """Return the command line with which a reader can measure a figure."""
    return shlex.join((*PROGRAM, *build_arguments(figure, is_quick)))
