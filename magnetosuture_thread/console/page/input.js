// Jog input: keys, direction buttons, a gamepad's stick, or dragging from the needle. All of it is cleared when the page
// loses focus, is hidden, the mouse leaves, the focus enters anything that takes keys itself, or a key is pressed that may
// open a menu or dialog of the browser; keys that were held then must be pressed again. Nothing on the page opens a native
// popup, as these swallow the release of a key.

const KEYS = {
  ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [-1, 0], ArrowRight: [1, 0],
  KeyW: [0, 1], KeyS: [0, -1], KeyA: [-1, 0], KeyD: [1, 0],
};
const DEAD_ZONE = 0.15; // of a stick
const MAX_DRAG = 90; // [px] a longer drag is not faster
const MIN_DRAG = 8; // [px]
const GRIP_RADIUS = 36; // [px] around the needle

const TAKES_KEYS = "input, textarea, select, [contenteditable], [role=listbox], [role=alertdialog]";
const OPENS_MENU = /^(F\d+|ContextMenu|Alt|AltGraph|Control|Meta|OS|PrintScreen)$/;
const takesKeys = (target) => target instanceof Element && target.closest(TAKES_KEYS) !== null;

export class Input {
  // changed() is called when the input changes, stop() when Space is pressed; needle() returns points in pixels of the page.
  constructor(canvas, directions, { changed, stop, needle }) {
    this.pressed = new Set();
    this.released = new Set(); // keys that are held but no longer count
    this.button = null; // direction of the button that is held
    this.pointer = null; // [px] during a drag
    this.stick = [0, 0];
    this.stickCentred = false; // a stick must be centred once before it jogs
    this.changed = changed;
    this.needle = needle;
    addEventListener("keydown", (event) => this.#down(event, stop), true);
    addEventListener("keyup", (event) => this.#up(event), true);
    addEventListener("focusin", ({ target }) => takesKeys(target) && this.clear());
    for (const swallowing of ["contextmenu", "dragstart"]) {
      addEventListener(swallowing, (event) => {
        event.preventDefault();
        // A finger that rests on a direction button opens a menu too, which stays closed; the hold goes on.
        if (!(event.pointerType === "touch" && this.button)) this.clear();
      }, true);
    }
    for (const lost of ["blur", "pagehide", "beforeprint", "offline", "gamepaddisconnected"]) addEventListener(lost, () => this.clear());
    document.addEventListener("visibilitychange", () => document.hidden && this.clear());
    canvas.addEventListener("pointerdown", (event) => this.#startDrag(event));
    canvas.addEventListener("pointermove", (event) => this.#updateDrag(event));
    for (const end of ["pointerup", "pointerleave", "pointercancel"]) canvas.addEventListener(end, () => this.#endDrag());
    directions.addEventListener("pointerdown", (event) => this.#holdButton(event));
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) directions.addEventListener(end, () => this.#releaseButton());
  }

  // Whether a key is held that has to be pressed again.
  get stale() {
    return this.released.size > 0;
  }

  clear() {
    if (document.hasFocus()) this.pressed.forEach((code) => this.released.add(code));
    else this.released.clear(); // their release would not be heard
    this.pressed.clear();
    this.pointer = this.button = null;
    this.stick = [0, 0];
    this.stickCentred = false;
    this.changed();
  }

  // Poll the focus, which some of the browser's own popups take without an event, and the gamepad, which sends none.
  poll() {
    if (!document.hasFocus() || document.hidden) return this.clear();
    const pad = [...(navigator.getGamepads?.() ?? [])].find((entry) => entry?.connected && entry.axes.length >= 2);
    const [x, y] = pad ? [pad.axes[0], -pad.axes[1]] : [0, 0];
    const size = Math.hypot(x, y);
    if (!pad) {
      this.stickCentred = false;
      this.stick = [0, 0];
    } else if (size <= DEAD_ZONE) {
      this.stickCentred = true;
      this.stick = [0, 0];
    } else if (this.stickCentred) {
      const share = Math.min(1, (size - DEAD_ZONE) / (1 - DEAD_ZONE)) / size;
      this.stick = [x * share, y * share];
    }
  }

  // Jog direction, of length 1 at most.
  direction() {
    if (this.pointer) return this.drag()?.direction ?? [0, 0];
    if (this.button) return this.button;
    let [x, y] = [0, 0];
    for (const code of this.pressed) {
      x += Math.sign(KEYS[code][0]);
      y += Math.sign(KEYS[code][1]);
    }
    [x, y] = [Math.sign(x), Math.sign(y)];
    if (x || y) return [x / Math.hypot(x, y), y / Math.hypot(x, y)];
    return this.stick;
  }

  // The drag from the needle's tip to the mouse [px], and its jog direction; null without one.
  drag() {
    const points = this.pointer ? this.needle() : null;
    if (!points) return null;
    const tip = points[points.length - 1];
    const [right, down] = [this.pointer[0] - tip[0], this.pointer[1] - tip[1]];
    const size = Math.hypot(right, down);
    const share = size < MIN_DRAG ? 0 : Math.min(1, size / MAX_DRAG) / size;
    return { from: tip, to: this.pointer, direction: [right * share, -down * share] };
  }

  #down(event, stop) {
    if (event.code === "Space" && !event.ctrlKey && !event.altKey && !event.metaKey) {
      event.preventDefault();
      if (!event.repeat) stop();
      return;
    }
    if (OPENS_MENU.test(event.key)) this.clear();
    if (!(event.code in KEYS) || event.ctrlKey || event.altKey || event.metaKey || takesKeys(event.target)) return;
    event.preventDefault();
    if (event.repeat && !this.pressed.has(event.code)) this.released.add(event.code);
    if (event.repeat || this.pressed.has(event.code)) return;
    this.released.delete(event.code);
    this.pressed.add(event.code);
    this.changed();
  }

  #up(event) {
    if (event.code === "Space") event.preventDefault();
    this.released.delete(event.code);
    if (this.pressed.delete(event.code)) this.changed();
  }

  #holdButton(event) {
    const held = event.target.closest("[data-direction]");
    if (event.button !== 0 || !held || held.disabled) return;
    held.setPointerCapture(event.pointerId);
    this.button = held.dataset.direction.split(",").map(Number);
    this.changed();
  }

  #releaseButton() {
    if (!this.button) return;
    this.button = null;
    this.changed();
  }

  #startDrag(event) {
    const at = [event.offsetX, event.offsetY];
    const points = this.needle();
    const near = points?.some(([x, y]) => Math.hypot(x - at[0], y - at[1]) <= GRIP_RADIUS);
    if (event.button !== 0 || !near) return;
    this.pointer = at;
    this.changed();
  }

  #updateDrag(event) {
    if (!this.pointer) return;
    if (!(event.buttons & 1)) this.#endDrag();
    else this.pointer = [event.offsetX, event.offsetY];
  }

  #endDrag() {
    if (!this.pointer) return;
    this.pointer = null;
    this.changed();
  }
}
