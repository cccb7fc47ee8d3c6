// SPDX-License-Identifier: Apache-2.0
//
// The WebSocket to dssm-view. The page asks and dssm-view answers, in order. A lost connection is
// reopened each second.
//
// A Pump repeats one kind of request: at most one is under way, the next follows when the answer
// has come, and none while the tab is hidden or the connection is lost. So a slow browser or
// network gets fewer updates, not later ones.

const kProtocol = "dssm.view.v1";
const kRetryMs = 1000;
const kConnectMs = 5000; // a host that was switched off does not refuse the connection
const kAnswerMs = 20000; // dssm-view ended without closing the connection
const kMaxUnderWay = 8;
const kHeadAt = 8; // bytes before the head of a binary answer: id, length of the head

// The connection was lost before the answer came.
export class LostError extends Error {}

// dssm-view answered that the request failed; the message is for people.
export class RequestError extends Error {}

// A binary answer: its head, and typed access to the data after it.
export class BinaryAnswer {
  constructor(buffer) {
    const view = new DataView(buffer);
    this.id = view.getUint32(0, true);
    const headBytes = view.getUint32(4, true);
    this.head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, kHeadAt, headBytes)));
    this.buffer = buffer;
    this.dataAt = kHeadAt + headBytes;
  }

  // `count` doubles at `offset` bytes after the head.
  doubles(offset, count) {
    return new Float64Array(this.buffer, this.dataAt + offset, count);
  }

  bytes(offset, count) {
    return new DataView(this.buffer, this.dataAt + offset, count);
  }
}

// Dispatches "change" when `state` ("connecting", "connected", "lost") has changed.
export class Connection extends EventTarget {
  constructor(url) {
    super();
    this.url = url;
    this.state = "connecting";
    this.nextId = 1;
    this.waiting = new Map(); // id -> {resolve, reject, timer}
    this.queue = []; // requests that are to be sent later: [{request, reject}]
    this.connect();
  }

  // Resolves to the JSON answer, or to a BinaryAnswer. The connection is lost if none comes in time.
  request(op, parameters = {}, answerMs = kAnswerMs) {
    if (this.state !== "connected") return Promise.reject(new LostError("not connected"));
    // The server ends a connection with too many unanswered requests.
    if (this.waiting.size >= kMaxUnderWay) {
      return new Promise((resolve, reject) => {
        const request = () => this.request(op, parameters, answerMs).then(resolve, reject);
        this.queue.push({ request, reject });
      });
    }
    const id = this.nextId;
    this.nextId = (this.nextId % 0x7fffffff) + 1;
    const socket = this.socket;
    return new Promise((resolve, reject) => {
      const timer = setTimeout(() => this.lose(socket), answerMs);
      this.waiting.set(id, { resolve, reject, timer });
      socket.send(JSON.stringify({ id, op, ...parameters }));
    });
  }

  connect() {
    const socket = new WebSocket(this.url, kProtocol);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    const timer = setTimeout(() => this.lose(socket), kConnectMs);
    socket.onopen = () => {
      clearTimeout(timer);
      this.change("connected");
    };
    socket.onmessage = (message) => this.onMessage(message.data);
    socket.onclose = () => {
      clearTimeout(timer);
      this.lose(socket);
    };
  }

  onMessage(data) {
    const answer = typeof data === "string" ? JSON.parse(data) : new BinaryAnswer(data);
    const waiting = this.waiting.get(answer.id);
    if (!waiting) return;
    this.waiting.delete(answer.id);
    clearTimeout(waiting.timer);
    this.queue.shift()?.request();
    // An overview has an error, too: the one of dssmd.
    const failed = typeof data === "string" && answer.error && !("streams" in answer);
    if (failed) waiting.reject(new RequestError(answer.error));
    else waiting.resolve(answer);
  }

  lose(socket) {
    if (socket !== this.socket) return;
    this.socket = null;
    socket.onopen = socket.onmessage = socket.onclose = null;
    socket.close();
    const waiting = [...this.waiting.values(), ...this.queue];
    this.waiting.clear();
    this.queue = [];
    this.change("lost");
    for (const { reject, timer } of waiting) {
      clearTimeout(timer);
      reject(new LostError("the connection was lost"));
    }
    setTimeout(() => this.connect(), kRetryMs);
  }

  change(state) {
    if (this.state === state) return;
    this.state = state;
    this.dispatchEvent(new Event("change"));
  }
}

export class Pump {
  // ask: an async function; it returns the milliseconds until it is to be called again, or null
  // when it waits for wake(). Calls begin at least `periodMs` apart.
  constructor(connection, periodMs, ask) {
    this.connection = connection;
    this.periodMs = periodMs;
    this.ask = ask;
    this.begun = -Infinity;
    this.running = false;
    this.again = false;
    this.timer = null;
    connection.addEventListener("change", () => this.wake());
    document.addEventListener("visibilitychange", () => this.wake());
  }

  // What is asked for has changed: asks as soon as the period allows it.
  wake() {
    if (this.running) this.again = true;
    else this.schedule(0);
  }

  schedule(pauseMs) {
    clearTimeout(this.timer);
    const early = this.begun + this.periodMs - performance.now();
    this.timer = setTimeout(() => this.run(), Math.max(pauseMs, early, 0));
  }

  async run() {
    if (document.hidden || this.connection.state !== "connected") return; // their events wake it
    this.running = true;
    this.again = false;
    this.begun = performance.now();
    let pauseMs = null;
    try {
      pauseMs = await this.ask();
    } catch (error) {
      if (!(error instanceof LostError)) console.error(error);
      pauseMs = error instanceof LostError ? null : kRetryMs;
    }
    this.running = false;
    if (this.again) pauseMs = 0;
    if (pauseMs !== null) this.schedule(pauseMs);
  }
}
