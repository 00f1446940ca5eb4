"""Text below the help of each command: examples, the next step, and the names of scenes."""

# Names of the scenes. Repeated here, so that a command's help does not import scenes.
NAMES = "spatula, press, slide, draw, palpate, retract, brain_shift, resection, pulsation, sag, lost_force, microscope"
PLAYING_COMMANDS = ("demo", "render", "film", "collect", "check", "effects")
"""Commands that have the name of a scene as an argument."""

EXAMPLES = {  # Examples in the help of each command.
    "anatomy": """examples:
  sulcus anatomy --out brain.vtu --preset superficial
  sulcus anatomy --labels labels.nii.gz --brain 1,2 --tumour 3 --opening-over 2 --out patient.vtu
next: sulcus simulate brain.vtu --out brain.h5""",
    "solve": """example:
  sulcus solve mesh.vtu --material neo-hookean --young 3000 --poisson 0.49 --out moved.vtu
next: open moved.vtu in ParaView; `displacement` is in metres""",
    "simulate": """examples:
  sulcus simulate brain.vtu --out brain.h5 --count 1000
  sulcus simulate brain.vtu --out brain.h5 --count 100000 --device all
next: sulcus train brain.h5 --out brain.model.npz""",
    "train": """example:
  sulcus train brain.h5 --out brain.model.npz --learners linear,series,series-gp
next: sulcus demo --anatomy brain.vtu, which finds brain.model.npz next to the mesh; or sulcus judge""",
    "judge": """example:
  sulcus simulate brain.vtu --out fresh.h5 --count 200 --seed 1
  sulcus judge brain.model.npz fresh.h5
next: sulcus export brain.model.npz --out brain.onnx""",
    "export": """example:
  sulcus export brain.model.npz --out brain.onnx
next: run it by ONNX Runtime; the file itself says what goes in and what comes out""",
    "patient": """examples:
  sulcus patient --sample
  sulcus patient labels.nii.gz --brain 1,2 --tumour 3 --out patient.vtu --inspect
  sulcus patient labels.nii.gz --brain 1,2 --tumour 3 --t1 t1.nii.gz --out patient.vtu
next: sulcus demo --anatomy patient.vtu""",
    "locate": """examples:
  sulcus locate patient.vtu vessels.csv --out located.vtu
  sulcus locate patient.vtu cloud.csv --tips tips.csv --out located.vtu --json
next: open located.vtu in ParaView; `displacement` and `deviation` are in metres""",
    "locator": """examples:
  sulcus locator patient.vtu
  sulcus locator patient.vtu --small
next: sulcus demo sag --anatomy patient.vtu, which finds patient.locator.npz next to the mesh""",
    "fit": """examples:
  sulcus fit patient.vtu drained1.csv drained2.csv pressed.csv --tool-log tools.csv
  sulcus fit patient.vtu drained1.csv drained2.csv --rigid 0.3 --json
next: sulcus uncertainty press --anatomy patient.vtu, which draws its bodies from patient.tissue.json""",
    "scenes": """examples:
  sulcus scenes
  sulcus scenes --out images
next: sulcus demo palpate""",
    "effects": """examples:
  sulcus effects press --every 20
  sulcus effects --anatomy patient.vtu --out patient.effects.json
next: sulcus sensitivity""",
    "demo": """examples:
  sulcus demo
  sulcus demo palpate --anatomy patient.vtu
next: open the address that it prints""",
    "render": """example:
  sulcus render press --out frames --every 2 --film press.mp4
next: sulcus collect press --out press.h5, for depth, segmentation and forces too""",
    "collect": """example:
  sulcus collect press --out press.h5
next: read it by h5py; its attributes give units and frames""",
    "convert": """examples:
  sulcus convert press.h5 --to folder --out press
  sulcus convert episodes --to lerobot --out lerobot
  sulcus convert episodes --to card
next: sulcus validate, before you share the data set""",
    "validate": """examples:
  sulcus validate press.h5
  sulcus validate episodes --solve 3 --json
next: make broken episodes again, or remove them""",
    "episodes": """examples:
  sulcus episodes small --count 8 --out data
  sulcus episodes small --count 1000000 --out data --estimate
next: give the same command on every machine that sees the folder""",
    "markers": """example:
  sulcus markers --out markers
next: print markers/markers.pdf at 100 %, measure its rulers, glue; then record the board for sulcus calibrate""",
    "track": """example:
  sulcus track film.mp4 --camera camera.yaml --reference-frame patient --out tool.csv
next: sulcus calibrate --pivot tool.csv, if the video shows the tool pivoting""",
    "warp": """examples:
  sulcus warp patient.vtu --scene press --frame-number 60 --image t1.nii.gz --out warp
  sulcus warp patient.vtu --located located.vtu --image t1.nii.gz --out warp
next: read warp/README.txt""",
    "film": """examples:
  sulcus film palpate --out film --path hand-held
  sulcus film palpate --out film --trouble reference:1-1.5 --trouble bright:2.5-2.8
next: sulcus overlay film/film.mp4 --camera film/camera.yaml --registration ... (see docs/overlay.md)""",
    "overlay": """examples:
  sulcus overlay film.mp4 --camera K.yaml --registration R.json --tool T.json --out shown.mp4
  sulcus overlay 0 --camera K.yaml --registration R.json --tool T.json
next: look at the video that it wrote""",
    "link": """examples:
  sulcus link patient.vtu --model poses.model.npz --registration registration.json
  sulcus link patient.vtu --model poses.model.npz --client localhost --port 18945

next: add a client of localhost in 3D Slicer's OpenIGTLinkIF; docs/external_tracker.md names what comes""",
    "calibrate": """examples:
  sulcus calibrate board.mp4 --out camera.yaml
  sulcus calibrate images --size 1280x960 --out camera.yaml --json
  sulcus calibrate --pivot poses.csv
  sulcus calibrate --hand-eye tool.csv camera.csv

columns of poses: time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw, from the body to its tracker; other columns are ignored

next: look at the rms and the standard deviations; a good camera has less than 0.3 px""",
    "register": """examples:
  sulcus register touched.csv --anatomy patient.vtu --out registration.json
  sulcus register touched.csv --anatomy patient.vtu --surface traced.csv --out registration.json

px,py,pz in touched.csv: position of the tip relative to the patient's reference, from sulcus track

next: look at the error at the tumour; with 5 mm, touch more points, all round the head""",
    "budget": """examples:
  sulcus budget press
  sulcus budget press --camera camera.yaml --intrinsics camera.json --registration registration.json --twins 20 --json
next: mend the largest; touching more points by sulcus register often is that""",
    "sensitivity": """example:
  sulcus sensitivity --count 8 --out sensitivity.csv
next: open the table in a spreadsheet""",
    "uncertainty": """examples:
  sulcus uncertainty press --anatomy patient.vtu
  sulcus uncertainty press palpate --draws 40 --twins 20 --out tried.json
next: sulcus demo press --anatomy patient.vtu, which shows both errors""",
    "report": """examples:
  sulcus report --quick --out report
  sulcus report --seed-protocol --seed-mesh seed.npz --out seed
next: open report/index.html""",
    "check": """examples:
  sulcus check
  sulcus check press palpate --every 30
next: look at a scene that fails: sulcus render SCENE --out frames""",
}


def format_guidance(command: str) -> str:
    """Return the text below the help of a command."""
    scenes = f"scenes: {NAMES};\n  `sulcus scenes` says what happens in each\n\n" if command in PLAYING_COMMANDS else ""
    return scenes + EXAMPLES[command]
