"""The viewer's server: viser moves the camera in the browser, and each picture is rendered here.

Whatever a browser sends may be wrong, and viser passes it on. So numbers are clamped as they are read (`Controls`,
`camera_of`), and what still fails for one browser is said in its panel, while the others go on.
"""
from __future__ import annotations

import contextlib
import math
import threading
import time
from typing import Any, Dict, Optional, Sequence, Tuple

import numpy as np

from diff_smoe_rasterization.settings import BLEND_MODES, GATED_MODES, MAX_BACKGROUND_GATE

from ..errors import TrainerError
from ..inspection import to_image
from ..options.choices import VIEW_HOST, VIEW_PORT
from ..scenes.cameras import Camera, quaternion_to_rotation
from ..system.process import pip_install
from ..system.stopwatch import synchronised_time
from .following import Followed
from .guard import only_own_pages
from .picture import SHOWN, Blend, Look, picture

MOVING_SECONDS = 0.1  # what a picture may take while the camera moves: it is made smaller
REST_SECONDS = 0.2  # from the last move to the picture of full size
MOST_PIXELS = 1920 * 1080
LEAST_SIDE = 16  # px
LEAST_ANGLE = 1e-3  # radians: a field of view lies between this and pi less this
FARTHEST = 1e9  # world units
POLL_SECONDS = 1.0  # between two looks at a training's checkpoint


class Controls:
    """The panel in the browser."""

    def __init__(self, gui: Any, blend: Blend, changed: Any) -> None:
        """gui: viser's. changed(): called whenever the picture has to change."""
        self.shown = gui.add_dropdown("show", SHOWN)
        self.mode = gui.add_dropdown("blend", BLEND_MODES, initial_value=blend.mode)
        self.gate = self._gate(gui, "background gate", blend.background_gate)
        self.beside = gui.add_checkbox("side by side", False)
        self.split = gui.add_slider("split", 0.0, 1.0, 0.01, 0.5)
        self.other_mode = gui.add_dropdown("blend, right", BLEND_MODES,
                                           initial_value="alpha" if blend.mode != "alpha" else "smoe")
        self.other_gate = self._gate(gui, "background gate, right", blend.background_gate)
        self._only_what_matters()

        def update(_: Any) -> None:
            self._only_what_matters()
            changed()

        self._all = (self.shown, self.mode, self.gate, self.beside, self.split, self.other_mode, self.other_gate)
        for control in self._all:
            control.on_update(update)

    @staticmethod
    def _gate(gui: Any, label: str, value: float) -> Any:
        return gui.add_number(label, value, min=0.0, max=MAX_BACKGROUND_GATE, step=0.001,
                              hint="smoe, smoe_eq7: how much the background weighs; 1 is about alpha blending")

    def _only_what_matters(self) -> None:
        self.gate.disabled = self.mode.value not in GATED_MODES
        for control in (self.split, self.other_mode, self.other_gate):
            control.visible = self.beside.value
        self.other_gate.disabled = self.other_mode.value not in GATED_MODES

    def take(self, uuid: str, value: Any) -> bool:
        """Whether the control that viser knows by `uuid` takes a browser's value: a text or a number, as it has one.

        viser makes the one of the other, and fails if a text is not a number.
        """
        return any(control._impl.uuid == uuid and isinstance(value, str) == isinstance(control.value, str)
                   for control in self._all)

    def follow(self, before: Blend, after: Blend) -> None:
        """Takes the background gate that a training has learned meanwhile, if nobody has set another."""
        for gate in (self.gate, self.other_gate):
            if gate.value == before.background_gate:
                gate.value = after.background_gate

    def look(self) -> Look:
        """What is asked for, each value in its range."""
        beside = self._blend(self.other_mode, self.other_gate) if self.beside.value else None
        return Look(self._blend(self.mode, self.gate), _one_of(SHOWN, self.shown.value), beside,
                    _between(0.0, self.split.value, 1.0))

    @staticmethod
    def _blend(mode: Any, gate: Any) -> Blend:
        return Blend(_one_of(BLEND_MODES, mode.value), _between(0.0, gate.value, MAX_BACKGROUND_GATE))


