// Small helpers of all parts of the page.

export const $ = (id) => document.getElementById(id);

// Sets a text only where it changed: what stays the same keeps selection, focus and layout.
export function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function attribute(element, name, value) {
  if (element.getAttribute(name) !== value) element.setAttribute(name, value);
}

export function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

export function swatch(colour) {
  const element = make("span", { className: "swatch" });
  element.style.background = colour;
  return element;
}

// Rows by id, updated in place: a row that stays keeps its elements, and so the focus in it.
export class Rows {
  constructor(body, build) {
    this.body = body;
    this.build = build;
    this.rows = new Map();
  }

  show(items, id) {
    const seen = new Set();
    let place = this.body.firstElementChild;
    for (const item of items) {
      const name = id(item);
      seen.add(name);
      let row = this.rows.get(name);
      if (!row) {
        row = this.build(item);
        this.rows.set(name, row);
        this.body.insertBefore(row.element, place);
      } else if (row.element === place) {
        place = place.nextElementSibling;
      }
      row.update(item);
    }
    for (const [name, row] of this.rows) {
      if (!seen.has(name)) {
        row.element.remove();
        this.rows.delete(name);
      }
    }
  }
}

export function showState(element, state, text = state) {
  attribute(element, "data-state", state);
  put(element, text.replaceAll("_", " "));
}

// A number with so many decimals, and no minus before a zero.
export function fixed(value, digits) {
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text;
}

export const centimetres = (metres, digits = 1) => `${fixed(100 * metres, digits)} cm`;
export const degrees = (radians, digits = 1) => `${fixed((180 / Math.PI) * radians, digits)}°`;
export const percent = (share) => `${Math.round(100 * share)} %`;
export const clock = (seconds) => new Date(1000 * seconds).toLocaleTimeString("en-GB");

export function age(seconds) {
  return seconds < 10 ? `${Math.round(1000 * seconds)} ms` : `${Math.round(seconds)} s`;
}

export function style(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

// Calls back when the scheme of colours changes.
export function onScheme(call) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", call);
}

// How often something happens, over the last second or two.
export class Rate {
  #times = [];

  tick(now = performance.now()) {
    this.#times.push(now);
    while (now - this.#times[0] > 2000) this.#times.shift();
  }

  get perSecond() {
    const n = this.#times.length;
    return n < 2 ? 0 : (1000 * (n - 1)) / (this.#times[n - 1] - this.#times[0]);
  }
}
