// WebSocket to the server: reconnects with backoff; control is never resumed.

const MIN_RECONNECT_DELAY = 250; // [ms]
const MAX_RECONNECT_DELAY = 4000;

export class Connection {
  constructor(handlers) {
    this.handlers = handlers;
    this.delay = MIN_RECONNECT_DELAY;
    this.socket = null;
    this.token = new URLSearchParams(location.hash.slice(1)).get("token") ?? "";
    this.timer = 0;
  }

  open() {
    clearTimeout(this.timer);
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket?token=${encodeURIComponent(this.token)}`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.send({ type: "hello", token: this.token, automated: navigator.webdriver === true });
      this.handlers.opened();
    };
    socket.onmessage = ({ data }) => {
      this.delay = MIN_RECONNECT_DELAY;
      if (typeof data === "string") this.handlers.received(JSON.parse(data));
      else this.handlers.frame(data);
    };
    socket.onclose = ({ reason }) => {
      if (this.socket !== socket) return;
      this.socket = null;
      this.timer = setTimeout(() => this.open(), this.delay);
      this.handlers.closed(reason);
      this.delay = Math.min(2 * this.delay, MAX_RECONNECT_DELAY);
    };
  }

  get isOpen() {
    return this.socket !== null && this.socket.readyState === WebSocket.OPEN;
  }

  // Send a message; return whether it was sent.
  send(message) {
    if (!this.isOpen) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }
}
