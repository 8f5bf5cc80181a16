// The one WebSocket: keeps the parts of the live state, asks for what was missed, and knows when nothing comes.

const LOST_AFTER_MS = 2000;
const RETRY_MS = [250, 500, 1000, 2000];

export class Link {
  // onParts(changed: {key: part or null}, full): called for every frame. onState(): when lost or found.
  constructor(url, onParts, onState) {
    Object.assign(this, { url, onParts, onState });
    this.boot = "";
    this.version = 0;
    this.frames = 0;
    this.heardAt = -Infinity; // performance.now() of the newest frame
    this.everHeard = false;
    this.lost = true;
    this.refused = false; // closed before it was ever accepted: perhaps a token is needed
    this.retries = 0;
    this.busy = Promise.resolve();
    setInterval(() => this.watch(), 250);
    addEventListener("online", () => this.reconnect());
    this.connect();
  }

  connect() {
    clearTimeout(this.timer);
    const socket = new WebSocket(this.url);
    this.socket = socket;
    this.openedAt = performance.now();
    let accepted = false;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      accepted = true;
      this.refused = false;
      socket.send(JSON.stringify({ boot: this.boot, version: this.version }));
    };
    // Frames are taken one after the other, since unpacking them is asynchronous.
    socket.onmessage = (event) => {
      this.busy = this.busy.then(() => this.take(socket, event.data)).catch((error) => console.error(error));
    };
    socket.onclose = () => {
      if (socket !== this.socket) return;
      this.refused = !accepted;
      this.setLost(true);
      const wait = RETRY_MS[Math.min(this.retries++, RETRY_MS.length - 1)];
      this.timer = setTimeout(() => this.connect(), wait);
    };
  }

  // There is a token now: a connection that was refused for want of one is tried again at once.
  retry() {
    if (this.socket && this.socket.readyState >= WebSocket.CLOSING) this.reconnect();
  }

  reconnect() {
    const old = this.socket;
    this.socket = null;
    old.close();
    this.connect();
  }

  async take(socket, data) {
    const frame = MessagePack.decode(new Uint8Array(data));
    if (socket !== this.socket) return;
    const full = frame.full || frame.boot !== this.boot;
    await Promise.all(Object.values(frame.parts).map(inflateCells));
    this.onParts(frame.parts, full);
    this.boot = frame.boot;
    this.version = frame.version;
    this.frames += 1;
    this.retries = 0;
    this.heardAt = performance.now();
    this.everHeard = true;
    this.setLost(false);
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ version: frame.version }));
  }

  silentMs() {
    return performance.now() - this.heardAt;
  }

  watch() {
    if (this.everHeard && this.silentMs() > LOST_AFTER_MS) this.setLost(true);
    // A connection that is open but dead is given up: its end may never be told.
    const since = Math.min(this.silentMs(), performance.now() - this.openedAt);
    if (this.socket && since > 6000) this.reconnect();
    if (this.lost) this.onState();
  }

  setLost(lost) {
    if (lost === this.lost) return;
    this.lost = lost;
    this.onState();
  }
}

async function inflateCells(part) {
  if (!part || !part.cells_z) return;
  const stream = new Blob([part.cells_z]).stream().pipeThrough(new DecompressionStream("deflate"));
  part.cells = new Uint8Array(await new Response(stream).arrayBuffer());
  delete part.cells_z;
}
