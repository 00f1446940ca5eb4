"""Messages that a client may send to the page: its camera, a control's new value, a key or command.

Messages are untrusted. The checked values are encoded again, so that nothing else is passed on.
"""

import math
from collections.abc import Callable
from typing import Annotated

import msgspec
import viser

MAX_MESSAGE_BYTES = 65536  # Maximum size of a client's message [bytes]; a camera or a value takes some 300.
RANGE_TOLERANCE = 1e-6  # Tolerance for a browser's rounding, as a share of a slider's range.

Pixels = Annotated[float, msgspec.Meta(ge=0.0, le=65536.0)]
Coordinate = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Vector = tuple[Coordinate, Coordinate, Coordinate]


class MessageError(ValueError):
    """Error for a rejected message; `malformed` is True if no page of this server would send such a message."""

    def __init__(self, reason: str, malformed: bool = False) -> None:
        super().__init__(reason)
        self.malformed = malformed


class PageCamera(msgspec.Struct, tag_field="type", tag="ViewerCameraMessage", forbid_unknown_fields=True):
    """Camera of a client, as a message in viser's format."""

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
        """Raise ValueError for a camera without a viewing direction."""
        if math.dist(self.position, self.look_at) < 1e-9 or not any(self.up_direction) or not any(self.wxyz):
            raise ValueError("It looks nowhere.")


class ControlValue(msgspec.Struct, forbid_unknown_fields=True):
    """New value of a control, which is the only property that a client may change."""

    value: bool | int | float | str


class ControlSetting(msgspec.Struct, tag_field="type", tag="GuiUpdateMessage", forbid_unknown_fields=True):
    """New setting of a control by a client, as a message in viser's format."""

    uuid: str
    updates: ControlValue


class Command(msgspec.Struct, tag_field="type", tag="CommandTriggerMessage", forbid_unknown_fields=True):
    """Command that a client triggered, by its key or in the list of commands, as a message in viser's format."""

    uuid: str


DECODER = msgspec.msgpack.Decoder(PageCamera | ControlSetting | Command)  # Decoder of the messages of a client.


def check_message(message: str | bytes, find_control: Callable[[str], object]) -> bytes:
    """Check a message and return it encoded again; `find_control` finds a control or command by its identifier.

    Raises
    ------
    MessageError
        The message is not a camera, a value in the range of an existing control, or an existing command.
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
    """Return the value for a control, clamped to its range within round-off.

    Raises
    ------
    MessageError
        The value has another type, is outside the range or not an option, or the control does not exist.
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
