// The camera's picture with the mask as a tint and the outline of each pose. Plain 2D canvas: it needs no WebGL.

import { $, Rate, attribute, make, put, swatch } from "./format.js";
import { unpack } from "./link.js";

const TINT = 115;  // opacity of the mask, of 255

export class CameraView {
  #canvas = $("picture");
  #context = this.#canvas.getContext("2d");
  #tint = document.createElement("canvas");
  #palette = new Uint32Array(256);
  #rate = new Rate();
  #last = null;

  constructor(link) {
    this.link = link;
    link.addEventListener("picture", ({ detail }) => this.#receive(detail));
    for (const id of ["show-mask", "show-outline"]) $(id).addEventListener("change", () => this.#last && this.#paint(...this.#last));
    $("camera-name").addEventListener("change", ({ target }) => this.choose(target.value));
  }

  describe(scene) {
    const bytes = new Uint8Array(this.#palette.buffer);
    for (const [label, { colour }] of Object.entries(scene.labels)) bytes.set([...colour, TINT], 4 * label);
    $("labels").replaceChildren(...Object.values(scene.labels).map(({ name, colour }) => make("li", {}, swatch(`rgb(${colour})`), name)));
    const names = Object.keys(scene.cameras);
    $("camera-name").replaceChildren(...names.map((name) => make("option", { value: name, textContent: name })));
    $("camera-choice").hidden = names.length < 2;
    if (names.length) this.choose(names[0]);
    else put($("no-picture"), "this cell has no camera");
  }

  choose(name) {
    this.link.look(name);
    put($("camera-title"), `Camera ${name}`);
  }

  async #receive(buffer) {
    const [header, at] = unpack(buffer);
    const runs = new Uint16Array(buffer, at, 2 * header.runs);
    const jpeg = new Blob([new Uint8Array(buffer, at + runs.byteLength)], { type: "image/jpeg" });
    let image;
    try {
      image = await createImageBitmap(jpeg);
    } catch {
      this.link.shown("picture");
      return;
    }
    requestAnimationFrame(() => {
      this.#last?.[1].close();
      this.#last = [header, image, runs];
      this.#paint(header, image, runs);
      this.#rate.tick();
      put($("picture-rate"), `${this.#rate.perSecond.toFixed(0)} pictures/s · ${(1000 * header.age).toFixed(0)} ms old`);
      this.link.shown("picture");
    });
  }

  #paint(header, image, runs) {
    const [width, height] = header.size;
    const canvas = this.#canvas, context = this.#context;
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
      canvas.style.aspectRatio = `${width} / ${height}`;
    }
    $("no-picture").hidden = true;
    context.imageSmoothingEnabled = true;
    context.drawImage(image, 0, 0, width, height);
    if (header.mask && $("show-mask").checked) this.#drawMask(header.mask, runs);
    if ($("show-outline").checked) this.#drawOutlines(header.outlines, width);
    const targets = Object.entries(header.outlines).map(([name, { state }]) => `${name} ${state}`);
    attribute(canvas, "aria-label", `picture of ${header.camera} with mask and outline: ${targets.join(", ") || "no pose"}`);
  }

  #drawMask({ x, y, scale, width, height }, runs) {
    const pixels = new Uint32Array(width * height);
    for (let i = 0, at = 0; i < runs.length; i += 2) {
      pixels.fill(this.#palette[runs[i]], at, at + runs[i + 1]);
      at += runs[i + 1];
    }
    this.#tint.width = width;
    this.#tint.height = height;
    this.#tint.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(pixels.buffer), width, height), 0, 0);
    this.#context.imageSmoothingEnabled = false;
    this.#context.drawImage(this.#tint, x, y, scale * width, scale * height);
  }

  #drawOutlines(outlines, width) {
    const context = this.#context;
    context.lineJoin = "round";
    for (const { state, lines } of Object.values(outlines)) {
      const path = new Path2D();
      for (const line of lines) {
        path.moveTo(line[0], line[1]);
        for (let i = 2; i < line.length; i += 2) path.lineTo(line[i], line[i + 1]);
        path.closePath();
      }
      context.strokeStyle = "rgba(0, 0, 0, .55)";
      context.lineWidth = width / 150;
      context.stroke(path);
      context.strokeStyle = { tracking: "#35e07a", coasting: "#ffc02e" }[state] ?? "#ff5c57";
      context.lineWidth = width / 320;
      context.stroke(path);
    }
  }
}
