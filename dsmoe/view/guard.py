"""Which pages in a browser may talk to the viewer's server, those that it has served itself, and what they may say."""
from __future__ import annotations

import contextlib
import ipaddress
import math
import re
import socket
from typing import Any, Callable, Iterator, Optional

from ..errors import TrainerError, printable

MOST_SAID = 20  # refusals that are printed
# The fields of a browser's camera, and how many numbers each has.
CAMERA = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3, "fov": 1, "near": 1, "far": 1, "image_width": 1,
          "image_height": 1}
WHOLE = ("image_width", "image_height")  # which viser makes whole numbers
Takes = Callable[[str, Any], bool]
"""Whether the control with this identifier takes a value."""


def refusal(origin: Optional[str], host: Optional[str], served_at: str) -> Optional[str]:
    """Why a request is not answered; None if it is.

    origin: the header by which a browser says whose page asks; other programs send none. host: the header that says
    what the browser takes this server for. A page of another site may name itself as the host once its name leads here
    (DNS rebinding). So the host must be an address or a name of this machine. served_at: the viewer's --host.
    """
    name = _host_name(host or "")
    if not (_is_address(name) or name == "localhost" or name.endswith(".localhost")
            or name in {each.lower() for each in (served_at, socket.gethostname(), socket.getfqdn())}):
        return (f"{host!r} is not a name of this machine that the viewer knows: open it by the machine's IP address, "
                "or start it with this name as --host")
    if origin is not None and origin.lower().partition("://")[2] != (host or "").lower():
        return f"a page of {origin!r} asks, which the viewer at {host!r} has not served"
    return None


def _host_name(host: str) -> str:
    """Without the port; "" of a text that is not a host, such as `[::1]evil.example`."""
    found = re.fullmatch(r"(?:\[([\da-f:.%]+)\]|([^\[\]:]*))(?::\d*)?", host.lower(), re.ASCII)
    return (found[1] or found[2] or "") if found else ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_wanted(message: Any, takes: Takes) -> bool:
    """Whether the viewer passes a browser's message on: that a camera has moved, or that a control has another value.

    viser knows more: it sets any attribute of a control that a message names, takes files, and asks a server of its
    makers for a public address.
    """
    if not isinstance(message, dict):
        return False
    if message.get("type") == "ViewerCameraMessage":
        return all(_has_numbers(message[name], count) for name, count in CAMERA.items() if name in message) and all(
            math.isfinite(message[name]) for name in WHOLE if name in message)
    if message.get("type") == "GuiUpdateMessage":
        updates = message.get("updates")
        return isinstance(updates, dict) and set(updates) == {"value"} and isinstance(
            updates["value"], (bool, int, float, str)) and isinstance(message.get("uuid"), str) and takes(
            message["uuid"], updates["value"])
    return False


def _has_numbers(value: Any, count: int) -> bool:
    numbers = value if count > 1 else [value]
    return isinstance(numbers, (list, tuple)) and len(numbers) == count and all(
        isinstance(number, (int, float)) for number in numbers)


@contextlib.contextmanager
def only_own_pages(served_at: str, takes: Takes) -> Iterator[None]:
    """A viser server that is started inside refuses what `refusal` names, and the terminal says so.

    Messages that are not wanted are dropped. A browser whose message viser cannot read all the same is left, and a line
    says so. viser checks nothing and has no option for it. So the function by which it
    starts its server is replaced meanwhile.
    Raises TrainerError if this release of viser starts it in another way.
    """
    import viser

    try:
        import msgspec
        from websockets.asyncio import server
    except ImportError as error:
        raise TrainerError(f"viser {viser.__version__} is too old for `dsmoe view`; pip install -U viser") from error
    original, guarded, said = server.serve, [], set()

    def serve(handle: Any, *arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            why = refusal(request.headers.get("Origin"), request.headers.get("Host"), served_at)
            if why is None:
                return process_request(connection, request) if process_request else None
            if why not in said and len(said) < MOST_SAID:
                said.add(why)
                print(f"refused: {why}", flush=True)
            return connection.respond(403, f"dsmoe view: {why}\n")

        async def filtered(connection: Any) -> None:
            receive = connection.recv

            async def next_wanted(*arguments: Any, **options: Any) -> Any:
                while True:
                    data = await receive(*arguments, **options)
                    with contextlib.suppress(Exception):  # what is not MessagePack is dropped too
                        if is_wanted(msgspec.msgpack.decode(data), takes):
                            return data

            connection.recv = next_wanted
            try:
                await handle(connection)
            except Exception as error:
                print(f"left a browser: its message cannot be read ({printable(f'{type(error).__name__}: {error}')})",
                      flush=True)

        guarded.append(True)
        return original(filtered, *arguments, process_request=checked, **options)

    server.serve = serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        server.serve = original  # type: ignore[misc]
    if not guarded:
        raise TrainerError(f"viser {viser.__version__} starts its server in a way that `dsmoe view` cannot guard; "
                           "pip install -U viser")
