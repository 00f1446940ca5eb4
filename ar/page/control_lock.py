"""Clients of a page: the lock that gives one client control, the values that clients set, and their buttons."""

import time as clock
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import Any

import viser

from .parts import Control, Dropdown, Folder, Key, LastChange, Note, Slider, Toggle
from .style import NOTE, VIEW_ONLY_STYLE

MAX_IDLE_TIME = 60.0
"""Time [s] without an action of the client with control, after which a request for control is granted at once."""


@dataclass
class ControlLock:
    """State of the control lock: number of the client with control, time [s] of its last action, queue of requests."""

    holder: int | None = None
    last_action: float = 0.0
    queue: tuple[int, ...] = ()

    def update_clients(self, present_clients: Collection[int], time: float) -> None:
        """Update the connected clients; if the holder has left, the first in the queue or the oldest gets control."""
        self.queue = tuple(visitor for visitor in self.queue if visitor in present_clients)
        if self.holder not in present_clients:
            self._give_control((*self.queue, *sorted(present_clients), None)[0], time)

    def record_change(self, client: int, time: float) -> bool:
        """Record that a client changes a setting; return True if the client has control."""
        if client == self.holder:
            self.last_action = time
        return client == self.holder

    def request_control(self, client: int, time: float) -> None:
        """Add a client to the queue for control; if the holder is idle, the first in the queue gets control."""
        if client == self.holder or client in self.queue:
            return
        self.queue += (client,)
        if time - self.last_action >= MAX_IDLE_TIME:
            self.give_control(time)

    def give_control(self, time: float) -> None:
        """Give control to the first client in the queue, if any."""
        if self.queue:
            self._give_control(self.queue[0], time)

    def _give_control(self, client: int | None, time: float) -> None:
        self.holder, self.last_action = client, time
        self.queue = tuple(other for other in self.queue if other != client)

    def describe_control(self, client: int, present_clients: Collection[int]) -> str:
        """Return a client's status line in Markdown; empty if there is only one client."""
        if len(present_clients) < 2:
            return ""
        if client == self.holder:
            asked = f" **Visitor {self.queue[0]} requests control.**" if self.queue else ""
            return f"You have control; the others can only view.{asked}"
        waits = " You have requested control." if client in self.queue else ""
        return f"Visitor {self.holder} has control: your changes are reset.{waits}"


@dataclass(frozen=True, eq=False)
class ClientRow:
    """Elements that only one client sees: status line, buttons to request and hand over control, style rules."""

    line: viser.GuiMarkdownHandle
    request_button: viser.GuiButtonHandle
    release_button: viser.GuiButtonHandle
    dim_style: viser.GuiHtmlHandle


class Clients:
    """Clients of a page, numbered from 1 in order of arrival; to be used only in viser's own thread."""

    def __init__(self, server: viser.ViserServer, position: float) -> None:
        """Create the list of clients; `position` is the sort order of each client's line on the page."""
        self.server, self.order = server, position
        self.lead = ControlLock()
        self.rows: dict[int, ClientRow] = {}

    @property
    def here(self) -> set[int]:
        """Numbers of the connected clients."""
        return {identifier + 1 for identifier in self.server.get_clients()}

    def record_activity(self, client: viser.ClientHandle) -> bool:
        """Record that a client acts on the page; return True if the client has control."""
        now = clock.monotonic()
        self.lead.update_clients(self.here | {client.client_id + 1}, now)
        return self.lead.record_change(client.client_id + 1, now)

    def show_lines(self, format_line: Callable[[int], str]) -> None:
        """Show each client its own line: the text of `format_line`, then who has control."""
        clients = self.server.get_clients()
        self.rows = {identifier: row for identifier, row in self.rows.items() if identifier in clients}
        here = self.here
        self.lead.update_clients(here, clock.monotonic())
        for identifier, client in clients.items():
            visitor = identifier + 1
            row = self.rows.get(identifier) or self.add_row(client)
            self.rows[identifier] = row
            words = "  \n".join(
                part for part in (format_line(visitor), self.lead.describe_control(visitor, here)) if part
            )
            leads = visitor == self.lead.holder
            _set_property(row.line, "content", words)
            _set_property(row.request_button, "visible", not leads and visitor not in self.lead.queue)
            _set_property(row.release_button, "visible", leads and bool(self.lead.queue))
            _set_property(row.dim_style, "content", "" if leads else VIEW_ONLY_STYLE)

    def add_row(self, client: viser.ClientHandle) -> ClientRow:
        """Add the elements that only this client sees; return them."""
        gui, lead = client.gui, self.lead
        ask = gui.add_button("Request control", color="orange", order=self.order + 0.1, visible=False)
        give = gui.add_button("Hand over control", color="orange", order=self.order + 0.2, visible=False)

        @ask.on_click
        async def asked(_: viser.GuiEvent) -> None:
            lead.request_control(client.client_id + 1, clock.monotonic())

        @give.on_click
        async def given(_: viser.GuiEvent) -> None:
            if lead.record_change(client.client_id + 1, clock.monotonic()):
                lead.give_control(clock.monotonic())

        return ClientRow(gui.add_markdown("", order=self.order), ask, give, gui.add_html("", order=self.order + 0.3))


