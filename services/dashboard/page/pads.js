// The pads as a list, lit by signal: what the scene shows in 3D, for everybody.

import { $, fixed, make, put } from "./format.js";

const FULL_V = 0.6;  // signal at which a pad is lit fully: an arm at 1 cm
const LEAST_V = 0.003;

// How brightly a pad is lit, from 0 to 1: by the logarithm, because the signal falls with the square of the distance.
export function level(volts) {
  return Math.min(1, Math.max(0, Math.log1p(Math.max(0, volts) / LEAST_V) / Math.log1p(FULL_V / LEAST_V)));
}

export function colour(value) {
  const from = [48, 66, 110], middle = [214, 92, 40], to = [255, 226, 110];
  const [a, b, t] = value < 0.5 ? [from, middle, 2 * value] : [middle, to, 2 * value - 1];
  return a.map((each, i) => Math.round(each + t * (b[i] - each)));
}

export class PadsView {
  #items = new Map();

  describe(scene) {
    $("pads").hidden = !Object.keys(scene.pads).length;
    for (const name of Object.keys(scene.pads)) {
      const value = make("span", { textContent: "–" });
      const element = make("li", {}, make("span", { textContent: name }), value);
      this.#items.set(name, { element, value, shown: -1 });
      $("pad-list").append(element);
    }
  }

  show(moment) {
    for (const [name, volts] of Object.entries(moment.pads)) {
      const item = this.#items.get(name);
      const strongest = Math.max(...volts);
      put(item.value, `${fixed(1000 * strongest, 0)} mV`);
      const lit = level(strongest);
      if (Math.abs(lit - item.shown) < 0.01) continue;
      item.shown = lit;
      const [r, g, b] = colour(lit);
      item.element.style.background = `rgb(${r}, ${g}, ${b})`;
      item.element.style.color = 0.299 * r + 0.587 * g + 0.114 * b > 140 ? "#14181f" : "#ffffff";
    }
  }
}
