"""Messages that a client may send to the page: its camera, a control's new value within range, a key that was hit.

Messages are untrusted. Those passed on are encoded again from the checked values: nothing else gets through.
"""

import math
from collections.abc import Callable
from typing import Annotated

import msgspec
import viser

MAX_MESSAGE_BYTES = 65536  # Maximum size of a client's message [bytes]: camera and value take some 300.
RANGE_TOLERANCE = 1e-6  # Tolerance for a browser's rounding, as a share of a slider's range.

Pixels = Annotated[float, msgspec.Meta(ge=0.0, le=65536.0)]
Coordinate = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Vector = tuple[Coordinate, Coordinate, Coordinate]


class MessageError(ValueError):
    """Rejected message; `malformed` if its sender is not a page of this server."""

    def __init__(self, reason: str, malformed: bool = False) -> None:
        super().__init__(reason)
        self.malformed = malformed


class PageCamera(msgspec.Struct, tag_field="type", tag="ViewerCameraMessage", forbid_unknown_fields=True):
    """Camera of a client, in viser's message format."""

    wxyz: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    position: Vector
    fov: Annotated[float, msgspec.Meta(gt=0.0, lt=math.pi)]
    near: Coordinate
    far: Coordinate
    image_height: Pixels
    image_width: Pixels
    look_at: Vector
    up_direction: Vector

    def __post_init__(self) -> None:
        """Reject a camera without a viewing direction."""
        if math.dist(self.position, self.look_at) < 1e-9 or not any(self.up_direction) or not any(self.wxyz):
            raise ValueError("It looks nowhere.")


class ControlValue(msgspec.Struct, forbid_unknown_fields=True):
    """The one property of a control that a client may change."""

    value: bool | int | float | str


class ControlSetting(msgspec.Struct, tag_field="type", tag="GuiUpdateMessage", forbid_unknown_fields=True):
    """Control that a client set, in viser's message format."""

    uuid: str
    updates: ControlValue


class Command(msgspec.Struct, tag_field="type", tag="CommandTriggerMessage", forbid_unknown_fields=True):
    """Key that a client hit, or its entry in the list of commands, in viser's message format."""

    uuid: str


DECODER = msgspec.msgpack.Decoder(PageCamera | ControlSetting | Command)  # Decoder of the messages of a client.


def check_message(message: str | bytes, find_control: Callable[[str], object]) -> bytes:
    """Return the checked message, encoded again; `find_control` finds a control or command by its identifier.

    Raises
    ------
    MessageError
        Anything but a camera, a value in the range of an existing control, or an existing command.
    """
    if isinstance(message, str):
        raise MessageError("it is text", malformed=True)
    try:
        said = DECODER.decode(message)
    except msgspec.ValidationError as error:
        raise MessageError("it is none that a visitor may send") from error
    except (ValueError, RecursionError) as error:
        raise MessageError("it cannot be read", malformed=True) from error
    if isinstance(said, ControlSetting):
        said.updates.value = clamp_value(find_control(said.uuid), said.updates.value)
    if isinstance(said, Command) and not isinstance(find_control(said.uuid), viser.CommandHandle):
        raise MessageError("it is a command that is not there")
    return msgspec.msgpack.encode(said)


def clamp_value(control: object, value: bool | int | float | str) -> bool | int | float | str:
    """Return the value that a control takes.

    Raises
    ------
    MessageError
        A value of another kind, outside the control's range or not among its options; a control that is not there.
    """
    if isinstance(control, viser.GuiButtonHandle | viser.GuiCheckboxHandle) and isinstance(value, bool):
        return value
    if isinstance(control, viser.GuiDropdownHandle | viser.GuiButtonGroupHandle) and value in control.options:
        return value
    if isinstance(control, viser.GuiSliderHandle) and isinstance(value, int | float) and not isinstance(value, bool):
        low, high = control.min, control.max
        slack = RANGE_TOLERANCE * (high - low)
        whole = isinstance(control.value, int)
        # A comparison with NaN is false, so NaN is rejected below.
        if low - slack <= value <= high + slack and (not whole or value == int(value)):
            return int(value) if whole else float(min(max(value, low), high))
    raise MessageError(
        "it sets a control to what that cannot be" if control is not None else "it sets a control that is not there"
    )
