// WebSocket to the server: reconnects with backoff, also where nothing comes any more; control is never resumed.

export const SILENCE_TIMEOUT = 1.0; // [s] after which the last state is old, and what is sent may not arrive
const MAX_SILENCE = 3.0; // [s] after which a connection is given up: a link that is gone tells nobody
const WATCH_PERIOD = 250; // [ms]
const MIN_RECONNECT_DELAY = 250; // [ms]
const MAX_RECONNECT_DELAY = 4000;

export class Connection {
  constructor(handlers) {
    this.handlers = handlers;
    this.delay = MIN_RECONNECT_DELAY;
    this.socket = null;
    this.token = new URLSearchParams(location.hash.slice(1)).get("token") ?? "";
    this.timer = 0;
    this.heard = 0; // when something came last, by performance.now() [ms]
    setInterval(() => this.silence > MAX_SILENCE && this.#lose(this.socket, `nothing came for ${MAX_SILENCE} s`), WATCH_PERIOD);
  }

  open() {
    clearTimeout(this.timer);
    // Beside the page, which may be behind a proxy's path.
    const socket = new WebSocket(new URL(`socket?token=${encodeURIComponent(this.token)}`, location.href.replace(/^http/, "ws")));
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.heard = performance.now();
    socket.onopen = () => {
      this.send({ type: "hello", token: this.token, automated: navigator.webdriver === true });
      this.handlers.opened();
    };
    socket.onmessage = ({ data }) => {
      if (this.socket !== socket) return;
      this.heard = performance.now();
      this.delay = MIN_RECONNECT_DELAY;
      if (typeof data === "string") this.handlers.received(JSON.parse(data));
      else this.handlers.frame(data);
    };
    socket.onclose = ({ reason }) => this.#lose(socket, reason);
  }

  #lose(socket, reason) {
    if (!socket || this.socket !== socket) return;
    this.socket = null;
    socket.close();
    this.timer = setTimeout(() => this.open(), this.delay);
    this.handlers.closed(reason);
    this.delay = Math.min(2 * this.delay, MAX_RECONNECT_DELAY);
  }

  // Time since something came [s].
  get silence() {
    return (performance.now() - this.heard) / 1000;
  }

  get isOpen() {
    return this.socket !== null && this.socket.readyState === WebSocket.OPEN;
  }

  // Send a message, with the time of now or of the press that it is for [ms]; the server refuses to start what comes late.
  // Return whether it was sent, and something has come so lately that it may be expected to arrive.
  send(message, at = performance.now()) {
    if (!this.isOpen) return false;
    this.socket.send(JSON.stringify({ ...message, sent: at / 1000 }));
    return this.silence <= SILENCE_TIMEOUT;
  }
}