def _set_property(handle: object, name: str, value: object) -> None:
    """Set a property only if it differs, because each change is sent to the client."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


class Inputs:
    """Controls of a page by label, with callbacks that run in the page's own thread.

    Parameters
    ----------
    deed
        Action of the newest message, for the callback that the message triggers.
    kept
        Last value of each control set by the client with control; values of other clients are reset to this value.
    notes
        Folder and text of each note, by label.
    """

    def __init__(self, server: viser.ViserServer, clients: Clients) -> None:
        self.server, self.crowd = server, clients
        self.deed: LastChange | None = None
        self.handles: dict[str, viser.GuiInputHandle] = {}
        # Keyed by identity, as viser's controls have no hash.
        self.kept: dict[int, float | str] = {}
        self.notes: dict[str, tuple[viser.GuiFolderHandle | viser.GuiHtmlHandle, viser.GuiHtmlHandle]] = {}
        self.commands: list[viser.CommandHandle] = []

    def clear(self) -> None:
        """Remove all controls; pending updates then have no effect."""
        for command in self.commands:
            command.remove()
        self.handles, self.kept, self.notes, self.commands = {}, {}, {}, []

    def assign(
        self, control: viser.GuiInputHandle, value: float | str, condition: Callable[[], bool] | None = None
    ) -> None:
        """Set a control in the thread that receives messages, as another thread could overwrite an unread value.

        With `condition` the control is set only if the value differs and `condition`, called there, returns True.
        """

        def set_value() -> None:
            # The page may have been filled again meanwhile.
            if id(control) in self.kept and (condition is None or (control.value != value and condition())):
                self.kept[id(control)] = value
                control.value = value

        self.server.get_event_loop().call_soon_threadsafe(set_value)

    def bind_button(self, button: viser.GuiButtonHandle, action: Callable[[viser.ClientHandle], None]) -> None:
        """Bind a button to an action, which only the client with control can trigger."""

        @button.on_click
        async def pressed(event: viser.GuiEvent) -> None:
            if event.client is not None and self.crowd.record_activity(event.client):
                self.deed = LastChange(event.client.client_id + 1, button.label)
                action(event.client)

    def bind_key(self, key: Key, action: Callable[[viser.ClientHandle], None]) -> None:
        """Bind a key of the keyboard to an action, which only the client with control can trigger."""
        handle = self.server.gui.add_command(key.action.capitalize(), hotkey=key.hotkey)
        self.commands.append(handle)

        @handle.on_trigger
        async def hit(event: viser.CommandEvent) -> None:
            if event.client is not None and self.crowd.record_activity(event.client):
                self.deed = LastChange(event.client.client_id + 1, key.action)
                action(event.client)

    def add(self, control: Control | Folder | Note) -> None:
        """Add a slider, selection, checkbox, note, or folder of these."""
        gui = self.server.gui
        if isinstance(control, Note) and control.is_plain:
            text = gui.add_html(format_note(control.text), visible=bool(control.text))
            self.notes[control.label] = text, text
            return
        if isinstance(control, Note):
            with gui.add_folder(control.label, expand_by_default=False, visible=bool(control.text)) as folder:
                self.notes[control.label] = folder, gui.add_html(format_note(control.text))
            return
        if isinstance(control, Folder):
            with gui.add_folder(control.label, expand_by_default=control.is_open):
                for inner in control.controls:
                    self.add(inner)
            return
        words, hint = control.text or control.label, control.hint
        match control:
            case Toggle():
                handle = gui.add_checkbox(words, control.initial, hint=hint)
            case Slider():
                handle = gui.add_slider(words, control.lower, control.upper, control.step, control.initial, hint=hint)
            case Dropdown():
                handle = gui.add_dropdown(words, control.options, initial_value=control.initial, hint=hint)
        self.handles[control.label] = handle
        self.receive_input(handle, control.on_change)
        if isinstance(control, Dropdown) and control.key is not None:
            self.bind_key(control.key, partial(self.select_next, handle, control))

    def select_next(self, handle: viser.GuiInputHandle, dropdown: Dropdown, _: viser.ClientHandle) -> None:
        """Select the next option of a dropdown, and call its `on_change`."""
        options = dropdown.options
        name = options[(options.index(str(handle.value)) + 1) % len(options)]
        self.assign(handle, name)
        dropdown.on_change(name)

    def receive_input(self, control: viser.GuiInputHandle, callback: Callable[[Any], None]) -> None:
        """Pass values that the client with control sets to `callback`; reset values that other clients set."""
        self.kept[id(control)] = control.value

        @control.on_update
        async def update(event: viser.GuiEvent) -> None:
            # The page's own updates arrive here too, without a client.
            if event.client is None:
                return
            if not self.crowd.record_activity(event.client):
                control.value = self.kept[id(control)]
                return
            self.kept[id(control)] = control.value
            self.deed = LastChange(event.client.client_id + 1, control.label)
            callback(control.value)


def format_note(html: str) -> str:
    """Wrap a note's text (HTML) in an element with a class, for style rules."""
    return f'<div class="{NOTE}">{html}</div>'
