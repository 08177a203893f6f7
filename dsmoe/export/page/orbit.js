// The camera that the mouse moves: dragging turns it about the target, with the right button or Shift it is shifted,
// the wheel and two fingers bring it nearer. A camera is x_view = rotation x_world + translation, x right, y down.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);
const times = (rows, v) => rows.map((row) => dot(row, v));
const column = (rows, i) => rows.map((row) => row[i]);

// Rotates v about a unit axis by an angle in radians.
function turned(v, axis, angle) {
  const cos = Math.cos(angle), sin = Math.sin(angle);
  const cross = [axis[1] * v[2] - axis[2] * v[1], axis[2] * v[0] - axis[0] * v[2], axis[0] * v[1] - axis[1] * v[0]];
  return v.map((value, i) => value * cos + cross[i] * sin + axis[i] * dot(axis, v) * (1 - cos));
}

class Orbit {
  // up: unit vector of the world; target: the point that the camera turns about. changed(): called after each move.
  constructor(canvas, up, target, changed) {
    this.canvas = canvas, this.up = up, this.target = target, this.changed = changed;
    const fingers = new Map();
    canvas.style.touchAction = "none";
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, event);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    }
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const x = event.clientX - before.clientX, y = event.clientY - before.clientY;
      if (fingers.size === 2) {
        const [other] = [...fingers.values()].filter((finger) => finger.pointerId !== event.pointerId);
        const apart = (finger) => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
        this.zoom(apart(before) / Math.max(1, apart(event)));
      } else if (event.buttons & 2 || event.shiftKey) {
        this.shift(x, y);
      } else {
        this.turn(4 * x / canvas.clientHeight, 4 * y / canvas.clientHeight);
      }
      fingers.set(event.pointerId, event);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(0.001 * event.deltaY));
    }, {passive: false});
  }

  // camera: {rotation, translation, ...}; what else it has stays as it is.
  look(camera) {
    this.camera = camera;
    this.rotation = camera.rotation;
    this.eye = times([0, 1, 2].map((i) => column(camera.rotation, i)), camera.translation).map((value) => -value);
    this.changed();
  }

  get translation() { return times(this.rotation, this.eye).map((value) => -value); }

  // By angles in radians, about the world's upright axis and the camera's horizontal one.
  turn(yaw, pitch) {
    this.turnAbout(this.up, yaw);
    const right = this.rotation[0], forward = turned(this.rotation[2], right, -pitch);
    if (Math.abs(dot(forward, this.up)) < 0.99) this.turnAbout(right, -pitch);
    this.changed();
  }

  turnAbout(axis, angle) {
    this.eye = plus(this.target, turned(plus(this.eye, this.target, -1), axis, angle));
    this.rotation = this.rotation.map((row) => turned(row, axis, angle));
  }

  // By pixels of the page, at the target's depth.
  shift(x, y) {
    const depth = Math.abs(dot(this.rotation[2], plus(this.target, this.eye, -1)));
    const scale = depth / this.forImage(this.canvas.clientWidth, this.canvas.clientHeight).fy;
    const move = plus(this.rotation[0].map((value) => -x * scale * value), this.rotation[1], -y * scale);
    this.eye = plus(this.eye, move), this.target = plus(this.target, move);
    this.changed();
  }

  // Scales the distance to the target.
  zoom(factor) {
    this.eye = plus(this.target, plus(this.eye, this.target, -1), factor);
    this.changed();
  }

  // The camera of an image of this size in pixels; the whole view is in it, and more beside it or above and below.
  forImage(width, height) {
    const {camera} = this, scale = Math.min(width / camera.width, height / camera.height);
    return {rotation: this.rotation, translation: this.translation, fx: camera.fx * scale, fy: camera.fy * scale,
            cx: width / 2 + (camera.cx - camera.width / 2) * scale,
            cy: height / 2 + (camera.cy - camera.height / 2) * scale};
  }
}
