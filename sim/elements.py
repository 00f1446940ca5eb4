"""Available finite elements, by name."""

ELEMENTS = {  # descriptions by name
    "p1": "linear tetrahedra: the fastest, and too stiff, the more so the less tissue can be compressed",
    "p2": "quadratic tetrahedra: the most accurate, seven times as many nodes",
    "smoothed": "linear tetrahedra with strains averaged over edges and nodes: nearly as accurate as p2 on p1's nodes",
}
MESHLESS = {  # the same, of discretisations without finite elements
    "element-free": "moving least squares on the vertices, integrated over the tetrahedra: locks less than p1"
}
RECOMMENDED = "smoothed"
"""Default element of scenes and commands, on meshes of linear tetrahedra."""
