// The link to the server: a websocket that shows, requests that steer, and the key that both need.

const RETRY_MS = [300, 1000, 2000, 4000];
const STRANGER = 4401;
const STORED = "penumbra-key";

export class Link extends EventTarget {
  // Events: `state` ("waiting", "open", "closed", "stranger"), and one per stream with the message as detail.
  #key = "";
  #camera = "";
  #socket = null;
  #tries = 0;

  async start() {
    const given = new URLSearchParams(location.hash.slice(1)).get("key");
    if (given) {
      sessionStorage.setItem(STORED, given);
      history.replaceState(null, "", location.pathname);  // a key in the address bar is soon in a screenshot
    }
    await this.#connect();
  }

  open(key) {
    sessionStorage.setItem(STORED, key);
    this.#tries = 0;
    return this.#connect();
  }

  look(camera) {
    this.#camera = camera;
    this.#send({ camera });
  }

  // Tells the server that a stream's message was shown: it sends the next one only then.
  shown(stream) {
    this.#send({ shown: stream });
  }

  async fetch(path) {
    const answer = await fetch(path, { headers: { "X-Penumbra-Key": this.#key } });
    if (!answer.ok) throw new Error((await answer.json()).error);
    return answer.arrayBuffer();
  }

  async ask(path, request) {
    const headers = { "Content-Type": "application/json", "X-Penumbra-Key": this.#key };
    const answer = await fetch(path, { method: "POST", headers, body: JSON.stringify(request) });
    const said = await answer.json();
    if (!answer.ok) throw new Error(said.error);
    return said;
  }

  #say(state) {
    this.dispatchEvent(new CustomEvent("state", { detail: state }));
  }

  #send(message) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(message));
  }

  async #connect() {
    this.#say("waiting");
    try {
      const { key } = await (await fetch("key", { method: "POST" })).json();
      this.#key = key ?? sessionStorage.getItem(STORED) ?? "";
    } catch {
      this.#again();
      return;
    }
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => socket.send(JSON.stringify({ key: this.#key, camera: this.#camera }));
    socket.onmessage = ({ data }) => this.#receive(data);
    socket.onclose = ({ code }) => {
      if (code === STRANGER) this.#say("stranger");
      else this.#again();
    };
    this.#socket = socket;
  }

  #again() {
    this.#say("closed");
    setTimeout(() => this.#connect(), RETRY_MS[Math.min(this.#tries++, RETRY_MS.length - 1)]);
  }

  #receive(data) {
    if (data instanceof ArrayBuffer) {
      this.dispatchEvent(new CustomEvent("picture", { detail: data }));
      return;
    }
    const message = JSON.parse(data);
    if (message.stream === "hello") {
      this.#tries = 0;
      this.#say("open");
    }
    this.dispatchEvent(new CustomEvent(message.stream, { detail: message }));
  }
}

// The header of a packed message and what follows it: a length, JSON, bytes.
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return [header, 4 + length];
}
