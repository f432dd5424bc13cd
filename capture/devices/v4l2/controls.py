"""The controls of a video node, by id: never by name, which changed between kernels."""

from __future__ import annotations

import ctypes
import errno
from dataclasses import dataclass, field

from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.node import VideoNode, translated

_NUMBERS = frozenset(
    {
        v4l2.CTRL_TYPE_INTEGER,
        v4l2.CTRL_TYPE_BOOLEAN,
        v4l2.CTRL_TYPE_MENU,
        v4l2.CTRL_TYPE_INTEGER64,
        v4l2.CTRL_TYPE_BITMASK,
        v4l2.CTRL_TYPE_INTEGER_MENU,
    }
)
_MENUS = frozenset({v4l2.CTRL_TYPE_MENU, v4l2.CTRL_TYPE_INTEGER_MENU})


@dataclass(frozen=True)
class Control:
    """What the driver says of a control, at the time it was asked.

    Attributes:
        id: That of linux/v4l2-controls.h.
        name: The driver's, for a person.
        kind: CTRL_TYPE_...
        minimum: Of its values.
        maximum: Likewise.
        step: Between values.
        default: Value of a fresh device.
        flags: CTRL_FLAG_...; they change when another control does.
        menu: Of menus: the values that exist.
    """

    id: int
    name: str
    kind: int
    minimum: int
    maximum: int
    step: int
    default: int
    flags: int
    menu: dict[int, str] = field(default_factory=dict)

    @property
    def inactive(self) -> bool:
        """An automatic has it in hand: writing has no effect, or is refused."""
        return bool(self.flags & v4l2.CTRL_FLAG_INACTIVE)

    @property
    def writable(self) -> bool:
        """Could be written, were it active."""
        return not self.flags & (v4l2.CTRL_FLAG_READ_ONLY | v4l2.CTRL_FLAG_DISABLED)

    @property
    def readable(self) -> bool:
        """Has a value to be read."""
        return not self.flags & (v4l2.CTRL_FLAG_WRITE_ONLY | v4l2.CTRL_FLAG_DISABLED)

    def nearest(self, value: float) -> int:
        """The value that the device can take which is nearest."""
        if self.menu:
            return min(self.menu, key=lambda entry: abs(entry - value))
        steps = round((min(max(value, self.minimum), self.maximum) - self.minimum) / max(1, self.step))
        at = self.minimum + steps * max(1, self.step)
        return at if at <= self.maximum else at - max(1, self.step)


