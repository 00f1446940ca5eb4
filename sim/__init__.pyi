"""What tissue does: meshes, laws, loads, and the finite elements that answer them."""

from .accuracy import DRAFT, LIVE, REFERENCE, TRAIN, Accuracy
from .anatomy import Anatomy
from .bodies.label_volume import volume_subject
from .bodies.meshfile import MeshFile, read_anatomy, read_mesh, write_anatomy, write_mesh
from .bodies.open_cortex import OpenCortex, Place, open_cortex
from .bodies.refine import refined
from .bodies.subject import MeshPlan, Subject, make_anatomy
from .bodies.template import Lobed, Tumour, template_subject
from .contact_pressure import pressure
from .deformation import Cost, Deformation, Deformer, Outcome
from .discretisation.body import Body
from .discretisation.term import Cases, Term
from .effects import (
    Elasticity,
    Gravity,
    Held,
    Inertia,
    NodalForce,
    OwnEffect,
    Pulsation,
    Resection,
    Retraction,
    ToolContact,
    ToolDisplacement,
    ToolForce,
    pushed_effects,
)
from .errors import InputError
from .fem import Fem
from .geometry.tetmesh import MeshWarning, TetMesh
from .loads import (
    Displaced,
    Loads,
    Nodal,
    OwnCause,
    Posture,
    Prescribed,
    Pushed,
    Resected,
    Retracted,
    Touching,
    posture,
    push,
    stacked,
)
from .material import BRAIN, MATERIALS, Material, Ogden, Tissue
from .resected_fem import finite_elements
from .skulls import Bonded, SkullContact, Slide
from .tearing import Torn, torn
from .terms.laws.conformance import check_tissue
from .terms.laws.law import Law
from .tools import Ball, Capsule, Core, OwnTool, Spatula

__all__ = [
    "BRAIN",
    "DRAFT",
    "LIVE",
    "MATERIALS",
    "REFERENCE",
    "TRAIN",
    "Accuracy",
    "Anatomy",
    "Ball",
    "Body",
    "Bonded",
    "Capsule",
    "Cases",
    "Core",
    "Cost",
    "Deformation",
    "Deformer",
    "Displaced",
    "Elasticity",
    "Fem",
    "Gravity",
    "Held",
    "Inertia",
    "InputError",
    "Law",
    "Loads",
    "Lobed",
    "Material",
    "MeshFile",
    "MeshPlan",
    "MeshWarning",
    "Nodal",
    "NodalForce",
    "Ogden",
    "OpenCortex",
    "Outcome",
    "OwnCause",
    "OwnEffect",
    "OwnTool",
    "Place",
    "Posture",
    "Prescribed",
    "Pulsation",
    "Pushed",
    "Resected",
    "Resection",
    "Retracted",
    "Retraction",
    "SkullContact",
    "Slide",
    "Spatula",
    "Subject",
    "Term",
    "TetMesh",
    "Tissue",
    "ToolContact",
    "ToolDisplacement",
    "ToolForce",
    "Torn",
    "Touching",
    "Tumour",
    "check_tissue",
    "finite_elements",
    "make_anatomy",
    "open_cortex",
    "posture",
    "pressure",
    "push",
    "pushed_effects",
    "read_anatomy",
    "read_mesh",
    "refined",
    "stacked",
    "template_subject",
    "torn",
    "volume_subject",
    "write_anatomy",
    "write_mesh",
]
