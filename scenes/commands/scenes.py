"""`sulcus scenes`: the built-in scenes, their effects, who can play them, and what they look like."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from sim.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--out", type=Path, help="folder of a picture of each, SCENE.png, and of all, sheet.png; timed")
    parser.add_argument("--anatomy", type=Path, help=".vtu made by `sulcus anatomy` (default: the template that ships)")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda, for the finite elements")
    parser.add_argument("--json", action="store_true", help="print one JSON line")


def run(args: argparse.Namespace) -> int:
    """List them."""
    from ar.screen import write_png

    from ..scene import SCENES, find_scene
    from ..sheet import sheet, thumbnail
    from ..theatre import open_theatre

    if args.out is not None and args.out.exists() and not args.out.is_dir():
        raise InputError(f"{args.out}: is a file, but the pictures need a folder. Choose another name.")
    theatre = open_theatre(args.anatomy, device=args.device)
    lines = sys.stderr if args.json else sys.stdout
    told, pictures = [], []
    for name in SCENES:
        scene = find_scene(name)
        names = [type(effect).__name__ for effect in scene.effects_on(theatre.anatomy)]
        known = {"scene": name, "title": scene.title, "effects": names, "deformers": list(theatre.names(scene))}
        known["solver"] = theatre.described("fem", scene)
        print(f"{name}: {scene.title}", file=lines)
        print(f"  {', '.join(names)}; played by {', '.join(theatre.names(scene))}\n  {known['solver']}", file=lines)
        if args.out is not None:
            best = theatre.best(scene)
            found = thumbnail(theatre.player(best, scene), best)
            pictures.append(found.colour)
            known |= {"milliseconds": found.milliseconds, "moved_mm": found.moved_mm, "played_by": best}
            print(f"  {found.total:.0f} ms a frame by {best}; the tumour moves {found.moved_mm:.2f} mm", file=lines)
        told.append(known)
    if args.out is not None:
        try:
            args.out.mkdir(parents=True, exist_ok=True)
            for name, picture in zip(SCENES, pictures, strict=True):
                write_png(args.out / f"{name}.png", picture)
            write_png(args.out / "sheet.png", sheet(pictures))
        except OSError as error:
            raise InputError(f"{args.out}: the pictures cannot be written ({error}). Choose another folder.") from error
    if args.json:
        print(json.dumps({"scenes": told, "out": None if args.out is None else str(args.out)}))
    return 0
