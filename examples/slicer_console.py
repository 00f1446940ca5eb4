"""The tumour now, in 3D Slicer: a live link, and the files of a warp.

Set the values below. Then type in Slicer's Python console: exec(open("/your/folder/slicer_console.py").read()).
The link wants the extension SlicerOpenIGTLink and a running `sulcus link`; the files are those of `sulcus warp`.
"""

from pathlib import Path

try:
    import slicer  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise SystemExit("slicer_console.py: Slicer is not here. Run it in the Python console of 3D Slicer.") from error

HOST, PORT = "localhost", 18944  # of `sulcus link`; PORT 0: no link
WARP, MRI = "", ""  # the folder of `sulcus warp`, and the scan that goes under its field; "": none
LOOKS = {
    "TumourNow": ((0.20, 0.94, 0.42), 1.0),
    "TumourDoubtful": ((1.00, 0.55, 0.00), 0.6),
    "CortexNow": ((0.86, 0.60, 0.54), 0.4),
    "CortexDoubtful": ((1.00, 0.55, 0.00), 0.3),
    "TumourInScan": ((0.60, 0.60, 0.60), 0.3),
}
"""Colour and opacity of each surface that is sent. What may not be relied on is orange."""


def find_moved_nodes(kind, name):
    """Return the node of a class and a name; create it if missing."""
    found = slicer.util.getFirstNodeByClassByName(kind, name)
    return found or slicer.mrmlScene.AddNewNodeByClass(kind, name)


def connect():
    """Colour the models of the link, and connect: it fills models that are there by their names."""
    if not hasattr(slicer, "vtkMRMLIGTLConnectorNode"):
        raise RuntimeError("Slicer has no OpenIGTLink: install SlicerOpenIGTLink by the Extensions Manager.")
    for name, (colour, opacity) in LOOKS.items():
        model = find_moved_nodes("vtkMRMLModelNode", name)
        model.CreateDefaultDisplayNodes()
        display = model.GetDisplayNode()
        display.SetColor(*colour)
        display.SetOpacity(opacity)
        display.SetVisibility2D(True)
    connector = find_moved_nodes("vtkMRMLIGTLConnectorNode", "sulcus")
    connector.Stop()
    connector.SetTypeClient(HOST, PORT)
    connector.Start()


def load_warp(folder):
    """Load what a warp wrote, and put the scan under its field."""
    bends = slicer.util.loadTransform(str(folder / "field_resampling.nii.gz"))
    slicer.util.loadTransform(str(folder / "field_modeling.nrrd"))
    loaders = {".vtp": slicer.util.loadModel, ".nrrd": slicer.util.loadSegmentation, ".json": slicer.util.loadMarkups}
    for name in ("tumour.vtp", "cortex.vtp", "tumour.seg.nrrd", "landmarks.mrk.json", "tip_to_tumour.mrk.json"):
        if (folder / name).is_file():
            loaders[Path(name).suffix](str(folder / name))
    if MRI:
        slicer.util.loadVolume(MRI).SetAndObserveTransformNodeID(bends.GetID())


if PORT:
    connect()
if WARP:
    load_warp(Path(WARP))
