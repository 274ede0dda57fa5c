// A camera that circles around a point: by pointer, by two fingers, by wheel, and by keys.

const TURN = 0.006;  // radians a pixel
const STEP = 0.09;  // radians a key
const LIMIT = 1.5;
const NEAREST = 0.15;
const FARTHEST = 20;

export class Orbit {
  #pointers = new Map();
  #pinch = 0;
  first = null;  // the first view; until there is one nothing can be moved

  // call: is called after each change. T is of z up: angle around z, height above the horizon, distance.
  constructor(element, call) {
    this.call = call;
    this.element = element;
    element.addEventListener("pointerdown", (event) => this.#down(event));
    element.addEventListener("pointermove", (event) => this.#move(event));
    for (const name of ["pointerup", "pointercancel"]) element.addEventListener(name, (event) => this.#pointers.delete(event.pointerId));
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    element.addEventListener("keydown", (event) => this.#key(event));
  }

  set(middle, angle, height, distance) {
    this.first = [middle, angle, height, distance];
    this.reset();
  }

  reset() {
    if (!this.first) return;
    const [middle, angle, height, distance] = this.first;
    Object.assign(this, { middle: [...middle], angle, height, distance });
    this.call();
  }

  apply(camera) {
    const [x, y, z] = this.middle, flat = this.distance * Math.cos(this.height);
    camera.position.set(x + flat * Math.cos(this.angle), y + flat * Math.sin(this.angle), z + this.distance * Math.sin(this.height));
    camera.lookAt(x, y, z);
  }

  #turn(right, up) {
    this.angle -= right;
    this.height = Math.min(LIMIT, Math.max(-LIMIT, this.height + up));
    this.call();
  }

  #zoom(factor) {
    this.distance = Math.min(FARTHEST, Math.max(NEAREST, this.distance * factor));
    this.call();
  }

  // Moves the point in the plane of the screen, by shares of its height.
  #shift(right, up) {
    if (!this.first) return;
    const s = Math.sin(this.angle), c = Math.cos(this.angle), rise = Math.sin(this.height);
    this.middle[0] += this.distance * (right * s + up * rise * c);
    this.middle[1] += this.distance * (-right * c + up * rise * s);
    this.middle[2] -= this.distance * up * Math.cos(this.height);
    this.call();
  }

  #down(event) {
    this.element.setPointerCapture(event.pointerId);
    this.#pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.#pinch = 0;
  }

  #move(event) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before[0], dy = event.clientY - before[1];
    this.#pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const pixels = this.element.clientHeight;
    if (this.#pointers.size === 2) {
      const [a, b] = [...this.#pointers.values()];
      const apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (this.#pinch) this.#zoom(this.#pinch / apart);
      this.#pinch = apart;
      this.#shift(dx / pixels / 2, -dy / pixels / 2);
    } else if (event.buttons & 2 || event.shiftKey) {
      this.#shift(dx / pixels, -dy / pixels);
    } else {
      this.#turn(TURN * dx, TURN * dy);
    }
  }

  #wheel(event) {
    event.preventDefault();
    this.#zoom(Math.exp(0.001 * event.deltaY));
  }

  #key(event) {
    const side = { ArrowLeft: -1, ArrowRight: 1 }[event.key] ?? 0, up = { ArrowDown: -1, ArrowUp: 1 }[event.key] ?? 0;
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (side || up) {
      if (event.shiftKey) this.#shift(-0.04 * side, -0.04 * up);
      else this.#turn(-STEP * side, STEP * up);
    } else if (event.key === "+" || event.key === "=") this.#zoom(0.9);
    else if (event.key === "-") this.#zoom(1 / 0.9);
    else if (event.key === "Home") this.reset();
    else return;
    event.preventDefault();
  }
}
