"""Which pages in a browser may talk to the viewer's server: those that it has served itself."""
from __future__ import annotations

import contextlib
import ipaddress
import socket
from typing import Any, Iterator, Optional

from ..trainer.errors import TrainerError

MOST_SAID = 20  # refusals that are printed


def refusal(origin: Optional[str], host: Optional[str], served_at: str) -> Optional[str]:
    """Why a request is not answered; None where it is.

    origin: the header by which a browser says whose page asks; other programs send none. host: the header that says
    what the browser takes this server for. A page of another site may name itself as the host once its name leads here
    (DNS rebinding), so the host has to be an address or a name of this machine. served_at: the viewer's --host.
    """
    name = _host_name(host or "")
    if not (_is_address(name) or name == "localhost" or name.endswith(".localhost")
            or name in {each.lower() for each in (served_at, socket.gethostname(), socket.getfqdn())}):
        return (f"{host!r} is no name of this machine that the viewer knows: open it by the machine's IP address, or "
                "start it with this name as --host")
    if origin is not None and origin.lower().partition("://")[2] != (host or "").lower():
        return f"a page of {origin!r} asks, which the viewer at {host!r} has not served"
    return None


def _host_name(host: str) -> str:
    """Without the port."""
    name = host.lower()
    return name[1:].partition("]")[0] if name.startswith("[") else name.partition(":")[0]


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def only_own_pages(served_at: str) -> Iterator[None]:
    """A viser server that is started inside refuses what `refusal` names, and the terminal says so.

    viser checks nothing and has no option for it. So the function by which it starts its server is replaced meanwhile.
    Raises TrainerError where this release of viser starts it in another way.
    """
    import viser

    try:
        from websockets.asyncio import server
    except ImportError as error:
        raise TrainerError(f"viser {viser.__version__} is too old for `dsmoe view`; pip install -U viser") from error
    original, guarded, said = server.serve, [], set()

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            why = refusal(request.headers.get("Origin"), request.headers.get("Host"), served_at)
            if why is None:
                return process_request(connection, request) if process_request else None
            if why not in said and len(said) < MOST_SAID:
                said.add(why)
                print(f"refused: {why}", flush=True)
            return connection.respond(403, f"dsmoe view: {why}\n")

        guarded.append(True)
        return original(*arguments, process_request=checked, **options)

    server.serve = serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        server.serve = original  # type: ignore[misc]
    if not guarded:
        raise TrainerError(f"viser {viser.__version__} starts its server in a way that `dsmoe view` cannot guard; "
                           "pip install -U viser")
