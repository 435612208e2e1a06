// What the operator holds: keys, a gamepad's stick, or the mouse on a leash. All of it is dropped at once when the page
// loses focus, is hidden, or the mouse leaves; what was held then has to be pressed anew.

const KEYS = {
  ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [-1, 0], ArrowRight: [1, 0],
  KeyW: [0, 1], KeyS: [0, -1], KeyA: [-1, 0], KeyD: [1, 0],
};
const DEAD_ZONE = 0.15; // of a stick
const LEASH = 90; // [px] a longer one is not faster
const SHORTEST_LEASH = 8; // [px]
const GRIP = 36; // [px] from the needle

const typing = (target) => target instanceof Element && target.closest("input, select, textarea") !== null;

export class Input {
  // changed() is called when something else is held; stop() when Space is pressed; needle() gives points in pixels of the page.
  constructor(canvas, { changed, stop, needle }) {
    this.pressed = new Set();
    this.pointer = null; // [px] while the leash is held
    this.stick = [0, 0];
    this.stickRested = false; // a stick must have been let go once before it steers
    this.changed = changed;
    this.needle = needle;
    addEventListener("keydown", (event) => this.#down(event, stop), true);
    addEventListener("keyup", (event) => this.#up(event), true);
    addEventListener("blur", () => this.drop());
    addEventListener("pagehide", () => this.drop());
    addEventListener("offline", () => this.drop());
    addEventListener("gamepaddisconnected", () => this.drop());
    document.addEventListener("visibilitychange", () => document.hidden && this.drop());
    canvas.addEventListener("pointerdown", (event) => this.#grip(event));
    canvas.addEventListener("pointermove", (event) => this.#pull(event));
    for (const end of ["pointerup", "pointerleave", "pointercancel"]) canvas.addEventListener(end, () => this.#letGo());
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  drop() {
    this.pressed.clear();
    this.pointer = null;
    this.stick = [0, 0];
    this.stickRested = false;
    this.changed();
  }

  // Look at the gamepad, which tells nothing by itself.
  poll() {
    if (!document.hasFocus() || document.hidden) return;
    const pad = [...(navigator.getGamepads?.() ?? [])].find((entry) => entry?.connected && entry.axes.length >= 2);
    const [x, y] = pad ? [pad.axes[0], -pad.axes[1]] : [0, 0];
    const size = Math.hypot(x, y);
    if (!pad) {
      this.stickRested = false;
      this.stick = [0, 0];
    } else if (size <= DEAD_ZONE) {
      this.stickRested = true;
      this.stick = [0, 0];
    } else if (this.stickRested) {
      const share = Math.min(1, (size - DEAD_ZONE) / (1 - DEAD_ZONE)) / size;
      this.stick = [x * share, y * share];
    }
  }

  // Direction that is held, no longer than 1.
  direction() {
    if (this.pointer) return this.leash()?.direction ?? [0, 0];
    let [x, y] = [0, 0];
    for (const code of this.pressed) {
      x += Math.sign(KEYS[code][0]);
      y += Math.sign(KEYS[code][1]);
    }
    [x, y] = [Math.sign(x), Math.sign(y)];
    if (x || y) return [x / Math.hypot(x, y), y / Math.hypot(x, y)];
    return this.stick;
  }

  // The leash from the needle's tip to the mouse [px], and the direction that it asks for; null without one.
  leash() {
    const points = this.pointer ? this.needle() : null;
    if (!points) return null;
    const tip = points[points.length - 1];
    const [right, down] = [this.pointer[0] - tip[0], this.pointer[1] - tip[1]];
    const size = Math.hypot(right, down);
    const share = size < SHORTEST_LEASH ? 0 : Math.min(1, size / LEASH) / size;
    return { from: tip, to: this.pointer, direction: [right * share, -down * share] };
  }

  #down(event, stop) {
    if (event.code === "Space" && !event.ctrlKey && !event.altKey && !event.metaKey) {
      event.preventDefault();
      if (!event.repeat) stop();
      return;
    }
    if (!(event.code in KEYS) || event.ctrlKey || event.altKey || event.metaKey || typing(event.target)) return;
    event.preventDefault();
    if (event.repeat || this.pressed.has(event.code)) return;
    this.pressed.add(event.code);
    this.changed();
  }

  #up(event) {
    if (event.code === "Space") event.preventDefault();
    if (this.pressed.delete(event.code)) this.changed();
  }

  #grip(event) {
    const at = [event.offsetX, event.offsetY];
    const points = this.needle();
    const near = points?.some(([x, y]) => Math.hypot(x - at[0], y - at[1]) <= GRIP);
    if (event.button !== 0 || !near) return;
    this.pointer = at;
    this.changed();
  }

  #pull(event) {
    if (!this.pointer) return;
    if (!(event.buttons & 1)) this.#letGo();
    else this.pointer = [event.offsetX, event.offsetY];
  }

  #letGo() {
    if (!this.pointer) return;
    this.pointer = null;
    this.changed();
  }
}
