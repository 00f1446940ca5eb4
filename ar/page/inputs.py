"""What visitors set on a page: its controls, buttons and keys, of which only those of who leads are heard."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import viser

from .control_lock import Crowd
from .parts import Choice, Control, Deed, Fold, Key, Note, Slider, Toggle
from .style import NOTE


class Inputs:
    """Controls by their labels. What they call is called on the page's own thread.

    Parameters
    ----------
    deed
        What the newest message did, as the `changed` that it calls may ask.
    kept
        What each control was set to last by who may: what others set is put back.
    notes
        Folders of words by their labels.
    """

    def __init__(self, server: viser.ViserServer, crowd: Crowd) -> None:
        self.server, self.crowd = server, crowd
        self.deed: Deed | None = None
        self.handles: dict[str, viser.GuiInputHandle] = {}
        # By identity, as viser's controls have no hash.
        self.kept: dict[int, float | str] = {}
        self.notes: dict[str, tuple[viser.GuiFolderHandle, viser.GuiHtmlHandle]] = {}
        self.commands: list[viser.CommandHandle] = []

    def clear(self) -> None:
        """Forget all: what is on its way to them comes to nothing."""
        for command in self.commands:
            command.remove()
        self.handles, self.kept, self.notes, self.commands = {}, {}, {}, []

    def assign(
        self, control: viser.GuiInputHandle, value: float | str, wanted: Callable[[], bool] | None = None
    ) -> None:
        """Set a control on the thread that hears the visitors: another could overwrite what is not yet read.

        With `wanted` it is set to another value alone, and if that returns True there.
        """

        def put() -> None:
            # The page may have been filled anew meanwhile.
            if id(control) in self.kept and (wanted is None or (control.value != value and wanted())):
                self.kept[id(control)] = value
                control.value = value

        self.server.get_event_loop().call_soon_threadsafe(put)

    def press(self, button: viser.GuiButtonHandle, act: Callable[[viser.ClientHandle], None]) -> None:
        """Have a button do something for who leads."""

        @button.on_click
        async def pressed(event: viser.GuiEvent) -> None:
            if event.client is not None and self.crowd.heard(event.client):
                self.deed = Deed(event.client.client_id + 1, button.label)
                act(event.client)

    def command(self, key: Key, act: Callable[[viser.ClientHandle], None]) -> None:
        """Have a key of the keyboard do something for who leads."""
        handle = self.server.gui.add_command(key.does.capitalize(), hotkey=key.hotkey)
        self.commands.append(handle)

        @handle.on_trigger
        async def hit(event: viser.CommandEvent) -> None:
            if event.client is not None and self.crowd.heard(event.client):
                self.deed = Deed(event.client.client_id + 1, key.does)
                act(event.client)

    def add(self, control: Control | Fold | Note) -> None:
        """A slider, a list, a box to tick, a folder of them, or a folder of words."""
        gui = self.server.gui
        if isinstance(control, Note):
            with gui.add_folder(control.label, expand_by_default=False, visible=bool(control.words)) as folder:
                self.notes[control.label] = folder, gui.add_html(noted(control.words))
            return
        if isinstance(control, Fold):
            with gui.add_folder(control.label, expand_by_default=False):
                for inner in control.controls:
                    self.add(inner)
            return
        words, hint = control.words or control.label, control.hint
        match control:
            case Toggle():
                handle = gui.add_checkbox(words, control.start, hint=hint)
            case Slider():
                handle = gui.add_slider(words, control.low, control.high, control.step, control.start, hint=hint)
            case Choice():
                handle = gui.add_dropdown(words, control.options, initial_value=control.start, hint=hint)
        self.handles[control.label] = handle
        self.hear(handle, control.changed)
        if isinstance(control, Choice) and control.key is not None:
            self.command(control.key, partial(self.next, handle, control))

    def next(self, handle: viser.GuiInputHandle, choice: Choice, _: viser.ClientHandle) -> None:
        """Choose the next of several names."""
        options = choice.options
        name = options[(options.index(str(handle.value)) + 1) % len(options)]
        self.assign(handle, name)
        choice.changed(name)

    def hear(self, control: viser.GuiInputHandle, changed: Callable[[Any], None]) -> None:
        """Pass on what the leading visitor sets, on the thread that they are heard on, before anything else there."""
        self.kept[id(control)] = control.value

        @control.on_update
        async def update(event: viser.GuiEvent) -> None:
            # The page's own updates come through here too, without a client.
            if event.client is None:
                return
            if not self.crowd.heard(event.client):
                control.value = self.kept[id(control)]
                return
            self.kept[id(control)] = control.value
            self.deed = Deed(event.client.client_id + 1, control.label)
            changed(control.value)


def noted(words: str) -> str:
    """The words of a note, which the rules find by their class."""
    return f'<div class="{NOTE}">{words}</div>'
