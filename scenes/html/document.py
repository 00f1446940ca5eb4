"""HTML file of a scene, in which a fast model moves the tumour while the user drags the tool over the cortex."""

import base64
import hashlib
import json
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from sim.bodies.lobes import describe_location
from sim.deformation import Outcome
from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.versions import get_version
from surrogate.model.learned import Learned
from surrogate.onnx_export.export import build_graph
from surrogate.onnx_export.graph import GraphBuilder

from ..episodes.reading.bodies import is_template
from ..page.text import RESEARCH_ONLY, format_legend, to_svg_stroke
from ..play.deformers import PatientSetup
from ..play.frame_text import OUTCOME_WARNINGS
from ..play.player import BONE_WARNING
from ..play.stage import TUMOUR_COLOUR
from ..script.registration import REGISTRATIONS, describe_registration
from ..script.scene import Scene
from ..script.shipped_files import get_template_path
from ..script.tool import Probe
from .packing import pack_arrays
from .scene_arrays import build_arrays, describe_camera_and_tool

MAX_BYTES = 2_000_000  # Largest size of the file [bytes].
MAX_MODEL_BYTES = 32_000_000  # Size of a model's arrays above which they do not fit, compressed [bytes].
FORCE_RANGE = 1.5  # Largest force of the page, relative to that of the training.
SCRIPTS = ("graph.js", "contact.js", "model.js", "outline.js", "draw.js", "page.js")
"""Scripts of the page; a script uses only earlier scripts."""


@dataclass(frozen=True, eq=False)
class ExportedModel:
    """Fast model of a page: name, model, computation graph, and True in `cortex` if the graph also moves the cortex."""

    name: str
    model: Learned
    graph: GraphBuilder
    cortex: bool


def write_html(path: str | Path, patient: PatientSetup, scene: Scene, learner: str | None = None) -> ExportedModel:
    """Write the page of a scene atomically; return its model. The cortex does not move if the page would be too large.

    Parameters
    ----------
    learner
        Name of the model; None: the model with the fewest parameters.

    Raises
    ------
    InputError
        There is no model of this name, or a page cannot evaluate it; the scene has no palpation ball; the mesh has too
        many points, or the page has more than `MAX_BYTES`; the path does not end in .html, or the folder cannot be
        written.
    """
    if not isinstance(scene.tool, Probe):
        raise InputError(f"{scene.name}: the page pushes with a palpation ball, which this scene has not.")
    found = choose_model(patient, learner)
    page = build_html(patient, scene, found).encode()
    if found.cortex and len(page) > MAX_BYTES:
        found = build_exported_model(found.name, found.model, with_cortex=False)
        page = build_html(patient, scene, found).encode()
    if len(page) > MAX_BYTES:
        raise InputError(
            f"{found.name}: the page would have {len(page) / 1e6:.1f} MB, but at most {MAX_BYTES / 1e6:g} MB are "
            "allowed: choose another model by --learner."
        )
    with write_atomically(path, ".html") as partial:
        partial.write_bytes(page)
    return found


def choose_model(patient: PatientSetup, learner: str | None = None) -> ExportedModel:
    """Build the computation graph of the model `learner`, or of the model with the fewest parameters if None.

    Raises
    ------
    InputError
        See `write_html`.
    """
    if learner is not None and learner not in patient.models:
        raise InputError(f"no learner is called {learner}: choose from {', '.join(patient.models)}.")
    found, reasons = [], []
    for name in patient.models if learner is None else [learner]:
        try:
            found.append(build_exported_model(name, patient.models[name], with_cortex=True))
        except InputError as error:
            reasons.append(str(error))
    if not found:
        raise InputError(" ".join(reasons) or "there is no model next to this anatomy: make one by `sulcus train`.")
    return min(found, key=lambda one: _count_bytes(one.graph))


def build_exported_model(name: str, model: Learned, with_cortex: bool) -> ExportedModel:
    """Build the computation graph of a model for the tumour, and for the cortex if `with_cortex`.

    Raises
    ------
    InputError
        The model is for tool poses or is far too large, or `build_graph` rejects the model.
    """
    if model.tool is not None:
        raise InputError(f"{name} is a model of poses, but the page pushes by a force: export another learner.")
    sheet = build_graph(name, model, with_cortex)
    if _count_bytes(sheet) > MAX_MODEL_BYTES:
        raise InputError(
            f"{name} has {_count_bytes(sheet) / 1e6:.0f} MB of numbers, too many for a page: export another learner."
        )
    return ExportedModel(name, model, sheet, with_cortex)


