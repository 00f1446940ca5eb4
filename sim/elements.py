"""Available finite elements, by name."""

ELEMENTS = {  # descriptions by name
    "p1": "linear tetrahedra: the fastest, and too stiff, the more so the less tissue can be compressed",
    "p2": "quadratic tetrahedra: the most accurate, seven times as many nodes",
    "smoothed": "linear tetrahedra with strains averaged over edges and nodes: nearly as accurate as p2 on p1's nodes",
}
RECOMMENDED = "smoothed"
"""Default element of scenes and commands, on meshes of linear tetrahedra."""
OTHER_METHODS = {"springs": "mass-spring model", "element-free": "element-free Galerkin method"}
"""Discretisations other than finite elements that `Fem` supports, mapped to the method names shown in results."""