def _one_of(names: Sequence[str], value: Any) -> str:
    return value if value in names else names[0]


def _between(least: float, value: Any, most: float) -> float:
    """The number of the range that is nearest to the value, and the least one for NaN."""
    return min(max(least, float(value)), most)


class Viewer:
    """Shows a model to any number of browsers; one thread renders."""

    def __init__(self, followed: Followed, host: str = VIEW_HOST, port: int = VIEW_PORT) -> None:
        """Starts the server; if the port is taken, it takes the next free one. Raises TrainerError without viser."""
        if not 0 <= port < 2**16:
            raise TrainerError(f"--port is {port}; it must be between 0 and {2**16 - 1}")
        try:
            import viser
        except ImportError as error:
            raise TrainerError(f"the viewer needs viser: {pip_install('viser')}") from error
        self.followed = followed
        with only_own_pages(host, lambda uuid, value: self.controls.take(uuid, value)):
            self.server = viser.ViserServer(host=host, port=port, label="dsmoe view", verbose=False)
        self.server.scene.set_up_direction(tuple(followed.orbit.up.tolist()))
        self.server.gui.configure_theme(dark_mode=True, show_share_button=False)
        # A browser shows these until its first picture arrives, not the white of an empty scene from anywhere.
        self.server.scene.set_background_image(np.asarray(to_image(followed.renderer.background[:, None, None])))
        if hasattr(self.server, "initial_camera"):  # of viser 1.0.1 on
            begin = self.server.initial_camera
            begin.up = tuple(followed.orbit.up.tolist())
            begin.fov, begin.position, begin.look_at = self._first_view()
        self.controls = Controls(self.server.gui, Blend.of(followed.renderer), self._all_changed)
        self._clients: Dict[int, _Client] = {}
        self._wake = threading.Event()
        self._ends = False
        self._polled = time.monotonic()
        self._trouble = ""  # why a training cannot be followed
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(lambda client: self._clients.pop(client.client_id, None) and None)
        self._error: Optional[BaseException] = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def close(self) -> None:
        self._ends = True
        self._wake.set()
        self._thread.join()
        self.server.stop()

    def wait(self) -> None:
        """Until the rendering thread ends, which only an error makes it do; raises that."""
        while self._thread.is_alive():
            self._thread.join(0.5)
        if self._error:
            raise self._error

    def _first_view(self) -> Tuple[float, np.ndarray, np.ndarray]:
        """The first view: the vertical field of view in radians, the camera's place [3], and what it looks at [3]."""
        first, orbit = self.followed.cameras[0], self.followed.orbit
        forward = first.rotation[2]
        distance = max(float(forward @ (orbit.target - first.center)), 0.1)
        return 2 * math.atan(first.height / (2 * first.fy)), first.center, first.center + distance * forward

    def _connected(self, handle: Any) -> None:
        client = self._clients[handle.client_id] = _Client(handle)
        handle.camera.on_update(lambda _: self._moved(client))
        fov, position, target = self._first_view()
        with contextlib.suppress(Exception):  # viser goes from the browser's camera, which may be anything
            handle.camera.fov = fov
            handle.camera.up_direction = self.followed.orbit.up
            handle.camera.position = position
            handle.camera.look_at = target
        self._moved(client)

    def _moved(self, client: _Client) -> None:
        client.moved = time.monotonic()
        client.due = True
        self._wake.set()

    def _all_changed(self) -> None:
        for client in list(self._clients.values()):
            client.due = True
        self._wake.set()

    def _run(self) -> None:
        try:
            self._render_all()
        except BaseException as error:
            self._error = error

    def _render_all(self) -> None:
        while not self._ends:
            self._wake.wait(timeout=REST_SECONDS / 2)
            self._wake.clear()
            if time.monotonic() - self._polled > POLL_SECONDS:
                self._polled = time.monotonic()
                self._follow()
            look = self.controls.look()
            connected = self.server.get_clients()
            for number, client in list(self._clients.items()):
                if number not in connected:  # it may have gone before it was noted
                    self._clients.pop(number, None)
                elif client.wants_picture():
                    client.show(self.followed, look, self._trouble)

    def _follow(self) -> None:
        before, changed, trouble = Blend.of(self.followed.renderer), False, ""
        try:
            changed = self.followed.poll()
            if changed:
                self.controls.follow(before, Blend.of(self.followed.renderer))
        except Exception as error:  # such as of a run that is being replaced: what was there stays in sight
            trouble = str(error) if isinstance(error, TrainerError) else _said_of(error)
        if changed or trouble != self._trouble:
            self._trouble = trouble
            self._all_changed()