class Controls:
    """The controls of a node. Every method may raise `CameraError`."""

    def __init__(self, node: VideoNode) -> None:
        """Asks nothing yet."""
        self._node = node

    def all(self) -> dict[int, Control]:
        """Every control that has a number for its value, by id."""
        found: dict[int, Control] = {}
        last = 0
        for _ in range(1024):  # a driver that does not advance must not keep us here
            about = v4l2.QueryExtControl(id=last | v4l2.CTRL_FLAG_NEXT_CTRL)
            if not self._listed(v4l2.QUERY_EXT_CTRL, about) or about.id <= last:
                break
            last = about.id
            if control := self._control(about):
                found[control.id] = control
        return found

    def query(self, identity: int) -> Control | None:
        """One control with the flags it has now; None = the device has none of that id."""
        about = v4l2.QueryExtControl(id=identity)
        return self._control(about) if self._listed(v4l2.QUERY_EXT_CTRL, about) else None

    def get(self, control: Control) -> int | None:
        """Its value as the driver tells it, which may be its memory and not the device's; None = untold."""
        if not control.readable:
            return None
        value = v4l2.ExtControl(id=control.id)
        try:
            self._node.call(v4l2.G_EXT_CTRLS, _list_of(value))
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.EACCES, errno.EBUSY, errno.EIO, errno.EPIPE, errno.ENOTTY):
                return None
            raise translated(error, self._node.path, f"tell {control.name!r}") from error
        return int(value.value64 if control.kind == v4l2.CTRL_TYPE_INTEGER64 else value.value)

    def set(self, control: Control, number: int) -> str:
        """Writes a value.

        Returns:
            Empty, or why the device refused, in words. Success does not mean that the value was taken:
            drivers clamp and round without a word.
        """
        value = v4l2.ExtControl(id=control.id)
        if control.kind == v4l2.CTRL_TYPE_INTEGER64:
            value.value64 = number
        else:
            value.value = number
        try:
            self._node.call(v4l2.S_EXT_CTRLS, _list_of(value))
        except OSError as error:
            reason = _REFUSALS.get(error.errno or 0)
            if reason is None:
                raise translated(error, self._node.path, f"set {control.name!r} to {number}") from error
            return reason
        return ""

    def subscribe(self, control: Control) -> bool:
        """Asks to be told when another program or the device changes it; whether the driver does that."""
        try:
            self._node.call(v4l2.SUBSCRIBE_EVENT, v4l2.EventSubscription(type=v4l2.EVENT_CTRL, id=control.id))
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY, errno.ENOMEM):
                return False
            raise translated(error, self._node.path, f"watch {control.name!r}") from error
        return True

    def changes(self) -> dict[int, int]:
        """Values that subscribed controls were changed to since the last call, by id: the last of each."""
        changed: dict[int, int] = {}
        for _ in range(4096):
            event = v4l2.Event()
            try:
                self._node.call(v4l2.DQEVENT, event)
            except OSError as error:
                if error.errno in (errno.ENOENT, errno.EAGAIN, errno.EINVAL, errno.ENOTTY):
                    break
                raise translated(error, self._node.path, "tell its events") from error
            about = event.u.ctrl
            if event.type == v4l2.EVENT_CTRL and about.changes & v4l2.EVENT_CTRL_CH_VALUE:
                wide = about.type == v4l2.CTRL_TYPE_INTEGER64
                changed[event.id] = int(about.value64 if wide else about.value)
        return changed

    def _control(self, about: v4l2.QueryExtControl) -> Control | None:
        if about.type not in _NUMBERS or about.flags & v4l2.CTRL_FLAG_DISABLED:
            return None
        return Control(
            id=about.id,
            name=about.name.decode("utf-8", errors="replace"),
            kind=about.type,
            minimum=about.minimum,
            maximum=about.maximum,
            step=about.step,
            default=about.default_value,
            flags=about.flags,
            menu=self._menu(about) if about.type in _MENUS else {},
        )

    def _menu(self, about: v4l2.QueryExtControl) -> dict[int, str]:
        entries: dict[int, str] = {}
        for index in range(about.minimum, min(about.maximum, about.minimum + 255) + 1):
            entry = v4l2.QueryMenu(id=about.id, index=index)
            if self._listed(v4l2.QUERYMENU, entry):  # EINVAL: this entry is left out, others follow
                entries[index] = entry.name.decode("utf-8", errors="replace")
        return entries

    def _listed(self, request: int, argument: ctypes._CData) -> bool:
        try:
            self._node.call(request, argument)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY, errno.EIO):
                return False
            raise translated(error, self._node.path, "list its controls") from error
        return True


#: Answers of drivers to a value; anything else is trouble with the device.
_REFUSALS = {
    errno.EACCES: "it is read-only or in the hand of an automatic",
    errno.EBUSY: "it is blocked while the camera streams",
    errno.EINVAL: "the device has no such value",
    errno.ERANGE: "the value is out of the device's range",
    errno.EIO: "the device did not take it",
    errno.EPIPE: "the device did not take it",
    errno.EILSEQ: "the device says that the value is out of its range",
    errno.EREMOTEIO: "the device did not take it",
    errno.ETIMEDOUT: "the device did not answer",
}


def _list_of(value: v4l2.ExtControl) -> v4l2.ExtControls:
    """A request of one control; the structure keeps the value alive."""
    return v4l2.ExtControls(count=1, controls=ctypes.pointer(value))
