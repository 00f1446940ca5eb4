"""Format of the commands' help: options in sections, default values, and metavars by type or unit."""

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SECTIONS = {
    "scene": "--anatomy --trajectory --scene --frame-number",
    "tissue": "--material --young --poisson --ogden --bulk --prony --region --skull --element",
    "model": "--model --deformer --guard --within-error --within-time --learner --learners --locator --device --plugin",
    "camera": "--camera --intrinsics --size --path --path-seed --eye",
    "output": "--out --json --force --style --host --port --address",
}
"""Options of each section of a command's help; other options stay in the section "options"."""
UNITS = {"mm": "MM", "ms": "MS", "s": "SECONDS", "Pa": "PA", "pixel": "PX", "ml": "ML", "1/s": "HZ"}
"""Metavars by unit."""
KINDS: dict[Any, str] = {float: "X", Path: "FILE", None: "NAME"}
"""Metavars by type; an option of another type has the metavar N."""

FORMER = {
    "": "guard-mm:guard within-mm:within-error within-ms:within-time",
    "anatomy": "brain-ml:brain-volume",
    "budget": "corner-px:corner-noise latency-ms:latency clock-ms:time-noise readout-ms:readout",
    "fit": "tool:tool-log",
    "link": "tracking-mm:tracking-noise",
    "locate": "tool:tips",
    "patient": "preset:tool-preset",
    "sensitivity": "preset:tool-preset beside:compare",
    "simulate": "preset:tool-preset poses:pose-control",
    "track": "frame:reference-frame",
    "warp": "frame:frame-number labels:label-maps",
}
"""Former and present names of options, by command ("" for all commands); former names work for one release."""


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Formatter that adds the default value and the metavar to each option's help."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text, default = action.help or "", action.default
        if default is False or default in (None, "", argparse.SUPPRESS, [], ()) or "default: " in text:
            return text
        return f"{text} (default: %(default)s)"

    def _get_default_metavar_for_optional(self, action: argparse.Action) -> str:
        unit = re.search(r"\[([^\],]+)", action.help or "")
        return (unit and UNITS.get(unit[1])) or KINDS.get(action.type, "N")


class CommandParser(argparse.ArgumentParser):
    """Parser of a command, whose help has the sections of `SECTIONS`."""

    def __init__(self, **settings: Any) -> None:
        self._sections: dict[str, argparse._ArgumentGroup] = {}
        super().__init__(**{"formatter_class": HelpFormatter, **settings})
        for title, names in SECTIONS.items():
            self._sections |= dict.fromkeys(names.split(), self.add_argument_group(f"{title} options"))

    def add_argument(self, *names: Any, **settings: Any) -> argparse.Action:
        """Add an argument, in its section of `SECTIONS` if there is one."""
        section = self._sections.get(names[0]) if names else None
        return (super() if section is None else section).add_argument(*names, **settings)


def replace_former_options(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with present instead of former option names; print a notice for each replacement."""
    command = arguments[0] if arguments else ""
    pairs = [pair.partition(":") for key in {"", command} for pair in FORMER.get(key, "").split()]
    names = {f"--{former}": f"--{present}" for former, _, present in pairs}
    replaced = []
    for argument in arguments:
        name, equal, value = argument.partition("=")
        if name in names:
            print(f"sulcus {command}: {name} is now {names[name]}", file=sys.stderr)
        replaced.append(f"{names.get(name, name)}{equal}{value}")
    return replaced