def _count_bytes(graph: GraphBuilder) -> int:
    return sum(array.nbytes for array in graph.constants.values())


def build_html(patient: PatientSetup, scene: Scene, exported: ExportedModel) -> str:
    """Build the HTML text of the page with model, surfaces, scripts and style."""
    stage, model = patient.build_stage(scene).without_fine_cortex, exported.model
    nodes = model.nodes if exported.cortex else model.anatomy.tumour_nodes
    table, packed = pack_arrays({**exported.graph.constants, **build_arrays(stage, nodes)})
    described = describe_camera_and_tool(stage, scene.viewpoint.build_camera(stage.site))
    most = described["force"]["most"] = round(FORCE_RANGE * model.envelope.force[1], 2)
    described |= {
        "arrays": table,
        "graph": exported.graph.to_json(),
        "bound": model.bound if np.isfinite(model.bound) else None,
        **_describe_errors(patient, scene),
    }
    script = "\n".join(_read_text(name) for name in SCRIPTS)
    style = _read_text("page.css")
    fields = {
        "title": escape(f"sulcus: {scene.name}"),
        "heading": escape(f"Simulation: {describe_location(patient.anatomy)} tumour, scene {scene.name}"),
        "caption": escape(" ".join(scene.title.split())),
        "restriction": escape(RESEARCH_ONLY),
        "facts": "".join(f'<p class="dim">{escape(fact)}</p>' for fact in _list_facts(patient, exported)),
        "notice": _format_notice() if is_template(patient.anatomy.digest) else "",
        "legend": _format_legend(),
        "most": f"{most:g}",
    }
    return Template(_read_text("page.html")).substitute(
        fields, style=style, style_digest=_compute_digest(style), script=script, script_digest=_compute_digest(script),
        scene=_to_script_json(described), arrays=packed, shaders=_read_text("shaders.glsl"),
    )  # fmt: skip


def _describe_errors(patient: PatientSetup, scene: Scene) -> dict[str, Any]:
    """Return the tumour position error in proportion to the motion, and texts of the page, for JSON."""
    error, registration = patient.estimate_motion_error(scene), scene.registration
    known = None if error is None else {"rest": error.rest[registration], "surface": error.surface}
    words = {
        "still": "the tool does not push: the tumour is where the scan has it",
        "outside": OUTCOME_WARNINGS[Outcome.EXTRAPOLATED],
        "blocked": BONE_WARNING,
        "position": "tumour position error",
        "guess": f"(95\N{NO-BREAK SPACE}%), rough estimate; {describe_registration(REGISTRATIONS[registration])}",
        "unknown": "tumour position error: not known",
    }
    return {"positionError": known, "words": words}


def _list_facts(patient: PatientSetup, exported: ExportedModel) -> list[str]:
    """List sentences about the model, its error bound, the anatomy and the program."""
    model = exported.model
    bound = f"at most {1e3 * model.bound:.2f} mm" if np.isfinite(model.bound) else "not known"
    return [
        f"Fast model: {model.source}.",
        f"Model error (95 % of loads like those of the training, relative to FEM): {bound} at any point of the tumour; "
        "the page shows that of each load.",
        f"Brain: {len(patient.anatomy.mesh.nodes)} mesh points.",
        f"Written by sulcus {get_version('sulcus')}; this file loads nothing from elsewhere.",
    ]


def _format_notice() -> str:
    """Return the notice that the template's authors require in all copies, as HTML."""
    text = get_template_path().with_suffix(".notice.txt").read_text(encoding="utf-8")
    head = "The brain is made from the ICBM 152 template of 2009 (MNI152). Its notice"
    return f'<details class="dim"><summary>{head}</summary>{escape(text)}</details>'


def _format_legend() -> str:
    now = to_svg_stroke(TUMOUR_COLOUR)
    return format_legend(
        [
            (f'{now} stroke-width="3"', "predicted tumour"),
            (f'{now} stroke-width="7" stroke-opacity="0.35"', "model error"),
            (f'{now} stroke-width="1.5" stroke-dasharray="4 3"', "95 % error band"),
            ('stroke="#ddd" stroke-width="2" stroke-dasharray="1.5 3"', "tumour in the scan"),
        ]
    )


def _read_text(name: str) -> str:
    return files("scenes.html").joinpath(name).read_text(encoding="utf-8")


def _compute_digest(text: str) -> str:
    """Compute the digest by which the page's security policy allows an inline script or style."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def _to_script_json(content: dict[str, Any]) -> str:
    """Convert to JSON without "<", so that the text cannot end a script element."""
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")
