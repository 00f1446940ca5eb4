"""Clients of a page: which of them has control, and the line and the buttons that each of them alone sees."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Collection
from dataclasses import dataclass

import viser

from .style import LOOKS_ON

IDLE = 60.0
"""A leader who has set nothing for so long [s] hands over as soon as somebody asks."""


@dataclass
class Lead:
    """The leader's number, when they last set something [s], and who asks to lead, in that order."""

    leader: int | None = None
    acted: float = 0.0
    asking: tuple[int, ...] = ()

    def see(self, here: Collection[int], now: float) -> None:
        """Note who is here: if the leader has left, who asked first leads, or who has been here longest."""
        self.asking = tuple(visitor for visitor in self.asking if visitor in here)
        if self.leader not in here:
            self._pass((*self.asking, *sorted(here), None)[0], now)

    def act(self, visitor: int, now: float) -> bool:
        """Note that a visitor sets something; whether it is heard."""
        if visitor == self.leader:
            self.acted = now
        return visitor == self.leader

    def ask(self, visitor: int, now: float) -> None:
        """Note that a visitor asks to lead."""
        if visitor == self.leader or visitor in self.asking:
            return
        self.asking += (visitor,)
        if now - self.acted >= IDLE:
            self.give(now)

    def give(self, now: float) -> None:
        """Let the visitor lead who asked first."""
        if self.asking:
            self._pass(self.asking[0], now)

    def _pass(self, visitor: int | None, now: float) -> None:
        self.leader, self.acted = visitor, now
        self.asking = tuple(other for other in self.asking if other != visitor)

    def words(self, visitor: int, here: Collection[int]) -> str:
        """What a visitor reads of it, in Markdown; nothing where they are alone."""
        if len(here) < 2:
            return ""
        if visitor == self.leader:
            asked = f" **Visitor {self.asking[0]} asks to lead.**" if self.asking else ""
            return f"You lead: the others look on.{asked}"
        waits = " You have asked to lead." if visitor in self.asking else ""
        return f"Another visitor (number {self.leader}) leads: what you set here is put back.{waits}"


@dataclass(frozen=True, eq=False)
class Row:
    """What one visitor alone sees: a line, buttons that ask to lead and let lead, and rules that dim the controls."""

    line: viser.GuiMarkdownHandle
    ask: viser.GuiButtonHandle
    give: viser.GuiButtonHandle
    dim: viser.GuiHtmlHandle


class Crowd:
    """The visitors of a page, by their numbers from 1 in the order that they came. Only for viser's own thread."""

    def __init__(self, server: viser.ViserServer, order: float) -> None:
        """`order` is where on the page each reads their line."""
        self.server, self.order = server, order
        self.lead = Lead()
        self.rows: dict[int, Row] = {}

    @property
    def here(self) -> set[int]:
        """Numbers of the visitors who look at the page now."""
        return {identifier + 1 for identifier in self.server.get_clients()}

    def heard(self, client: viser.ClientHandle) -> bool:
        """Note that a visitor does something to the page; whether they lead, so that it is heard."""
        now = clock.monotonic()
        self.lead.see(self.here | {client.client_id + 1}, now)
        return self.lead.act(client.client_id + 1, now)

    def read(self, line: Callable[[int], str]) -> None:
        """Show each visitor a line of their own: who leads, after what `line` says to a visitor's number."""
        clients = self.server.get_clients()
        self.rows = {identifier: row for identifier, row in self.rows.items() if identifier in clients}
        here = self.here
        self.lead.see(here, clock.monotonic())
        for identifier, client in clients.items():
            visitor = identifier + 1
            row = self.rows.get(identifier) or self.add_row(client)
            self.rows[identifier] = row
            words = "  \n".join(part for part in (line(visitor), self.lead.words(visitor, here)) if part)
            leads = visitor == self.lead.leader
            _set(row.line, "content", words)
            _set(row.ask, "visible", not leads and visitor not in self.lead.asking)
            _set(row.give, "visible", leads and bool(self.lead.asking))
            _set(row.dim, "content", "" if leads else LOOKS_ON)

    def add_row(self, client: viser.ClientHandle) -> Row:
        """Put into a visitor's page what they alone see."""
        gui, lead = client.gui, self.lead
        ask = gui.add_button("Ask to lead", color="orange", order=self.order + 0.1, visible=False)
        give = gui.add_button("Let them lead", color="orange", order=self.order + 0.2, visible=False)

        @ask.on_click
        async def asked(_: viser.GuiEvent) -> None:
            lead.ask(client.client_id + 1, clock.monotonic())

        @give.on_click
        async def given(_: viser.GuiEvent) -> None:
            if lead.act(client.client_id + 1, clock.monotonic()):
                lead.give(clock.monotonic())

        return Row(gui.add_markdown("", order=self.order), ask, give, gui.add_html("", order=self.order + 0.3))


def _set(handle: object, name: str, value: object) -> None:
    """Change a part of the page only where it is another: each change is sent."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)
