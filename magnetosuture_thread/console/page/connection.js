// The WebSocket to the server: connects again after a drop, more and more patiently; steering is never resumed.

const FIRST_WAIT = 250; // [ms]
const LONGEST_WAIT = 4000;

export class Connection {
  constructor(handlers) {
    this.handlers = handlers;
    this.wait = FIRST_WAIT;
    this.socket = null;
    this.token = new URLSearchParams(location.hash.slice(1)).get("token") ?? "";
    this.timer = 0;
  }

  open() {
    clearTimeout(this.timer);
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.send({ type: "hello", token: this.token });
      this.handlers.opened();
    };
    socket.onmessage = ({ data }) => {
      this.wait = FIRST_WAIT;
      if (typeof data === "string") this.handlers.said(JSON.parse(data));
      else this.handlers.frame(data);
    };
    socket.onclose = ({ reason }) => {
      if (this.socket !== socket) return;
      this.socket = null;
      this.timer = setTimeout(() => this.open(), this.wait);
      this.handlers.closed(reason);
      this.wait = Math.min(2 * this.wait, LONGEST_WAIT);
    };
  }

  get isOpen() {
    return this.socket !== null && this.socket.readyState === WebSocket.OPEN;
  }

  // Send a message; return whether it went out.
  send(message) {
    if (!this.isOpen) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }
}
