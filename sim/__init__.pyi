"""What tissue does: meshes, laws, loads, and the finite elements that answer them."""

from .accuracy import DRAFT, LIVE, REFERENCE, TRAIN, Accuracy
from .adjoint.equilibrium_gradient import EquilibriumGradient, compute_jacobian, differentiate_equilibrium
from .adjoint.torch_function import solve_equilibrium
from .anatomy import Anatomy
from .bodies.label_volume import build_volume_subject
from .bodies.meshfile import MeshFile, read_anatomy, read_mesh, write_anatomy, write_mesh
from .bodies.open_cortex import OpenCortex, Place, open_cortex
from .bodies.refine import refine
from .bodies.subject import MeshPlan, Subject, make_anatomy
from .bodies.template import Lobed, Tumour, build_template_subject
from .contact_pressure import compute_pressure
from .debonding import DebondedSolution, solve_with_debonding
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
    build_push_effects,
)
from .errors import InputError
from .families.registry import FAMILIES, build_family
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
    build_posture,
    push,
    stack,
)
from .material import BRAIN, Material, Ogden, Tissue
from .named_tissues import MATERIALS
from .resected_fem import build_fem
from .skulls import Bonded, SkullContact, Slide
from .terms.laws.conformance import check_tissue
from .terms.laws.law import Law
from .tools import Ball, Capsule, Core, OwnTool, Spatula

__all__ = [
    "BRAIN",
    "DRAFT",
    "FAMILIES",
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
    "DebondedSolution",
    "Deformation",
    "Deformer",
    "Displaced",
    "Elasticity",
    "EquilibriumGradient",
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
    "Touching",
    "Tumour",
    "build_family",
    "build_fem",
    "build_posture",
    "build_push_effects",
    "build_template_subject",
    "build_volume_subject",
    "check_tissue",
    "compute_jacobian",
    "compute_pressure",
    "differentiate_equilibrium",
    "make_anatomy",
    "open_cortex",
    "push",
    "read_anatomy",
    "read_mesh",
    "refine",
    "solve_equilibrium",
    "solve_with_debonding",
    "stack",
    "write_anatomy",
    "write_mesh",
]