def _said_of(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


class _Client:
    """One browser."""

    def __init__(self, handle: Any) -> None:
        self.handle = handle
        self.text = handle.gui.add_markdown("", order=-1)  # above the controls
        self.due = True  # the picture shown is out of date
        self.sharp = False  # the last picture had full size
        self.moved = 0.0  # when the camera moved last
        self.seconds_per_pixel = 0.0

    def wants_picture(self) -> bool:
        return self.due or not self.sharp and time.monotonic() - self.moved > REST_SECONDS

    def show(self, followed: Followed, look: Look, trouble: str = "") -> None:
        """Renders and sends a picture; the panel says what it shows, or why there is none. Raises nothing."""
        try:
            said = self._show(followed, look)
        except Exception as error:
            self.sharp = True  # not again before something changes
            said = f"no picture: {_said_of(error)}"
        with contextlib.suppress(Exception):  # the browser may be gone
            self.text.content = "  \n".join(filter(None, [said, trouble]))

    def _show(self, followed: Followed, look: Look) -> str:
        self.due = False
        camera = camera_of(self.handle.camera, MOST_PIXELS)
        if camera is None:  # the browser's size is not known yet
            self.due = True
            return ""
        moves = time.monotonic() - self.moved < REST_SECONDS
        share = 1.0
        if moves and self.seconds_per_pixel > 0:
            affordable = MOVING_SECONDS / self.seconds_per_pixel
            share = min(1.0, math.sqrt(affordable / (camera.width * camera.height)))
        camera = camera.resized(*(max(LEAST_SIDE, round(side * share)) for side in (camera.width, camera.height)))
        self.sharp = share == 1.0
        device = followed.renderer.background.device
        began = synchronised_time(str(device))
        image = picture(followed.renderer, camera, look)
        seconds = synchronised_time(str(device)) - began
        self.seconds_per_pixel = seconds / (camera.width * camera.height)
        # While the camera moves a picture should arrive soon; at rest it should be right.
        self.handle.scene.set_background_image(image, format="png" if self.sharp and not moves else "jpeg")
        lines = [f"{followed.renderer.model.num_gaussians:,} Gaussians", followed.progress,
                 f"{1 / seconds:.1f} frames/s at {camera.width}x{camera.height} on {device.type}",
                 f"trained with {Blend.of(followed.renderer)}"]
        return "  \n".join(filter(None, lines))


def camera_of(handle: Any, most_pixels: int) -> Optional[Camera]:
    """The pinhole camera of a viser camera, at its browser's size or so many pixels; None before that is known."""
    if not handle.image_width or not handle.image_height:
        return None
    # A side that is clamped for an image 1 pixel wide leaves less for the other one.
    sides = [_between(1, side, 1e9) for side in (handle.image_width, handle.image_height)]
    share = min(1.0, math.sqrt(most_pixels / (sides[0] * sides[1])))
    width, height = (round(_between(LEAST_SIDE, side * share, most_pixels // LEAST_SIDE)) for side in sides)
    width, height = min(width, most_pixels // height), min(height, most_pixels // width)
    rotation = quaternion_to_rotation(handle.wxyz).T
    position = np.asarray([_between(-FARTHEST, number, FARTHEST) for number in handle.position])
    focal = height / (2 * math.tan(_between(LEAST_ANGLE, handle.fov, math.pi - LEAST_ANGLE) / 2))
    return Camera("viewer", rotation, -rotation @ position, focal, focal, width / 2, height / 2, width, height)
